"""What is identified: pure regressors with parameter names and units. `a + b` stacks, `combine(a, b)` merges."""

from jaximp.models.arm import (
    ArmLinks,
    PlanarArm,
    borner_from_lakatos,
    coriolis_matrix,
    gravity_torque,
    lakatos_from_borner,
    mass_matrix,
    rigid_body_torque,
)
from jaximp.models.base import MOTION, Combined, Joints, Model, Stacked, combine
from jaximp.models.endpoint import (
    Ellipse,
    EndpointImpedance,
    ellipse,
    endpoint_damping,
    endpoint_impedance,
    endpoint_inertia,
    endpoint_stiffness,
    propagated_stderr,
)
from jaximp.models.joint import HumanJoint, RobotJoint, parameter_units
from jaximp.models.kinematics import ArmGeometry
from jaximp.models.reflex import ReflexGain, ReflexPathway, pathway_of, reflex_gain, with_gain

__all__ = [
    "MOTION",
    "ArmGeometry",
    "ArmLinks",
    "Combined",
    "Ellipse",
    "EndpointImpedance",
    "HumanJoint",
    "Joints",
    "Model",
    "PlanarArm",
    "ReflexGain",
    "ReflexPathway",
    "RobotJoint",
    "Stacked",
    "borner_from_lakatos",
    "combine",
    "coriolis_matrix",
    "ellipse",
    "endpoint_damping",
    "endpoint_impedance",
    "endpoint_inertia",
    "endpoint_stiffness",
    "gravity_torque",
    "lakatos_from_borner",
    "mass_matrix",
    "parameter_units",
    "pathway_of",
    "propagated_stderr",
    "reflex_gain",
    "rigid_body_torque",
    "with_gain",
]
