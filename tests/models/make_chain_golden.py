"""Writes chain_golden.json: torques, mass matrices, Jacobians and regressors of the made-up robots by pinocchio.

Run it where pinocchio is installed (`pip install pin`); the tests need it not. It imports nothing of jaximp, so that
the numbers are pinocchio's alone. Followers are joints like all others here: the tests put them where they follow.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))

from factories.robots import GANTRY, TREE  # noqa: E402

ROBOTS = {
    "tree": (TREE, "left_hand", ["waist", "left_slide", "left_wrist", "right_elbow", "right_finger"]),
    "gantry": (GANTRY, "camera", ["slide", "swing", "tilt"]),
    "arm": (
        (HERE.parents[1] / "jaximp" / "data" / "six_joint_arm.urdf").read_text(),
        "tool",
        [f"joint_{k}" for k in range(1, 7)],
    ),
}
SAMPLES = 3


def numbers(text: str, tip: str, joints: list[str], random: np.random.Generator) -> dict[str, Any]:
    model = pin.buildModelFromXML(text)
    data, found = model.createData(), []
    for _ in range(SAMPLES):
        position, velocity, acceleration = random.normal(size=(3, len(joints)))
        if "right_finger" in joints:
            for x, offset in ((position, 0.12), (velocity, 0.0), (acceleration, 0.0)):
                x[4] = -0.35 * x[3] + offset
        q, v, a = pin.neutral(model), np.zeros(model.nv), np.zeros(model.nv)
        place = []
        for k, name in enumerate(joints):
            joint = model.joints[model.getJointId(name)]
            turns = joint.nq == 2  # continuous: cosine and sine
            q[joint.idx_q : joint.idx_q + joint.nq] = (
                [np.cos(position[k]), np.sin(position[k])] if turns else position[k]
            )
            v[joint.idx_v], a[joint.idx_v] = velocity[k], acceleration[k]
            place.append(joint.idx_v)
        bodies = np.concatenate([10 * (model.getJointId(name) - 1) + np.arange(10) for name in joints])
        M = np.triu(pin.crba(model, data, q))
        M = M + np.triu(M, 1).T
        pin.framesForwardKinematics(model, data, q)
        pose = data.oMf[model.getFrameId(tip)]
        J = pin.computeFrameJacobian(model, data, q, model.getFrameId(tip), pin.LOCAL_WORLD_ALIGNED)
        regressor = pin.computeJointTorqueRegressor(model, data, q, v, a)
        found.append(
            {
                "position": position,
                "velocity": velocity,
                "acceleration": acceleration,
                "torque": pin.rnea(model, data, q, v, a)[place],
                "gravity": pin.computeGeneralizedGravity(model, data, q)[place],
                "mass": M[np.ix_(place, place)],
                "rotation": pose.rotation.copy(),
                "tip_position": pose.translation.copy(),
                "jacobian": J[:, place],
                "regressor": regressor[np.ix_(place, bodies)],
            }
        )
    return {"joints": joints, "tip": tip} | {key: [one[key].tolist() for one in found] for key in found[0]}


if __name__ == "__main__":
    random = np.random.default_rng(0)
    golden = {name: numbers(*each, random) for name, each in ROBOTS.items()}
    (HERE / "chain_golden.json").write_text(json.dumps(golden) + "\n")
