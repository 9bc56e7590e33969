"""Records of three parameters and trials of an arm, and densities of both."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import numpy as np
from numpy.typing import NDArray

from jaximp import signals
from jaximp.perturbation.stiffness import residual_triangle
from jaximp.posterior.densities import STIFFNESS, Density, stiffness_density
from jaximp.posterior.priors import make_prior

Numbers = NDArray[np.float64]
NAMES, UNITS = ("inertia", "damping", "stiffness"), ("kg m^2", "N m s/rad", "N m/rad")
THETA = np.array([0.1, 1.5, 20.0])
LOW_PASS = signals.butterworth(4, 5.0, 1000.0)
BAND_PASS = np.concatenate([LOW_PASS, signals.butterworth(2, 0.5, 1000.0, "highpass")])
DAMPING, STIFF = np.array([[2.4, 1.2], [1.0, 1.4]]), np.array([[29.05, 14.37], [14.37, 17.08]])


def record(n: int = 60, noise: float = 0.3, seed: int = 0) -> tuple[Numbers, Numbers]:
    """Regressor (n, 3) and torque (n,)."""
    random = np.random.default_rng(seed)
    W = random.normal(size=(n, 3)) * [10, 1, 0.1]
    return W, W @ THETA + noise * random.normal(size=n)


def pulses(seed: int = 0, n: int = 300, noise: float = 0.1) -> tuple[Numbers, Numbers, Numbers]:
    """Displacement, velocity and torque (n, 2)."""
    random = np.random.default_rng(seed)
    displacement, velocity = 0.05 * random.normal(size=(n, 2)), random.normal(size=(n, 2))
    return displacement, velocity, velocity @ DAMPING.T + displacement @ STIFF.T + noise * random.normal(size=(n, 2))


def arm_density(**prior: Any) -> Density:
    return stiffness_density(residual_triangle(*pulses()), 300, make_prior((*STIFFNESS, "log_noise"), prior))


# Compiled once for all densities that are made alike.


@eqx.filter_jit
def value(density: Density, theta: Any) -> Any:
    return density(theta)


@eqx.filter_jit
def gradient(density: Density, theta: Any) -> Any:
    return jax.grad(density)(theta)
