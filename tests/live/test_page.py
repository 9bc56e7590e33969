"""Alarms, and the live page in a real browser while samples come."""

from __future__ import annotations

import json
import urllib.error
import urllib.request
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import browser as browsers
from factories.recordings import matches
from jaximp.live.alarms import Alarm, parse_rule
from jaximp.live.monitor import Update
from jaximp.live.page import MOST_VIEWERS, MOST_WAITING, Page
from jaximp.trust.verdicts import NO_DATA, TRUSTED, WEAK, Verdict

NAMES = ("damping", "stiffness")


def update(time: float, stiffness: float = 20.0, stderr: float = 1.0, label: str = TRUSTED, **more: Any) -> Update:
    value, spread = np.array([1.5, stiffness]), np.array([0.1, stderr])
    return Update(
        time, time - 0.1, Verdict(label, more.pop("reason", ""), ""), NAMES, ("N m s/rad", "N m/rad"), value, spread,
        value - 2 * spread, value + 2 * spread, residual=0.1, surprise=1.0, excitation=np.array([100.0, 2.0]), **more,
    )  # fmt: skip


# ---- Alarms.


def test_an_alarm_is_raised_once_its_time_is_full_and_again_after_it_was_past() -> None:
    alarm = Alarm(parse_rule("stiffness > 30 for 2 s with 99 %", NAMES))
    raised = [
        t for t in np.arange(0, 20, 0.5).tolist() if alarm.take(update(t, 40.0 if 3 <= t < 8 or t >= 12 else 20.0))
    ]
    assert raised == [5.0, 14.0]
    assert alarm.raised


@pytest.mark.parametrize(
    ("rule", "stiffness", "stderr", "label", "holds"),
    [
        ("stiffness > 30", 32.0, 1.0, TRUSTED, True),
        ("stiffness > 30 with 99 %", 32.0, 1.0, TRUSTED, False),
        ("stiffness > 30 with 99%", 32.4, 1.0, WEAK, True),
        ("stiffness < 3e1", 20.0, 1.0, TRUSTED, True),
        ("damping < 1", 20.0, 1.0, TRUSTED, False),
        ("stiffness < 30", 20.0, 1.0, NO_DATA, False),
    ],
)
def test_an_alarm_knows_the_band(rule: str, stiffness: float, stderr: float, label: str, holds: bool) -> None:
    assert parse_rule(rule, NAMES).holds(update(0.0, stiffness, stderr, label)) == holds


@pytest.mark.parametrize("text", ["stiffness", "stiffness >", "stiffness > 1 with 100 %", "a > b", "stiffness > 1.2.3"])
def test_what_is_no_alarm_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=matches("write one like 'stiffness > 80 for 2 s with 99 %'")):
        parse_rule(text, NAMES)
    with pytest.raises(ValueError, match=matches("did you mean 'stiffness'?")):
        parse_rule("stifness > 1", NAMES)


# ---- The page.


@pytest.fixture
def page() -> Iterator[tuple[Page, list[tuple[str, str]]]]:
    asked: list[tuple[str, str]] = []

    def do(action: str, text: str) -> dict[str, Any]:
        asked.append((action, text))
        return {"paused": True} if action == "pause" else {}

    shown = Page(do, about=lambda: {"alarms": ["stiffness > 30"], "counts": "9 samples received"})
    yield shown, asked
    shown.close()


def ask(address: str, body: bytes | None = None) -> tuple[int, bytes]:
    try:
        with urllib.request.urlopen(urllib.request.Request(address, body), timeout=10) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read()


def test_who_does_not_know_the_token_gets_nothing(page: tuple[Page, list[tuple[str, str]]]) -> None:
    shown, asked = page
    base = f"http://127.0.0.1:{shown.port}/"
    assert ask(shown.address)[0] == 200
    for path in ("", "?token=", "?token=wrong", "events", "events?token=wrong"):
        assert ask(base + path)[0] == 403
    for path, body in [("do", b"{}"), ("do?token=wrong", b'{"action": "stop"}')]:
        assert ask(base + path, body)[0] == 403
    token = f"?token={shown.token}"
    assert ask(base + "do" + token, b"no json")[0] == 400
    assert ask(base + "do" + token, b"{}")[0] == 400
    assert ask(base + "do" + token, b"x" * 10000)[0] == 400
    assert ask(base + "other" + token)[0] == 404
    assert asked == []
    assert json.loads(ask(base + "do" + token, b'{"action": "pause"}')[1]) == {"paused": True}
    assert asked == [("pause", "")]


def test_a_port_that_is_taken_is_one_line(page: tuple[Page, list[tuple[str, str]]]) -> None:
    with pytest.raises(ValueError, match=matches("choose another port")):
        Page(lambda action, text: {}, page[0].port)


def test_a_browser_that_does_not_read_misses_updates_and_holds_nobody_up(
    page: tuple[Page, list[tuple[str, str]]],
) -> None:
    shown = page[0]
    viewers = [shown._join() for _ in range(MOST_VIEWERS)]
    assert None not in viewers
    assert shown._join() is None
    for k in range(MOST_WAITING + 7):
        shown.write(update(k))
    assert shown.dropped == 7 * MOST_VIEWERS
    shown._viewers.clear()


@pytest.mark.skipif(browsers.executable() is None, reason="there is no browser here")
def test_the_page_in_a_browser(page: tuple[Page, list[tuple[str, str]]]) -> None:
    shown, asked = page
    with browsers.browser() as browser:
        for k in range(25):  # a browser that comes late sees what was before
            shown.write(update(0.1 * k, 20 + 0.1 * k))
        browser.open(shown.address)
        browser.wait("document.body.dataset.drawn === '2.4000000000000004'")
        for k in range(25, 50):
            shown.write(update(0.1 * k, 20 + 0.1 * k))
        shown.mark(2.0, "pushed")
        weak = {"label": WEAK, "reason": "stiffness: its standard error is 40% of its size"}
        shown.write(update(5.0, 25.0, **weak, advice="move farther"))
        browser.wait("document.body.dataset.drawn === '5'")
        said = browser.evaluate("document.body.innerText")
        for text in ("weak excitation", "move farther", "stiffness [N m/rad]", "25.00 ± 2.0", "9 samples received"):
            assert text in said, said
        assert browser.evaluate("document.getElementById('alarms').textContent") == "stiffness > 30"
        assert browser.evaluate("document.querySelectorAll('section').length") == 2
        drawn = "(c => c.getContext('2d').getImageData(0, 0, c.width, c.height).data.some(x => x))"
        assert browser.evaluate(f"[...document.querySelectorAll('canvas')].every({drawn})")
        browser.evaluate("document.getElementById('what').value = '<b>tap</b>'")
        browser.evaluate("document.getElementById('mark').click()")
        browser.evaluate("document.getElementById('pause').click()")
        browser.wait("document.getElementById('pause').textContent === 'Start'")
        assert ("mark", "<b>tap</b>") in asked
        shown.close()
        browser.wait("document.getElementById('stop').disabled")
        assert "the monitor has ended" in browser.evaluate("document.body.innerText")
        assert browser.complaints() == []
        assert all(
            address.startswith(f"http://127.0.0.1:{shown.port}/")
            for address in browser.requests()
            if address != "about:blank"
        )
