"""jaximp: mechanical impedance of human joints and arms, and the dynamics of the robots that hold them.

`__init__.pyi` lists the public names and where they are defined; each is imported when it is first used.
"""

from typing import Any

import lazy_loader

__version__ = "0.1.0"

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

MOVED = {
    "design": "Encoder Perturbations design_perturbations",
    "identification": "FilterSettings",
    "jobs": "infer_recording infer_trials",
    "least_squares": "Noise RecursiveFit SlidingFit WindowFit fit_noise joined sliding_theta whiten",
    "motion": "FourierSeries MinimumJerk RaisedSine SixthOrder at_rest jerk",
    "perturbation": "Handle KnownArm LinearFit StiffnessFit fit_stiffness_linear fit_trials fit_triangles "
    "fit_triangles_linear joint_trials judge_sensors load_trials merge_triangles predict_trials read_trials "
    "regress_trials residual_triangle",
    "posterior": "ExactPosterior LogNormal MultivariateNormal Normal PosteriorMany adjusted derive estimate_density "
    "exact_posterior linear_density make_prior probability_greater sample_many "
    "stiffness_density summarise to_inference_data window_densities",
    "recordings": "load_trial_table save_trial_table",
    "trust": "confidence",
}
"""Names that stood here in 0.1, by the package that has them now. The next version goes without this table."""


def __getattr__(name: str) -> Any:
    for package, names in MOVED.items():
        if name in names.split():
            import warnings

            place = f"jaximp.{package}.{name}"
            warnings.warn(f"jaximp.{name} has moved: use {place}", DeprecationWarning, stacklevel=2)
            return getattr(_load(package), name)
    return _load(name)
