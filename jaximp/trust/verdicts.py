"""Verdicts: one plain word, its reason and its remedy; and the rules that make them, whatever is judged.

A rule is a row that can be read aloud: what is broken, the word for it, why, and what to do. The first rule that an
estimate breaks gives its verdict; one that breaks none is trusted. Nothing else makes a verdict.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from jaximp.trust.limits import TrustLimits

TRUSTED, WEAK, POOR, NO_DATA, FAKE = "trusted", "weak excitation", "poor fit", "no data", "fake change"
VERDICTS = (TRUSTED, WEAK, FAKE, POOR, NO_DATA)
UNCONVERGED = "draws not to be trusted"
"""Of posteriors alone."""


class Verdict(NamedTuple):
    """One plain word, and what is behind it."""

    label: str
    """One of `VERDICTS`, or `UNCONVERGED`."""
    reason: str
    """Cause with its measured number; empty where the estimate is trusted."""
    remedy: str
    """What to do about it, where something can be done."""

    def in_words(self) -> str:
        """Cause and remedy; empty where the estimate is trusted."""
        return f"{self.reason}: {self.remedy}" if self.remedy else self.reason


@runtime_checkable
class Judged(Protocol):
    """Measured numbers of M estimates, or of one."""

    def one(self, k: int) -> Any:
        """Those of one estimate."""


E = TypeVar("E")


def _nothing(evidence: Any, limits: TrustLimits) -> str:
    return ""


@dataclass(frozen=True)
class Rule(Generic[E]):
    """What an estimate must not be. All functions take the evidence, the numbers that were measured, and the limits."""

    name: str
    """What an estimate should be."""
    label: str
    """The verdict on an estimate that is not."""
    broken: Callable[[E, TrustLimits], Any]
    """Which of M estimates, or whether the one."""
    reason: Callable[[E, TrustLimits], str]
    """Of one estimate."""
    remedy: Callable[[E, TrustLimits], str] = _nothing


def judge_one(rules: Sequence[Rule[E]], evidence: E, limits: TrustLimits) -> Verdict:
    """The verdict on one estimate."""
    for rule in rules:
        if rule.broken(evidence, limits):
            return Verdict(rule.label, rule.reason(evidence, limits), rule.remedy(evidence, limits))
    return Verdict(TRUSTED, "", "")


@dataclass(frozen=True)
class Verdicts:
    """Verdicts on M estimates."""

    verdict: NDArray[Any]
    """(M,) labels, each one of `VERDICTS`."""
    reason: NDArray[Any]
    """(M,) cause and remedy in a sentence; empty where the estimate is trusted."""
    rule: NDArray[Any]
    """(M,) name of the rule that was broken; empty where none was."""

    @property
    def trusted(self) -> NDArray[np.bool_]:
        return self.verdict == TRUSTED

    def __len__(self) -> int:
        return len(self.verdict)

    def __getitem__(self, which: Any) -> Verdicts:
        """Those of some estimates."""
        return Verdicts(self.verdict[which], self.reason[which], self.rule[which])

    def counts(self) -> dict[str, int]:
        """How many estimates got each verdict."""
        return {verdict: int((self.verdict == verdict).sum()) for verdict in VERDICTS}

    def complaint(self, kind: str = "window") -> str:
        """Where nothing can be trusted, what is said of the first that has the most frequent verdict; else empty.

        **Arguments:** `kind`, what is judged."""
        if self.trusted.any() or not len(self.verdict):
            return ""
        counts = self.counts()
        first = int(np.argmax(self.verdict == max(counts, key=lambda name: counts[name])))
        return f"no {kind} can be trusted, for example: {self.reason[first]}"


def judge_all(rules: Sequence[Rule[Any]], evidence: Judged, limits: TrustLimits) -> Verdicts:
    """The verdicts on M estimates; words are only made for those that need them."""
    broken = np.stack([rule.broken(evidence, limits) for rule in rules])
    first = np.where(broken.any(axis=0), broken.argmax(axis=0), len(rules))
    label = np.array([*(rule.label for rule in rules), TRUSTED])[first]
    name = np.array([*(rule.name for rule in rules), ""])[first]
    words = [""] * len(first)
    for k in np.flatnonzero(first < len(rules)):
        rule, one = rules[first[k]], evidence.one(int(k))
        words[k] = Verdict(rule.label, rule.reason(one, limits), rule.remedy(one, limits)).in_words()
    return Verdicts(label, np.array(words), name)


def worst(several: Sequence[Verdicts], labels: Sequence[str]) -> Verdicts:
    """The worst verdict of several on the same windows, its reason behind a label."""
    severity = {verdict: rank for rank, verdict in enumerate((TRUSTED, POOR, FAKE, WEAK, NO_DATA))}
    ranks = np.array([[severity[name] for name in one.verdict] for one in several])
    chosen = ranks.argmax(axis=0)
    verdict = [several[j].verdict[k] for k, j in enumerate(chosen)]
    reason = ["" if verdict[k] == TRUSTED else labels[j] + several[j].reason[k] for k, j in enumerate(chosen)]
    rule = [several[j].rule[k] for k, j in enumerate(chosen)]
    return Verdicts(np.array(verdict), np.array(reason), np.array(rule))
