"""What a set of trials tells: the arm's impedance by one method or several, and what stands beside it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from jaximp.perturbation.impedance import ArmImpedance
from jaximp.perturbation.static import StaticFit
from jaximp.perturbation.window_lengths import OtherWindows
from jaximp.types import Numbers


@dataclass(frozen=True)
class TrialsResult:
    """What perturbed trials tell of an arm."""

    estimates: tuple[ArmImpedance, ...]
    """By every method that was asked for, the main one first."""
    windows: OtherWindows | None
    """By the main method, from other windows."""
    spectra: tuple[Numbers, Numbers, Numbers] | None
    """Of the jerk, where there are unperturbed trials: `energy_spectra`."""
    static: StaticFit | None
    """What trials of the static task tell, where there were some."""
    postures: int = 0
    """Trials of the static task."""
    notes: tuple[str, ...] = ()
    """What reading the trials says."""

    @property
    def main(self) -> ArmImpedance:
        return self.estimates[0]

    def __len__(self) -> int:
        return len(self.estimates)

    def __getitem__(self, k: int) -> ArmImpedance:
        """By the k-th method."""
        return self.estimates[k]

    def __iter__(self) -> Iterator[ArmImpedance]:
        return iter(self.estimates)
