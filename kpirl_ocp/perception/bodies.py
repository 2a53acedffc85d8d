"""The bodies of the scene as URDFs, made from the iiwa of `pybullet_data` and simple shapes.

One file serves both libraries: PyBullet draws it, Pinocchio computes its kinematics, so that they cannot disagree.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

from kpirl_ocp.assets import iiwa_urdf

BOTTLE, GRIPPER, FLANGE = "bottle", "gripper", "lbr_iiwa_link_7"

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Shape:
    """A box (x, y, z) [m] or a cylinder (radius, length) [m] along z, at `xyz` [m] and `rpy` [rad] in its link."""

    size: tuple[float, ...]
    xyz: Vector = (0.0, 0.0, 0.0)
    rpy: Vector = (0.0, 0.0, 0.0)
    colour: tuple[float, float, float] = (0.5, 0.5, 0.5)


_QUARTER = 1.5707963267948966
_GREEN, _WHITE, _DARK = (0.05, 0.45, 0.15), (0.92, 0.92, 0.88), (0.15, 0.15, 0.17)

# A bottle 0.25 m high, its frame in the middle of the body, z towards the neck.
BOTTLE_SHAPES = (
    Shape((0.036, 0.17), (0.0, 0.0, -0.02), colour=_GREEN),
    Shape((0.037, 0.07), (0.0, 0.0, -0.02), colour=_WHITE),
    Shape((0.015, 0.07), (0.0, 0.0, 0.095), colour=_GREEN),
    Shape((0.017, 0.02), (0.0, 0.0, 0.135), colour=_WHITE),
)
# A palm and two fingers that close around the bottle from the flange's side.
GRIPPER_SHAPES = (
    Shape((0.06, 0.12, 0.04), colour=_DARK),
    Shape((0.04, 0.015, 0.09), (0.0, 0.047, 0.06), colour=_DARK),
    Shape((0.04, 0.015, 0.09), (0.0, -0.047, 0.06), colour=_DARK),
)


def write_arm_with_bottle(directory: Path) -> Path:
    """Write the URDF of the iiwa that holds the bottle: links `gripper` and `bottle` fixed to its flange."""
    source = iiwa_urdf()
    tree = ET.parse(source)
    robot = tree.getroot()
    for mesh in robot.iter("mesh"):
        mesh.set("filename", str(source.parent / mesh.attrib["filename"]))
    _append(robot, GRIPPER, GRIPPER_SHAPES, FLANGE, (0.0, 0.0, 0.045), (0.0, 0.0, 0.0), mass=0.3)
    _append(robot, BOTTLE, BOTTLE_SHAPES, FLANGE, (0.0, 0.0, 0.115), (0.0, -_QUARTER, 0.0), mass=0.4)
    path = directory / "iiwa_with_bottle.urdf"
    tree.write(path)
    return path


def _append(
    robot: ET.Element, name: str, shapes: tuple[Shape, ...], parent: str, xyz: Vector, rpy: Vector, mass: float
) -> None:
    """Add a link of shapes and the fixed joint that holds it."""
    link = ET.SubElement(robot, "link", name=name)
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "mass", value=str(mass))
    moment = str(mass * 0.05**2)  # of a body some 0.1 m across
    ET.SubElement(inertial, "inertia", ixx=moment, iyy=moment, izz=moment, ixy="0", ixz="0", iyz="0")
    for index, shape in enumerate(shapes):
        visual = ET.SubElement(link, "visual")
        ET.SubElement(visual, "origin", xyz=_text(shape.xyz), rpy=_text(shape.rpy))
        geometry = ET.SubElement(visual, "geometry")
        if len(shape.size) == 3:
            ET.SubElement(geometry, "box", size=_text(shape.size))
        else:
            ET.SubElement(geometry, "cylinder", radius=str(shape.size[0]), length=str(shape.size[1]))
        material = ET.SubElement(visual, "material", name=f"{name}_{index}")
        ET.SubElement(material, "color", rgba=_text((*shape.colour, 1.0)))
    joint = ET.SubElement(robot, "joint", name=f"{name}_joint", type="fixed")
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=name)
    ET.SubElement(joint, "origin", xyz=_text(xyz), rpy=_text(rpy))


def _text(numbers: tuple[float, ...]) -> str:
    return " ".join(map(str, numbers))
