"""Alarms: what somebody wants to be told of, such as `stiffness > 80 for 2 s with 99 %`."""

from __future__ import annotations

import re
from dataclasses import dataclass
from statistics import NormalDist

from jaximp.live.judging import WARMING_UP
from jaximp.live.monitor import Update
from jaximp.trust.verdicts import NO_DATA
from jaximp.types import nearest

PATTERN = re.compile(
    r"\s*(?P<name>\w+)\s*(?P<sign>[<>])\s*(?P<limit>[-+.\deE]+)"
    r"(\s+for\s+(?P<seconds>[.\d]+)\s*s)?(\s+with\s+(?P<share>[.\d]+)\s*%)?\s*"
)
USUAL = 95.0
"""Per cent of probability, where a rule names none."""


@dataclass(frozen=True)
class Rule:
    """When to raise it."""

    text: str
    name: str
    above: bool
    limit: float
    seconds: float
    probability: float

    def holds(self, update: Update) -> bool:
        """Whether the parameter is beyond the limit, as probably as the rule wants it. Without data nobody knows."""
        if update.value is None or update.stderr is None or update.verdict.label in (NO_DATA, WARMING_UP):
            return False
        k = update.names.index(self.name)
        spread = max(float(update.stderr[k]), 1e-300)
        beyond = (float(update.value[k]) - self.limit) / spread * (1 if self.above else -1)
        return NormalDist().cdf(beyond) >= self.probability


def parse_rule(text: str, names: tuple[str, ...]) -> Rule:
    """A rule in words, about one of these parameters.

    **Raises:** `ValueError` for anything else.
    """
    found = PATTERN.fullmatch(text)
    try:
        if found is None:
            raise ValueError
        limit, seconds, share = (
            float(found[key] or usual) for key, usual in (("limit", 0), ("seconds", 0), ("share", USUAL))
        )
        if not 50 <= share < 100:
            raise ValueError
    except ValueError:
        raise ValueError(
            f"'{text}' is no alarm: write one like 'stiffness > 80 for 2 s with 99 %', with 50 to below 100 %"
        ) from None
    if found["name"] not in names:
        raise ValueError(f"the alarm '{text}' has an unknown parameter: {nearest(found['name'], list(names))}")
    return Rule(text.strip(), found["name"], found["sign"] == ">", limit, seconds, share / 100)


class Alarm:
    """A rule, and since when it holds."""

    def __init__(self, rule: Rule):
        self.rule, self.raised = rule, False
        self._since: float | None = None

    def take(self, update: Update) -> bool:
        """Whether it is raised just now: once, until it no longer holds."""
        if not self.rule.holds(update):
            self._since, self.raised = None, False
            return False
        if self._since is None or update.time < self._since:
            self._since = update.time
        now = update.time - self._since >= self.rule.seconds
        new, self.raised = now and not self.raised, now
        return new
