"""An arm that is perturbed: trials, isolation of the involuntary answer, damping and stiffness."""
