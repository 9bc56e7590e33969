"""jaximp: mechanical impedance of human joints and arms, and the dynamics of the robots that hold them."""

from jaximp import models
from jaximp.design.excitation import Design, Encoder, Limits, design_excitation
from jaximp.design.perturbations import Perturbations, design_perturbations
from jaximp.identification.estimates import Estimates
from jaximp.identification.filters import FilterSettings
from jaximp.jobs.job import Job, parse_job, read_job
from jaximp.jobs.run import identify, identify_recording, infer, infer_recording, infer_trials
from jaximp.least_squares.noise import Noise, fit_noise, joined, whiten
from jaximp.least_squares.recursive import RecursiveFit, recursive_least_squares
from jaximp.least_squares.sliding import adaptive_least_squares, sliding_least_squares, sliding_pieces, sliding_theta
from jaximp.least_squares.window import SlidingFit, WindowFit, confidence_interval, least_squares
from jaximp.motion.trajectories import FourierSeries, MinimumJerk, RaisedSine, SixthOrder, at_rest, jerk
from jaximp.perturbation.impedance import ArmImpedance, identify_impedance, identify_trials
from jaximp.perturbation.isolation import KnownArm
from jaximp.perturbation.movement_trials import judge_sensors, read_movements, read_postures
from jaximp.perturbation.movements import Handle, Movements
from jaximp.perturbation.stiffness import (
    LinearFit,
    StiffnessFit,
    fit_stiffness,
    fit_stiffness_linear,
    fit_triangles,
    fit_triangles_linear,
    merge_triangles,
    residual_triangle,
)
from jaximp.perturbation.trials import (
    fit_trials,
    joint_trials,
    load_trials,
    predict_trials,
    read_trials,
    regress_trials,
)
from jaximp.posterior.densities import adjusted, estimate_density, linear_density, stiffness_density, window_densities
from jaximp.posterior.draws import (
    ExactPosterior,
    Posterior,
    PosteriorMany,
    derive,
    exact_posterior,
    probability_greater,
    summarise,
)
from jaximp.posterior.files import load_posterior, save_posterior, to_inference_data
from jaximp.posterior.inference import Inference, compare_models
from jaximp.posterior.priors import LogNormal, MultivariateNormal, Normal, make_prior
from jaximp.posterior.samplers import sample_many, sample_posterior
from jaximp.recordings.load import (
    load_recording,
    load_trial_table,
    recording_from_arrays,
    save_recording,
    save_trial_table,
)
from jaximp.trust.verdicts import TrustLimits, confidence
from jaximp.types import Recording

__all__ = [
    "ArmImpedance",
    "Design",
    "Encoder",
    "Estimates",
    "ExactPosterior",
    "FilterSettings",
    "FourierSeries",
    "Handle",
    "Inference",
    "Job",
    "KnownArm",
    "Limits",
    "LinearFit",
    "LogNormal",
    "MinimumJerk",
    "Movements",
    "MultivariateNormal",
    "Noise",
    "Normal",
    "Perturbations",
    "Posterior",
    "PosteriorMany",
    "RaisedSine",
    "Recording",
    "RecursiveFit",
    "SixthOrder",
    "SlidingFit",
    "StiffnessFit",
    "TrustLimits",
    "WindowFit",
    "adaptive_least_squares",
    "adjusted",
    "at_rest",
    "compare_models",
    "confidence",
    "confidence_interval",
    "derive",
    "design_excitation",
    "design_perturbations",
    "estimate_density",
    "exact_posterior",
    "fit_noise",
    "fit_stiffness",
    "fit_stiffness_linear",
    "fit_trials",
    "fit_triangles",
    "fit_triangles_linear",
    "identify",
    "identify_impedance",
    "identify_recording",
    "identify_trials",
    "infer",
    "infer_recording",
    "infer_trials",
    "jerk",
    "joined",
    "joint_trials",
    "judge_sensors",
    "least_squares",
    "linear_density",
    "load_posterior",
    "load_recording",
    "load_trial_table",
    "load_trials",
    "make_prior",
    "merge_triangles",
    "models",
    "parse_job",
    "predict_trials",
    "probability_greater",
    "read_job",
    "read_movements",
    "read_postures",
    "read_trials",
    "recording_from_arrays",
    "recursive_least_squares",
    "regress_trials",
    "residual_triangle",
    "sample_many",
    "sample_posterior",
    "save_posterior",
    "save_recording",
    "save_trial_table",
    "sliding_least_squares",
    "sliding_pieces",
    "sliding_theta",
    "stiffness_density",
    "summarise",
    "to_inference_data",
    "whiten",
    "window_densities",
]
