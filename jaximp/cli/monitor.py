"""`jaximp monitor`."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Timer
from typing import TYPE_CHECKING, Annotated, Any

import typer

from jaximp.cli.terminal import console

if TYPE_CHECKING:
    from jaximp.jobs.job import WindowJob
    from jaximp.live.lines import Columns
    from jaximp.live.monitor import Monitor, Update
    from jaximp.live.session import Session
    from jaximp.live.sinks import Aside
    from jaximp.live.sources import Source
    from jaximp.types import Recording

Job = Annotated[Path | None, typer.Argument(metavar="JOB.toml", help="What to identify; left out with --demo.")]


def monitor(
    job_file: Job = None,
    demo: Annotated[bool, typer.Option("--demo", help="Play a simulated rig whose stiffness doubles.")] = False,
    source: Annotated[
        str,
        typer.Option(
            "--source",
            help="replay (the job's recording), stdin, tcp:PORT, udp:PORT (or tcp:HOST:PORT), lsl:STREAM, ros:TOPIC.",
        ),
    ] = "replay",
    speed: Annotated[
        float, typer.Option("--speed", help="replay: times its own speed; inf: as fast as it goes.")
    ] = 1.0,
    sample_rate: Annotated[
        float | None, typer.Option("--sample-rate", help="In Hz; by default what the time stamps say.")
    ] = None,
    calibrate: Annotated[float, typer.Option("--calibrate", help="Seconds of samples that make a calibration.")] = 20.0,
    calibration: Annotated[
        Path | None, typer.Option("--calibration", help="One that was saved, with the state that stands in it.")
    ] = None,
    save: Annotated[
        Path | None, typer.Option("--save", help="Keep calibration and state in this file (.npz) at the end.")
    ] = None,
    log: Annotated[Path | None, typer.Option("--log", help="Folder for all samples and estimates; a new one.")] = None,
    estimate: Annotated[
        str, typer.Option("--estimate", help="track (a path with a band) or window (one that trails behind).")
    ] = "track",
    every: Annotated[float, typer.Option("--every", help="Seconds between updates; 0: one with every sample.")] = 0.1,
    json: Annotated[
        bool | None, typer.Option("--json/--words", help="Updates as lines of JSON, which is usual in a pipe.")
    ] = None,
    udp: Annotated[str | None, typer.Option("--udp", help="Send updates to HOST:PORT, too.")] = None,
    lsl: Annotated[str | None, typer.Option("--lsl", help="Open an outlet of this name for updates, too.")] = None,
    page: Annotated[
        str | None, typer.Option("--page", help="Show a live page at PORT (or HOST:PORT); 0 takes a free one.")
    ] = None,
    alarm: Annotated[
        list[str] | None, typer.Option("--alarm", help="Such as 'stiffness > 80 for 2 s with 99 %'; may be repeated.")
    ] = None,
    token: Annotated[
        str | None, typer.Option("--token", envvar="JAXIMP_TOKEN", help="What senders from elsewhere have to show.")
    ] = None,
    seconds: Annotated[float | None, typer.Option("--for", help="End after so many seconds.")] = None,
) -> None:
    """Identify a joint while it moves: an estimate with its interval and verdict for every sample.

    The first samples make the calibration: how large the noise is, and how fast parameters move. Until then the verdict
    is "warming up". Ctrl-C ends it; the log is then complete.
    """
    from jaximp.live.calibration import save_calibration, state_arrays

    job, recording, alone = _demo() if demo else _job(job_file, source == "replay")
    if demo and calibrate == 20.0:
        calibrate = DEMO_CALIBRATES
    watch, columns, joint = _monitor(
        job, sample_rate if recording is None or sample_rate else recording.sample_rate, calibration, alone,
        seconds=calibrate, estimate=estimate, every=every,
    )  # fmt: skip
    as_json = (not demo and not sys.stdout.isatty()) if json is None else json
    reads = _source(source, recording, speed, columns, token)
    try:
        sinks = _sinks(as_json, udp, lsl)
        kept = None if log is None else _log(log, job, joint, alone if demo else None)
    except BaseException:
        reads.close()
        raise
    from jaximp.live.session import Session

    session = Session(reads, watch, sinks, kept, _say)
    with _shown(session, page, token, alarm or [], job, joint):
        _run(session, seconds)
    if save is not None and watch.calibration is not None and watch.state is not None and watch.clock is not None:
        save_calibration(watch.calibration, save, state_arrays(watch.state, watch.clock.next))
        _say(f"calibration and state: {save}")
    elif save is not None:
        _say("there is no calibration to save yet")
    if session.report_wanted and log is not None:
        _report(log)


DEMO_CALIBRATES = 10.0
"""Seconds."""
DEMO_SECONDS, DEMO_DOUBLES = 40.0, 20.0
"""How long it lasts, and when the stiffness doubles [s]."""


def _say(line: str) -> None:
    console.print(line, markup=False, soft_wrap=True)


def _job(path: Path | None, replayed: bool) -> tuple[WindowJob, Recording | None, Any]:
    from jaximp.jobs.job import TrialsJob, read_job

    if path is None:
        raise ValueError("monitor needs a job: jaximp monitor JOB.toml, or --demo")
    job = read_job(path)
    if isinstance(job, TrialsJob):
        raise ValueError("monitor identifies one joint: a job with [trials] has none")
    alone = job.load_robot_alone()
    return job, job.load() if replayed else None, alone[0] if isinstance(alone, tuple) else alone


def _demo() -> tuple[WindowJob, Recording, Recording]:
    from jaximp.jobs.job import TrialsJob, parse_job
    from jaximp.simulation.rig import HumanLoad
    from jaximp.simulation.rig_recordings import JOB, rig_recordings

    job = parse_job(JOB.format(what=f"a spring whose stiffness doubles after {DEMO_DOUBLES:g} s", offset="false"))
    assert not isinstance(job, TrialsJob)
    _say(
        f"a simulated rig holds a spring whose stiffness doubles after {DEMO_DOUBLES:g} s, from 0.001 to 0.002 N m/rad"
    )
    alone, held = rig_recordings(HumanLoad(step_time=DEMO_DOUBLES), duration=DEMO_SECONDS)
    return job, held, alone


def _monitor(
    job: WindowJob, sample_rate: float | None, calibration: Path | None, alone: Recording | None, **settings: Any
) -> tuple[Monitor, Columns, str]:
    from jaximp.live.calibration import live_of, load_calibration, load_state
    from jaximp.live.lines import columns_of
    from jaximp.live.monitor import Monitor

    columns, joints = columns_of(job.recording)
    found = None if calibration is None else load_calibration(calibration)
    rate = job.recording.get("sample_rate") if sample_rate is None else sample_rate
    if found is not None and not isinstance(rate, int | float):
        rate = found.sample_rate
    sample_rate = float(rate) if isinstance(rate, int | float) else None

    def make(rate: float) -> Any:
        return job.pipeline(joints, rate)

    if sample_rate is not None:
        make(sample_rate)
    state, resumes_at = None, float("nan")
    if found is not None and calibration is not None and sample_rate is not None:
        state, resumes_at = load_state(calibration, live_of(make(sample_rate), found))
    watch = Monitor(
        make,
        sample_rate=sample_rate,
        calibration=found,
        state=state,
        resumes_at=resumes_at,
        robot_alone=alone,
        **settings,
    )
    return watch, columns, joints[0]


def _source(named: str, recording: Recording | None, speed: float, columns: Columns, token: str | None) -> Source:
    """What `--source` names."""
    from jaximp.live.sources import Piped, Replay

    kind, _, rest = named.replace("://", ":").partition(":")
    if recording is not None:
        return Replay(recording, speed)
    if kind == "stdin":
        return Piped(sys.stdin.fileno(), columns)
    if kind in ("tcp", "udp"):
        from jaximp.live.sockets import TcpSource, UdpSource

        host, port = _address(rest)
        listening = (TcpSource if kind == "tcp" else UdpSource)(port, host, columns, token)
        _say(f"listening on {host}:{listening.port} ({kind})")
        return listening
    if kind == "lsl":
        from jaximp.live.lsl import LslSource

        return LslSource(rest, columns)
    if kind == "ros":
        from jaximp.live.ros import RosSource

        topic, _, joint = rest.partition("#")
        return RosSource(topic or "/joint_states", joint or None)
    raise ValueError(f"--source is '{named}': give replay, stdin, tcp:PORT, udp:PORT, lsl:STREAM or ros:TOPIC")


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not port.isdigit() or int(port) > 65535:
        raise ValueError(f"'{text}' is no address: give PORT, or HOST:PORT")
    return host.strip("[]") or "127.0.0.1", int(port)


def _sinks(as_json: bool, udp: str | None, lsl: str | None) -> list[Aside]:
    from jaximp.live.sinks import Aside, Called, JsonLines, UdpSink

    found = [Aside(JsonLines(sys.stdout) if as_json else Called(_words()))]
    if udp is not None:
        found.append(Aside(UdpSink(*_address(udp))))
    if lsl is not None:
        from jaximp.live.lsl import LslSink

        found.append(Aside(LslSink(lsl)))
    return found


def _words() -> Callable[[Update], None]:
    """A line for people, once a second."""
    said = float("-inf")

    def write(update: Update) -> None:
        nonlocal said
        if said <= update.time < said + 1.0:
            return
        said = update.time
        typer.echo(line_of(update))

    return write


def line_of(update: Update) -> str:
    """What is known, for people."""
    parts = [f"{update.time:9.2f} s"]
    if update.value is not None and update.stderr is not None:
        parts += [
            f"{name} {value:.4g} ± {1.96 * stderr:.2g} {unit}"
            for name, unit, value, stderr in zip(update.names, update.units, update.value, update.stderr, strict=True)
        ]
    return "  ".join([*parts, ": ".join(filter(None, [update.verdict.label, update.verdict.in_words()]))])


def _log(folder: Path, job: WindowJob, joint: str, alone: Recording | None) -> Any:
    """With a job that finds what it needs, wherever the folder is; `alone` is a recording that stands in no file."""
    import tomllib

    from jaximp.live.log import Log
    from jaximp.recordings.save import save_recording

    tables = {key: value for key, value in tomllib.loads(job.text).items() if key not in ("recording", "held_out")}
    for name in ("robot_recording", "robot_recording_after"):
        if name in tables:
            inherited = {key: value for key, value in job.recording.items() if key not in ("file", "rows", "name")}
            table = {**inherited, **tables[name]}
            files = table["file"] if isinstance(table["file"], list) else [table["file"]]
            tables[name] = {**table, "file": [str((job.folder / file).resolve()) for file in files]}
            if len(files) == 1:
                tables[name]["file"] = tables[name]["file"][0]
    if "design" in tables:
        tables["design"] = str((job.folder / tables["design"]).resolve())
    log = Log(folder, tables, joint)
    if alone is not None:
        save_recording(alone, folder / f"{alone.name}.csv")
        tables["robot_recording"]["file"] = f"{alone.name}.csv"
    return log


@contextmanager
def _shown(
    session: Session, page: str | None, token: str | None, alarms: list[str], job: WindowJob, joint: str
) -> Iterator[None]:
    """With alarms, and a page where somebody asked for one."""
    from jaximp.live.alarms import parse_rule

    names = job.pipeline((joint,), ANY_RATE).model.names
    session.watch([parse_rule(one, names) for one in alarms])
    if page is None:
        yield
        return
    from jaximp.live.page import Page
    from jaximp.live.sinks import Aside
    from jaximp.live.sockets import check_open

    host, port = _address(page)
    check_open(host, token)

    def do(action: str, text: str) -> dict[str, Any]:
        if action == "pause":
            session.paused = not session.paused
            return {"paused": session.paused}
        if action == "mark":
            session.mark(text or "mark")
        if action == "report" and session.log is None:
            return {"said": "there is no log to make a report of: start with --log DIR"}
        if action in ("stop", "report"):
            session.report_wanted = action == "report"
            session.stop()
        return {}

    shown = Page(do, port, host, token, job.trust.min_excitation_ratio, lambda: {
        "alarms": session.raised, "counts": session.status(),
    })  # fmt: skip
    _say(f"page: {shown.address}")
    session.on_mark(shown.mark)
    session.sinks = [*session.sinks, Aside(shown)]
    yield
    _say("the page is closed")


ANY_RATE = 1e4
"""At which the names of parameters are asked for [Hz]."""


def _report(log: Path) -> None:
    """What `identify` makes of the log."""
    from jaximp.cli.identify import identify_into
    from jaximp.cli.terminal import say_where
    from jaximp.jobs.job import read_job
    from jaximp.recordings.outputs import new_folder

    with new_folder(log / "results") as folder:
        say = identify_into(read_job(log / "job.toml"), folder)
    say()
    say_where(log / "results")


def _run(session: Session, seconds: float | None) -> None:
    """Until the source ends, the time is over, or somebody presses Ctrl-C."""
    before = {one: signal.signal(one, lambda *_: session.stop()) for one in (signal.SIGINT, signal.SIGTERM)}
    timer = None if seconds is None else Timer(seconds, session.stop)
    if timer is not None:
        timer.daemon = True
        timer.start()
    try:
        session.run()
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)
        if timer is not None:
            timer.cancel()
        if not sys.stdout.closed:
            _flush()


def _flush() -> None:
    """Whoever read the updates may have gone."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
