"""Reference motions: Fourier series, minimum jerk, perturbations."""
