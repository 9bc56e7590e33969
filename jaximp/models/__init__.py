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
from jaximp.models.joint import HumanJoint, RobotJoint, parameter_units
from jaximp.models.kinematics import ArmGeometry, solve_pair

__all__ = [
    "MOTION",
    "ArmGeometry",
    "ArmLinks",
    "Combined",
    "HumanJoint",
    "Joints",
    "Model",
    "PlanarArm",
    "RobotJoint",
    "Stacked",
    "borner_from_lakatos",
    "combine",
    "coriolis_matrix",
    "gravity_torque",
    "lakatos_from_borner",
    "mass_matrix",
    "parameter_units",
    "rigid_body_torque",
    "solve_pair",
]
