"""Made-up robots as URDF texts: small, and each with something that is hard to get right."""

from __future__ import annotations


def link(
    name: str, mass: float = 1.0, centre: str = "0.02 -0.03 0.1", inertia: str = "0.02 0.001 -0.002 0.03 0.0015 0.01"
) -> str:
    """A link with an inertia `ixx ixy ixz iyy iyz izz` about a centre of mass in turned axes."""
    keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    numbers = " ".join(f'{key}="{value}"' for key, value in zip(keys, inertia.split(), strict=True))
    return (
        f'<link name="{name}"><inertial><origin xyz="{centre}" rpy="0.3 -0.2 0.5"/><mass value="{mass}"/>'
        f"<inertia {numbers}/></inertial></link>"
    )


def joint(
    name: str,
    parent: str,
    child: str,
    kind: str = "revolute",
    xyz: str = "0 0 0.3",
    rpy: str = "0 0 0",
    axis: str = "0 0 1",
    more: str = "",
    limit: str = '<limit lower="-2" upper="2.5" velocity="3" effort="40"/>',
) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>{limit}{more}</joint>'
    )


def robot(*parts: str, name: str = "made_up") -> str:
    return f'<robot name="{name}">{"".join(parts)}</robot>'


TREE = robot(
    '<link name="world"/>',
    joint("mount", "world", "base", "fixed", "0.1 0.2 0.3", "0.2 0.1 -0.4"),
    link("base", 5.0),
    joint("waist", "base", "torso", "revolute", "0 0 0.2", "0.1 0.2 0.3", "0.2 -0.3 1"),
    link("torso", 4.0, "0.05 0.02 0.15"),
    joint("box_mount", "torso", "box", "fixed", "0.1 -0.1 0.2", "0.4 1.1 -0.7"),
    link("box", 0.7, "0.01 0.02 0.03"),
    joint("left_slide", "torso", "left_carriage", "prismatic", "0 0.3 0.1", "-0.5 0.3 0.9", "1 0.5 -0.2"),
    link("left_carriage", 1.2),
    joint("left_wrist", "left_carriage", "left_hand", "continuous", "0.2 0 0", "1.2 0 0.4", "0 1 0"),
    link("left_hand", 0.6, "0.03 0.01 0.05"),
    joint("right_elbow", "torso", "right_arm", "revolute", "0 -0.3 0.1", "0.6 -0.8 0.2", "1 1 0"),
    link("right_arm", 1.5, "0.1 0 0.02"),
    joint(
        "right_finger",
        "right_arm",
        "finger",
        "prismatic",
        "0.3 0 0",
        "0 0.4 0",
        "0 0 1",
        '<mimic joint="right_elbow" multiplier="-0.35" offset="0.12"/>',
    ),
    link("finger", 0.2, "0.01 0 0.02", "0.001 0 0 0.002 0.0001 0.0015"),
    name="tree",
)
"""Two branches, skew axes, lumps of fixed links, a prismatic joint, and a finger that follows the elbow."""

GANTRY = robot(
    '<link name="rail"/>',
    joint("slide", "rail", "carriage", "prismatic", "0 0 1", "0 0 0", "1 0 0"),
    link("carriage", 8.0),
    joint("swing", "carriage", "boom", "revolute", "0.1 0 -0.2", "1.5707963267949 0 0", "0 0 1"),
    link("boom", 2.5, "0.2 0.01 0"),
    joint("tilt", "boom", "head", "revolute", "0.5 0 0", "0 -1.5707963267949 0", "0 0 -1"),
    link("head", 1.1),
    joint("camera_mount", "head", "camera", "fixed", "0 0.05 0.1", "0 0 0.7"),
    name="gantry",
)
"""A serial chain that begins with a prismatic joint, with quarter turns rounded at thirteen digits."""
GANTRY = GANTRY.replace("</robot>", '<link name="camera"/></robot>')


def planar(length: float = 0.4) -> str:
    """Two links in the x-y plane, as in textbooks; the second hangs at the end of the first."""
    return robot(
        '<link name="ground"/>',
        joint("shoulder", "ground", "upper", xyz="0 0 0"),
        link("upper", 2.0, "0.17 0.02 0"),
        joint("elbow", "upper", "fore", xyz=f"{length} 0 0"),
        link("fore", 1.3, "0.12 -0.01 0"),
        name="planar",
    )
