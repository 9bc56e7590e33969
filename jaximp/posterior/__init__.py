"""Posteriors: densities, priors, draws, diagnostics, files."""
