"""Impedance from perturbation trials: through the command line, and every verdict with its reason."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pyarrow.parquet as pq
import pytest

from command_line import jaximp
from jaximp.jobs.job import parse_job, read_job
from jaximp.jobs.run import infer
from jaximp.jobs.run_trials import identify_trials
from jaximp.models import BASE_INERTIA, ArmGeometry, PlanarArm
from jaximp.perturbation import trial_fits as fit
from jaximp.perturbation.deviations import Deviations, JointDeviations, KnownArm
from jaximp.perturbation.estimate import ArmEstimate
from jaximp.perturbation.impedance import ArmImpedance, identify_impedance
from jaximp.perturbation.isolation.isolated import Impedance, Isolated
from jaximp.perturbation.isolation.methods import METHODS, Method
from jaximp.perturbation.rules import BIASES
from jaximp.perturbation.sensors import handle_disagreement
from jaximp.perturbation.trials import Handle, Trials
from jaximp.perturbation.window_lengths import at_other_windows
from jaximp.posterior.arm import ArmInference
from jaximp.trust.limits import TrustLimits
from jaximp.trust.verdicts import NO_DATA, POOR, TRUSTED, WEAK

NASTY = "<script>alert(1).csv"
FIGURES = {"deviations", "spectra", "torques", "ellipses", "windows", "methods"}


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Small simulated recordings with their job."""
    folder = tmp_path_factory.mktemp("simulated") / "arm"
    numbers = ("--perturbed", 10, "--unperturbed", 6, "--duration", 1.4)
    assert jaximp("simulate", "arm", "--out", folder, "--format", "csv", *numbers) == 0
    return folder


@pytest.fixture(scope="module")
def results(arm: Path) -> Path:
    """Of two methods, from a file with a nasty name."""
    text = (arm / "job.toml").read_text()
    text = text.replace('"output_error"', '["feedback_jerk", "gomi_kawato"]').replace("movements.csv", NASTY)
    (arm / "two.toml").write_text(text + "# <b>bold</b>\n")
    (arm / NASTY).write_bytes((arm / "movements.csv").read_bytes())
    assert jaximp("identify", arm / "two.toml", "--out", arm / "out") == 0
    return arm / "out"


@pytest.mark.slow
def test_simulated_arm_is_read_by_its_job(arm: Path) -> None:
    job = read_job(arm / "job.toml")
    assert job.trials is not None
    assert job.trials.posture is not None
    perturbed, unperturbed, _ = job.trials.load()
    held, none, _ = job.trials.posture.load()
    assert [len(group) for group in (perturbed, unperturbed or [], held)] == [10, 6, 20]
    assert none is None
    assert job.trials.methods == ("output_error",)
    assert {path.name for path in job.files()} == {"movements.csv", "postures.csv"}
    truth = json.loads((arm / "truth.json").read_text())
    assert truth["inertia_kgm2"] == pytest.approx(
        {"upper_arm_inertia": 0.1945, "forearm_inertia": 0.0737, "coupling_inertia": 0.0838}
    )
    stiffness = np.array(truth["stiffness_Nm_per_rad"])
    assert (np.linalg.eigvalsh(stiffness) > 5).all()
    np.testing.assert_allclose(truth["damping_Nms_per_rad"], stiffness / 12)
    assert len(truth["perturbed_trials"]) == 10


def test_simulated_trials_are_identified(results: Path, arm: Path) -> None:
    truth, found = (json.loads(path.read_text()) for path in (arm / "truth.json", results / "summary.json"))
    for method, error in ((found, 0.1), (found["further_methods"][0], 0.1)):
        np.testing.assert_allclose(method["damping_Nms_per_rad"], truth["damping_Nms_per_rad"], atol=2.4 * error)
        assert method["vaf"] > 0.8
        assert method["held_out_vaf"] > 0.7
    assert found["inertia_kgm2"] == pytest.approx(truth["inertia_kgm2"], rel=0.1)
    for name, value in found["parameters"].items():
        matrix, place = name.split("_")
        true = np.array(truth["damping_Nms_per_rad" if matrix == "damping" else "stiffness_Nm_per_rad"])
        error = value["value"] - true[int(place[0]) - 1, int(place[1]) - 1]
        assert abs(error) < 4 * value["stderr"], name
    assert found["recording"] | {"sample_rate_hz": 0} == {
        "name": NASTY, "sample_rate_hz": 0, "perturbed": 10, "unperturbed": 6, "postures": 20,
    }  # fmt: skip
    np.testing.assert_allclose(found["hand_at_onset_m"], truth["hand_at_onset_m"], atol=1e-3)
    np.testing.assert_allclose(found["cutoff_hz"], [1.9, 2.2], atol=0.8)


def test_all_files_are_there(results: Path) -> None:
    names = {f"{name}.png" for name in FIGURES} | {"estimates.parquet", "summary.json", "report.html", ".jaximp"}
    assert {path.name for path in results.iterdir()} == names


def test_table_has_a_row_for_each_method(results: Path) -> None:
    table = pq.read_table(results / "estimates.parquet")
    rows = table.to_pylist()
    assert [row["method"] for row in rows] == ["feedback_jerk", "gomi_kawato"]
    assert rows[0]["stiffness_21"] == rows[0]["stiffness_12"]
    assert rows[1]["stiffness_21"] != rows[1]["stiffness_12"]
    words = {"damping_11_stderr", "vaf", "held_out_vaf", "verdict", "reason"}
    assert words | {f"{name}{ending}" for name in BASE_INERTIA for ending in ("", "_stderr")} <= set(rows[0])
    assert not [name for name in table.schema.names if re.fullmatch(r"inertia_\d.*|[DK]\d\d.*", name)]
    assert table.schema.field("stiffness_11").metadata[b"unit"] == b"N m/rad"


def test_a_name_of_the_inertia_is_one_quantity_in_both_tables(results: Path) -> None:
    """Windows of an arm have Lakatos's `inertia_1` to `inertia_3`; trials Börner's three, which are others."""
    of_trials = set(pq.read_table(results / "estimates.parquet").schema.names)
    of_windows = set(PlanarArm((0.0, 0.0)).names)
    assert not {name for name in of_trials & of_windows if "inertia" in name}
    damping_and_stiffness = {name for name in of_windows if "inertia" not in name}
    assert damping_and_stiffness <= of_trials


def test_summary_is_json(results: Path) -> None:
    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    found = json.loads((results / "summary.json").read_text(), parse_constant=refuse)
    assert [one["method"] for one in found["further_methods"]] == ["gomi_kawato"]
    lengths = [one["window_s"] for one in found["window_lengths"]]
    assert lengths == sorted(lengths)
    assert lengths[0] == pytest.approx(0.04)
    at = lengths.index(0.115)
    for name, value in found["parameters"].items():
        again = found["window_lengths"][at]["parameters"][name]
        assert again["value"] == pytest.approx(value["value"], rel=1e-6)
        assert again["stderr"] == pytest.approx(value["stderr"], rel=1e-6)


def test_report_is_self_contained_and_escaped(results: Path) -> None:
    page = (results / "report.html").read_text(encoding="utf-8")
    assert "default-src &#39;none&#39;" in page  # it may ask for nothing
    outside = re.sub(r"<script>.*?</script>", "", page, flags=re.S)
    assert not re.search(r"https?://|<link|<script src|@import|url\(", outside)
    assert "<script>alert(1)" not in page
    assert page.count('src="data:image/png;base64,') == len(FIGURES)
    assert "&lt;script&gt;alert(1)" in page
    assert "&lt;b&gt;bold" in page
    assert "8 to 23 % too large" in page


@pytest.mark.slow
def test_what_reading_says_is_said_once(arm: Path) -> None:
    job = read_job(arm / "job.toml")
    assert job.trials is not None
    methods = ["gomi_kawato", "erden_billard"]
    found = identify_trials(replace(job, trials=replace(job.trials, method=methods, window=0.15)))
    assert [note for note in found.notes if "jerk of the perturbations" in note]
    assert len(found.notes) == len(set(found.notes))
    assert any("longer than the voluntary delay" in warning for warning in found.main.warnings)
    assert not set(found.notes) & set(found.main.warnings)


def test_check_says_what_the_sensors_allow(arm: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert jaximp("check", arm / "job.toml") == 0
    said = capsys.readouterr().out
    assert "10 perturbed movements, 6 unperturbed ones" in said
    assert "20 perturbed postures" in said


# --- jobs that cannot be identified -----------------------------------------------------------------------------------

INERTIA = "{ upper_arm = 0.1945, forearm = 0.0737, coupling = 0.0838 }"
BAD_JOBS = {
    "no such method": ('"output_error"', '"feedback"', "did you mean 'feedback_jerk'"),
    "no method": ('"output_error"', "[]", "name at least one"),
    "one twice": ('"output_error"', '["gomi_kawato", "gomi_kawato"]', "each once"),
    "two inertias": ("[model.arm]", f"[model.arm]\ninertia = {INERTIA}", "keep one of them"),
    "an order nobody knows": ("[model.arm]", "[model.arm]\ninertia = [0.2, 0.07, 0.08]", "write inertia = { upper_arm"),
    "unknown key": ("[trials.posture]", "[trials.posture]\nmethod = 'x'", "[trials.posture] has an unknown key 'met"),
    "long posture": ("[trials.posture]", "[trials.posture]\nwindow = 2", "[trials.posture]: a window of 2 s"),
    "ms": ("[trials.posture]", "[trials.posture]\nwindow = 400", "trials.posture.window is 400 s: were millise"),
    "no file": ('file = "postures.csv"', "", "[trials.posture] needs either"),
    "file is gone": ("postures.csv", "none.csv", "none.csv"),
    "the movements' command": ("reference = ", "# reference = ", "command1_N"),
    "postures of postures": ("[trials.handle]", "task = 'posture'\n[trials.handle]", "belongs to movements"),
    "long window": ("window = 0.115", "window = 1.5", "1.5"),
}


@pytest.mark.parametrize("case", BAD_JOBS)
def test_bad_jobs_end_in_one_line(arm: Path, capsys: pytest.CaptureFixture[str], case: str) -> None:
    old, new, message = BAD_JOBS[case]
    text = (arm / "job.toml").read_text()
    assert old in text
    refused(arm, text.replace(old, new, 1), message, capsys)


def refused(arm: Path, text: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    (arm / "bad.toml").write_text(text)
    assert jaximp("identify", arm / "bad.toml", "--out", arm / "bad") == 1
    complained = capsys.readouterr().err
    assert complained.startswith("error: ")
    assert complained.strip().count("\n") == 0
    assert message in complained
    assert not (arm / "bad").exists()


def test_inertia_must_be_known(arm: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (arm / "job.toml").read_text()
    start, end = text.index("[trials.posture]"), text.index("[model.arm]")
    refused(arm, text[:start] + text[end:], "the arm's inertia is not known: add [trials.posture]", capsys)
    alone = text[:start].replace("movements.csv", "postures.csv").replace("command", "reference")
    alone = alone.replace("method =", 'task = "posture"\nmethod =')
    refused(arm, alone + text[end:], "a job of postures alone", capsys)


@pytest.fixture(scope="module")
def enough(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Simulated recordings from which output error learns enough."""
    folder = tmp_path_factory.mktemp("simulated") / "arm"
    assert jaximp("simulate", "arm", "--out", folder, "--perturbed", 16, "--unperturbed", 32) == 0
    return folder


@pytest.mark.slow
def test_the_method_that_comes_with_the_job_finds_the_truth(enough: Path) -> None:
    truth = json.loads((enough / "truth.json").read_text())
    assert jaximp("identify", enough / "job.toml", "--out", enough / "out") == 0
    found = json.loads((enough / "out" / "summary.json").read_text())
    assert (found["method"], found["verdict"], found["warnings"]) == ("output_error", TRUSTED, [])
    K, D = (np.array(truth[name]) for name in ("stiffness_Nm_per_rad", "damping_Nms_per_rad"))
    np.testing.assert_allclose(found["stiffness_Nm_per_rad"], K, atol=0.05 * K.max())
    np.testing.assert_allclose(found["damping_Nms_per_rad"], D, atol=0.05 * D.max())
    assert found["improved_inertia_kgm2"] == pytest.approx(truth["inertia_kgm2"], rel=0.05)
    assert abs(found["delay_s"]) < 1e-5
    row = pq.read_table(enough / "out" / "estimates.parquet").to_pylist()[0]
    assert (row["unperturbed"], row["misfit"]) == (32, found["misfit"])


@pytest.mark.slow
def test_given_inertia_without_errors_is_a_warning(enough: Path) -> None:
    text = (enough / "job.toml").read_text()
    start, end = text.index("[trials.posture]"), text.index("[model.arm]")
    job = parse_job(text[:start] + text[end:] + f"inertia = {INERTIA}\n", enough)
    found = identify_trials(job)
    assert found.static is None
    assert any("given without standard errors" in warning for warning in found.main.warnings)
    assert found.main.arm.inertia_stderr is None
    assert found.main.inertia == {"upper_arm_inertia": 0.1945, "forearm_inertia": 0.0737, "coupling_inertia": 0.0838}


@pytest.mark.slow
def test_draws_stand_around_what_was_identified(enough: Path) -> None:
    found = infer(read_job(enough / "job.toml"))
    assert isinstance(found, ArmInference)
    estimate = found.identified.main
    assert found.trusted == (estimate.verdict == "trusted"), found.why
    for name in ("damping_11", "stiffness_11", "stiffness_22"):
        low, high = found[name].interval(0.95)
        assert low < estimate[name].value < high
        assert found[name].stderr == pytest.approx(estimate[name].stderr, rel=0.4)
        assert found[name].unit == estimate[name].unit
    row = found.to_pandas().iloc[0]
    assert row["stiffness_11"] == found["stiffness_11"].value
    assert row["verdict"] == estimate.verdict


def lagging(milliseconds: float) -> Callable[[Trials], Trials]:
    """The command was written down so much too early."""
    return lambda m: eqx.tree_at(
        lambda m: m.command, m, jnp.roll(m.command, -round(milliseconds * m.sample_rate / 1e3), axis=1)
    )


SPOILT: dict[str, tuple[Callable[[Trials], Trials], Handle, str]] = {
    "another damping": (lambda m: m, Handle((5.0, 5.0), (10.0, 10.0)), "a mass of 5.00, 5.00 kg and a damping of 20.0"),
    "another mass": (lambda m: m, Handle((5.0, 6.0), (20.0, 20.0)), "the handle has a mass of 5.00, 5.00 kg"),
    "force of the other sign": (
        lambda m: eqx.tree_at(lambda m: m.force, m, -m.force), Handle((5.0, 5.0), (20.0, 20.0)), "check the sign",
    ),
    "command 4 ms late": (lagging(-4.0), Handle((5.0, 5.0), (20.0, 20.0)), "are of one instant"),
    "command 4 ms early": (lagging(4.0), Handle((5.0, 5.0), (20.0, 20.0)), "are of one instant"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("case", SPOILT)
def test_force_command_and_handle_must_agree(enough: Path, case: str) -> None:
    """Output error does not look at the force, and would believe a handle of another damping."""
    spoil, handle, reason = SPOILT[case]
    perturbed, unperturbed, _ = movements_of(enough)
    known = KnownArm(GEOMETRY, ARM.inertia, handle)
    found = identify_impedance(spoil(perturbed), unperturbed, known, "gomi_kawato")
    assert (found.verdict, found.trusted) == (POOR, False)
    assert reason in found.reason
    assert identify_impedance(perturbed, unperturbed, KnownArm(GEOMETRY, ARM.inertia), "gomi_kawato").trusted


@cache
def movements_of(folder: Path) -> tuple[Trials, Trials | None, tuple[str, ...]]:
    trials = read_job(folder / "job.toml").trials
    assert trials is not None
    return trials.load()


@pytest.mark.slow
def test_a_handle_that_is_a_little_wrong_is_a_warning(enough: Path) -> None:
    perturbed, unperturbed, _ = movements_of(enough)
    known = KnownArm(GEOMETRY, ARM.inertia, Handle((5.0, 5.0), (19.2, 19.2)))
    found = identify_impedance(perturbed, unperturbed, known, "gomi_kawato")
    assert found.trusted
    assert any("a damping of 20.0" in warning for warning in found.warnings)


@pytest.mark.slow
def test_an_offset_of_the_force_sensor_is_no_disagreement(enough: Path) -> None:
    perturbed, _, _ = movements_of(enough)
    moved = eqx.tree_at(lambda m: m.force, perturbed, perturbed.force + jnp.array([3.0, -2.0]))
    assert handle_disagreement(moved, Handle((5.0, 5.0), (20.0, 20.0)))[0] < 0.01


@pytest.mark.parametrize("method", ["output_error", "feedback_jerk"])
def test_methods_ask_for_the_handle(enough: Path, method: str) -> None:
    perturbed, unperturbed, _ = movements_of(enough)
    with pytest.raises(ValueError, match=r"state them in \[trials.handle\] of a job, or as KnownArm"):
        identify_impedance(perturbed, unperturbed, KnownArm(GEOMETRY, ARM.inertia), method)


@pytest.mark.slow
def test_a_moving_hand_does_not_pass_for_one_at_rest(enough: Path) -> None:
    perturbed, unperturbed, _ = movements_of(enough)
    found = identify_impedance(perturbed, unperturbed, KnownArm(GEOMETRY, ARM.inertia), "erden_billard")
    assert found.verdict == POOR
    assert re.search(r"moves at 0\.\d+ m/s at the onset, [\d.]+ mm in the window.*use output_error", found.reason)


def test_postures_inherit_columns() -> None:
    trials = read_trials("time = 't'\nreference = ['rx', 'ry']\ncommand = ['cx', 'cy']\n", "file = 'p.csv'\n")
    assert trials.mapping == {
        "time": "t", "position": ["x", "y"], "torque": ["fx", "fy"], "reference": ["rx", "ry"], "command": ["cx", "cy"],
    }  # fmt: skip
    assert (trials.task, trials.trial, trials.window) == ("posture", "which", 0.4)
    other = read_trials(
        "time = 't'\ncommand = ['cx', 'cy']\n", "files = ['p.csv']\nsample_rate = 500\nreference = ['rx', 'ry']\n"
    )
    assert other.mapping == {
        "position": ["x", "y"], "torque": ["fx", "fy"], "sample_rate": 500.0, "reference": ["rx", "ry"],
    }  # fmt: skip


def read_trials(movements: str, posture: str) -> Any:
    text = "[trials]\nfile = 'm.csv'\ntrial = 'which'\nposition = ['x', 'y']\ntorque = ['fx', 'fy']\n" + movements
    job = parse_job(f"{text}[trials.posture]\n{posture}[model.arm]\nlengths = [0.3, 0.3]\n")
    assert job.trials is not None
    assert [path.name for path in job.files()] == ["m.csv", "p.csv"]
    return job.trials.posture


# --- verdicts, each on joint deviations that are made for it ----------------------------------------------------------

D = np.array([[2.4, 1.2], [1.2, 1.4]])
K = np.array([[29.0, 14.0], [14.0, 17.0]])
GEOMETRY = ArmGeometry((0.29, 0.34))
ARM = KnownArm(GEOMETRY, np.array([0.1945, 0.0737, 0.0838]), inertia_stderr=np.array([1e-4, 1e-4, 1e-4]))
SAMPLES = 60
Identify = Callable[..., ArmImpedance]


def movements(trials: int) -> Trials:
    """A hand that rests."""
    zero = jnp.zeros((trials, SAMPLES, 2))
    return Trials(
        zero + jnp.array([0.0, 0.4]), zero, zero, zero, zero, jnp.zeros(trials, int), SAMPLES / 0.115
    )  # fmt: skip


@pytest.fixture
def identified(monkeypatch: pytest.MonkeyPatch) -> Identify:
    """Identify made-up joint deviations: D and K of each trial, with noise of a share of the torque."""

    def identify(
        trials: int = 10,
        D: np.ndarray = D,
        K: np.ndarray = K,
        noise: float = 0.02,
        pitch: float = 3.0,
        arm: KnownArm = ARM,
        own: Impedance | None = None,
        linearised: bool = False,
        window: float = 0.115 - 0.115 / SAMPLES,
        limits: TrustLimits | None = None,
        flat: bool = False,
    ) -> ArmImpedance:
        rng = np.random.default_rng(3)
        t = np.linspace(0, 1, SAMPLES)[:, None]
        ways = rng.normal(size=(trials, 1, 2))
        ways = np.broadcast_to(ways[:1], ways.shape) if flat else ways
        displacement = 0.01 * ways * t**2 * (1 - t / 2)
        velocity = 0.01 * ways * (2 * t - 1.5 * t**2) / 0.115
        torque = np.einsum("tij,tsj->tsi", np.broadcast_to(D, (trials, 2, 2)), velocity)
        torque += np.einsum("tij,tsj->tsi", np.broadcast_to(K, (trials, 2, 2)), displacement)
        torque += noise * torque.std() * rng.normal(size=(trials, 1, 2)) * np.sin(pitch * t)
        joint = JointDeviations(*map(jnp.asarray, (displacement, velocity, torque)))
        zero = jnp.zeros((trials, SAMPLES, 2))
        isolated = Isolated(Deviations(zero, zero, zero, zero), impedance=own)
        monkeypatch.setattr(fit, "joint_deviations", lambda *_: joint)
        monkeypatch.setitem(METHODS, "made_up", Method("MAD", "made up", lambda *_: isolated, linearised))
        return identify_impedance(movements(trials), None, arm, "made_up", window, limits=limits or TrustLimits())

    return identify


def test_good_trials_are_trusted(identified: Identify) -> None:
    found = identified()
    assert (found.verdict, found.reason, found.warnings) == (TRUSTED, "", ())
    np.testing.assert_allclose(found.D, D, atol=0.1)
    np.testing.assert_allclose(found.K, K, atol=2)
    elements = PlanarArm((0.0, 0.0), inertia=False).names
    assert identified(linearised=True).names == elements
    assert found.names == tuple(name for name in elements if name != "stiffness_21")
    assert found.held_out_vaf < found.vaf <= 1
    low, high = found.interval()
    assert ((low < found.theta) & (found.theta < high)).all()


def test_errors_of_the_inertia_widen_the_interval(arm: Path) -> None:
    job = read_job(arm / "job.toml")
    assert job.trials is not None
    perturbed, unperturbed, _ = job.trials.load()
    several = []
    for share in (1e-9, 0.03, 0.06):
        known = KnownArm(GEOMETRY, ARM.inertia, inertia_stderr=share * np.asarray(ARM.inertia))
        several.append(identify_impedance(perturbed, unperturbed, known, "gomi_kawato").covariance)
    np.testing.assert_allclose(several[2] - several[0], 4 * (several[1] - several[0]), rtol=1e-4, atol=1e-6)
    assert several[1][4, 4] > 1.05 * several[0][4, 4]


def of_trials(matrix: np.ndarray, spread: float, trials: int = 10) -> np.ndarray:
    """A matrix for each trial, alternately larger and smaller."""
    return matrix * (1 + spread * np.where(np.arange(trials) % 2, 1, -1))[:, None, None]


def own(
    D: np.ndarray = D,
    K: np.ndarray = K,
    error: float = 0.02,
    dof: float = 30.0,
    misfit: float = 1.0,
    converged: bool = True,
    delay: float = 0.0,
    trend: float = 0.0,
) -> Impedance:
    """What a method of its own says."""
    sizes = np.array([2.4] * 4 + [29.0] * 3)
    found = (D, K, np.diag((error * sizes) ** 2), ARM.inertia, dof, misfit, converged, delay, np.full(3, trend))
    return Impedance(*map(jnp.asarray, found))


LOOSE = TrustLimits(max_relative_stderr=100.0)
INDEFINITE = np.array([[29.0, 25.0], [25.0, 17.0]])
CASES: dict[str, tuple[dict[str, Any], str, str]] = {
    "co-linear": ({"flat": True}, WEAK, "there is no estimate: velocities and displacements are co-linear"),
    "not finite": ({"K": K * np.nan}, NO_DATA, "a number is not finite: look for gaps"),
    "few trials": ({"trials": 4}, WEAK, "cannot be judged: 4 perturbed trials are too few"),
    "loud": ({"noise": 3.0}, WEAK, "is [0-9.]+ % of the size of the (stiffness|damping), above 20 %: perturb more"),
    "indefinite": ({"K": INDEFINITE}, POOR, r"indefinite stiffness \(an eigenvalue of -[0-9.]+ N m/rad\)"),
    "indefinite, free": ({"K": INDEFINITE, "linearised": True}, POOR, "indefinite stiffness"),
    "driving": ({"D": D - 2.0 * np.eye(2)}, POOR, "damping is not positive definite: an eigenvalue of -"),
    "unexplained": (
        {"noise": 1.0, "pitch": 60.0, "limits": LOOSE},
        POOR,
        "account for [0-9.]+ % of the isolated torque, less than 75 %",
    ),
    "no body": (
        {"arm": KnownArm(GEOMETRY, np.array([0.01, 0.0737, 0.0838]), inertia_stderr=np.full(3, 1e-4))},
        POOR,
        "no rigid body has the inertia upper_arm_inertia = 0.01, forearm_inertia = 0.0737, coupling_inertia = 0.0838",
    ),
    "own": ({"own": own()}, TRUSTED, ""),
    "own, misfit": ({"own": own(misfit=1.7)}, POOR, "1.7 times what the unperturbed movements let expect.*timing"),
    "own, loud": ({"own": own(error=0.4)}, WEAK, "perturb more"),
    "own, few": ({"own": own(dof=2.0)}, WEAK, "2 degrees of freedom are too few"),
    "own, indefinite": ({"own": own(K=INDEFINITE)}, POOR, "indefinite stiffness"),
    "own, failed": ({"own": own(K=K * np.nan)}, NO_DATA, "a number is not finite"),
    "own, restless": ({"own": own(converged=False)}, POOR, "did not converge: shorten the window"),
    "own, late": ({"own": own(converged=False, delay=0.01)}, POOR, "lag its command by 9 ms or more: record force and"),
    "own, misfit and loud": ({"own": own(error=0.4, misfit=1.7)}, POOR, "1.7 times"),
    "own, without errors": ({"own": own(error=np.nan)}, WEAK, "cannot be judged"),
}


@pytest.mark.parametrize("case", CASES)
def test_verdicts_name_cause_and_remedy(identified: Identify, case: str) -> None:
    options, verdict, reason = CASES[case]
    found = identified(**options)
    assert found.verdict == verdict, found.reason
    assert re.search(reason, found.reason)
    assert "\n" not in found.reason


def test_nothing_is_trusted_that_was_not_judged(identified: Identify) -> None:
    """The verdict is no field: whoever puts other numbers in its place gets their verdict."""
    found = identified()
    assert found.trusted
    with pytest.raises(TypeError, match="verdict"):
        replace(found, verdict=TRUSTED)
    with pytest.raises(AttributeError):
        found.verdict = TRUSTED  # type: ignore[misc]
    assert replace(found, covariance=1e4 * found.covariance).verdict == WEAK
    assert replace(found, theta=-found.theta).verdict == POOR
    assert replace(found, evidence=replace(found.evidence, failure="a number is not finite")).verdict == NO_DATA
    assert replace(found, limits=TrustLimits(min_vaf=1.0)).verdict == POOR
    assert not hasattr(ArmEstimate, "verdict")


def test_half_of_the_trials_must_predict_the_others(identified: Identify) -> None:
    options: dict[str, Any] = {"D": of_trials(D, 0.3), "K": of_trials(K, 0.3), "noise": 0.0}
    found = identified(**options)
    assert found.held_out_vaf < found.vaf - 0.02
    between = TrustLimits(min_vaf=(found.held_out_vaf + found.vaf) / 2, max_relative_stderr=100.0)
    judged = identified(**options, limits=between)
    assert judged.verdict == POOR
    assert "half of the trials predicts" in judged.reason


def test_limits_of_output_error_are_said(identified: Identify) -> None:
    found = identified(own=own(trend=-0.6))
    assert found.trusted
    assert any("0 unperturbed movements teach little" in warning for warning in found.warnings)
    assert any("change by 60 % within the window" in warning for warning in found.warnings)


def test_warnings_leave_the_verdict(identified: Identify) -> None:
    lopsided = K + np.array([[0, 8.0], [-8.0, 0]])
    found = identified(K=lopsided, linearised=True, arm=KnownArm(GEOMETRY, ARM.inertia), window=0.2)
    assert found.verdict == TRUSTED
    for words in ("the window of 200 ms is longer", "without standard errors", "stiffness is not symmetric"):
        assert any(words in warning for warning in found.warnings)


def test_a_bias_that_is_known_is_not_believed(identified: Identify, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(BIASES, "made_up", ("the stiffness has a bias", "use output_error"))
    found = identified()
    assert (found.verdict, found.reason, found.warnings) == (POOR, "the stiffness has a bias: use output_error", ())
    few = identified(trials=4)
    assert few.verdict == WEAK
    assert "the stiffness has a bias" in few.warnings


def test_a_method_of_its_own_has_no_other_windows(identified: Identify) -> None:
    identified(own=own())
    assert at_other_windows(movements(10), None, ARM, "made_up", 0.05) is None


def test_unknown_methods_are_named() -> None:
    with pytest.raises(ValueError, match=r"there is no method 'gomi_kavato': did you mean 'gomi_kawato'"):
        identify_impedance(movements(5), None, ARM, "gomi_kavato")
