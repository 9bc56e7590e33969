"""The state at the onset in place of the unperturbed movement: Erden and Billard 2015."""

from __future__ import annotations

from jaximp.perturbation.deviations import Deviations, KnownArm
from jaximp.perturbation.isolation.isolated import Isolated
from jaximp.perturbation.trials import VOLUNTARY_DELAY, Trials, in_window, window_samples


def state_at_onset(
    perturbed: Trials, unperturbed: Trials | None, arm: KnownArm, window: float = VOLUNTARY_DELAY
) -> Isolated:
    """The unperturbed hand stays where it was at the onset, with the force that it had there, and does not move.

    **Source:** Erden and Billard 2015, as in Börner et al. 2020, 1.1; meant for postures and slow work.
    """
    seen = in_window(perturbed, window_samples(perturbed, window))
    return Isolated(
        Deviations(
            seen.position[:, :1] - seen.position, -seen.velocity, -seen.acceleration, seen.force[:, :1] - seen.force
        )
    )
