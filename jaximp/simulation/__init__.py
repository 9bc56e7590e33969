"""Simulated experiments with known ground truth: the rig of Tout et al. 2023."""
