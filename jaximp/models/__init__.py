"""What is identified: pure regressors with parameter names and units. `a + b` stacks, `combine(a, b)` merges."""

from jaximp.models.base import MOTION, Combined, Joints, Model, Stacked, combine
from jaximp.models.joint import HumanJoint, RobotJoint, parameter_units

__all__ = ["MOTION", "Combined", "HumanJoint", "Joints", "Model", "RobotJoint", "Stacked", "combine", "parameter_units"]
