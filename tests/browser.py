"""A real browser for tests and benchmarks: Chromium without a window, driven through two pipes."""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
MOST_EVENTS, BETWEEN = 10_000, 0.02
"""Messages before an answer, and seconds from one look at the page to the next."""
# The browser reads commands from file 3 and answers on file 4; neither may be overwritten while the other moves there.
START = "import os,sys;r,w=map(int,sys.argv[1:3]);r,w=os.dup(r),os.dup(w);os.dup2(r,20);os.dup2(w,21);\
os.dup2(20,3);os.dup2(21,4);os.execv(sys.argv[3],sys.argv[3:])"


def executable() -> str | None:
    """The browser of this machine, if there is one."""
    return os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)


class Browser:
    """One page of a browser, by the DevTools protocol: JSON messages with a zero byte after each."""

    def __init__(self, process: subprocess.Popen[bytes], commands: int, answers: int, limit: float) -> None:
        self.process, self.limit = process, limit
        self._commands, self._answers = commands, answers
        self._buffer, self._count = b"", 0
        self.events: list[dict[str, Any]] = []
        """Everything that happened in the page since it was opened."""
        target = self._call("Target.createTarget", {"url": "about:blank"}, None)["targetId"]
        self._session = self._call("Target.attachToTarget", {"targetId": target, "flatten": True}, None)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **arguments: Any) -> dict[str, Any]:
        """A command to the page, and its answer."""
        return self._call(method, arguments, self._session)

    def _call(self, method: str, arguments: dict[str, Any], session: str | None) -> dict[str, Any]:
        self._count += 1
        message = {"id": self._count, "method": method, "params": arguments}
        if session is not None:
            message["sessionId"] = session
        os.write(self._commands, json.dumps(message).encode() + b"\0")
        for _ in range(MOST_EVENTS):
            if (answer := self._next()).get("id") == self._count:
                break
            self.events.append(answer)
        else:
            raise TimeoutError(f"{method}: no answer among {MOST_EVENTS} messages of the browser")
        if "error" in answer:
            raise RuntimeError(f"{method}: {answer['error']}")
        result: dict[str, Any] = answer["result"]
        return result

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            if not select.select([self._answers], [], [], self.limit)[0]:
                raise TimeoutError(f"the browser was silent for {self.limit:g} s")
            more = os.read(self._answers, 1 << 20)
            if not more:
                raise RuntimeError("the browser ended")
            self._buffer += more
        message, _, self._buffer = self._buffer.partition(b"\0")
        found: dict[str, Any] = json.loads(message)
        return found

    def open(self, address: str) -> None:
        """Load a page anew; what happened before is forgotten."""
        self.call("Page.navigate", url="about:blank")
        self.wait("location.href === 'about:blank'")
        self.events.clear()
        self.call("Page.navigate", url=address)
        self.wait("location.href !== 'about:blank' && document.readyState === 'complete'")

    def evaluate(self, expression: str) -> Any:
        """The value of a JavaScript expression in the page."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(f"{expression}: {answer['exceptionDetails']}")
        return answer["result"].get("value")

    def wait(self, condition: str) -> None:
        """Until an expression holds."""
        for _ in range(round(self.limit / BETWEEN)):
            if self.evaluate(f"Boolean({condition})"):
                return
            time.sleep(BETWEEN)
        raise TimeoutError(f"{condition} did not come true within {self.limit:g} s")

    def frame(self) -> None:
        """Wait until the page has been drawn with all changes so far."""
        self.evaluate("new Promise(done => requestAnimationFrame(() => setTimeout(done)))")

    def press(self, key: str, code: int) -> None:
        """A key, by its name and its Windows key code."""
        about = {"key": key, "code": key, "windowsVirtualKeyCode": code}
        if key == "Enter":
            about["text"] = "\r"
        self.call("Input.dispatchKeyEvent", type="keyDown", **about)
        self.call("Input.dispatchKeyEvent", type="keyUp", **about)
        self.frame()

    def size(self, width: int, height: int) -> None:
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 600
        )

    def screenshot(self, path: Path) -> None:
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))

    def complaints(self) -> list[str]:
        """What the page said in the console, errors of scripts, and what its policy kept from happening."""
        found = []
        for event in self.events:
            if event["method"] in ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded"):
                found.append(json.dumps(event["params"]))
            if event["method"] == "Page.javascriptDialogOpening":
                found.append(f"dialog: {event['params']['message']}")
        return found

    def requests(self) -> list[str]:
        """Addresses that the page asked for."""
        return [
            event["params"]["request"]["url"] for event in self.events if event["method"] == "Network.requestWillBeSent"
        ]


@contextmanager
def browser(limit: float = 30) -> Iterator[Browser]:
    """A browser with a profile of its own, which ends with the block; `limit` seconds for each answer.

    **Raises:** `RuntimeError` if there is none on this machine.
    """
    program = executable()
    if program is None:
        raise RuntimeError(f"there is no browser here: install one of {', '.join(NAMES)}, or set CHROMIUM to its path")
    command_end, commands = os.pipe()
    answers, answer_end = os.pipe()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        switches = ["--headless", "--remote-debugging-pipe", f"--user-data-dir={profile}", "--disable-gpu"]
        switches += ["--no-first-run", "--disable-extensions", "--disable-dev-shm-usage", "--hide-scrollbars"]
        if os.geteuid() == 0:
            switches.append("--no-sandbox")  # which root cannot have
        process = subprocess.Popen(
            [sys.executable, "-c", START, str(command_end), str(answer_end), program, *switches],
            pass_fds=(command_end, answer_end),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(command_end)
        os.close(answer_end)
        try:
            yield Browser(process, commands, answers, limit)
        finally:
            os.close(commands)
            os.close(answers)
            process.terminate()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
