"""The bodies of the scene as URDFs, made from the iiwa of `pybullet_data` and simple shapes.

One file serves both libraries: PyBullet draws it, Pinocchio computes its kinematics, so that they cannot disagree.
"""

from __future__ import annotations

import importlib.util
import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

from kpirl_ocp.errors import DependencyError, SceneError

BOTTLE, GRIPPER, FLANGE = "bottle", "gripper", "lbr_iiwa_link_7"

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Shape:
    """A box (x, y, z) [m] or a cylinder (radius, length) [m] along z, at `xyz` [m] and `rpy` [rad] in its link."""

    size: tuple[float, ...]
    xyz: Vector = (0.0, 0.0, 0.0)
    rpy: Vector = (0.0, 0.0, 0.0)
    colour: tuple[float, float, float] = (0.5, 0.5, 0.5)


_QUARTER = math.pi / 2  # of a turn [rad]
_GREEN, _WHITE, _SILVER = (0.05, 0.45, 0.15), (0.92, 0.92, 0.88), (0.75, 0.76, 0.78)

# A bottle 0.25 m high, its frame in the middle of the body, z towards the neck.
BOTTLE_SHAPES = (
    Shape((0.036, 0.17), (0.0, 0.0, -0.02), colour=_GREEN),
    Shape((0.037, 0.07), (0.0, 0.0, -0.02), colour=_WHITE),
    Shape((0.015, 0.07), (0.0, 0.0, 0.095), colour=_GREEN),
    Shape((0.017, 0.02), (0.0, 0.0, 0.135), colour=_WHITE),
)
# A round body and two fingers that close around the bottle from the flange's side.
GRIPPER_SHAPES = (
    Shape((0.042, 0.05), colour=_SILVER),
    Shape((0.022, 0.010, 0.07), (0.0, 0.044, 0.055), colour=_SILVER),
    Shape((0.022, 0.010, 0.07), (0.0, -0.044, 0.055), colour=_SILVER),
)

# A right hand from +x that closes around the bottle's body: palm, four fingers, thumb, wrist and a white sleeve.
_SKIN, _SLEEVE = (0.87, 0.67, 0.55), (0.95, 0.95, 0.93)
HAND_SHAPES = (
    Shape((0.03, 0.06, 0.09), (0.060, 0.0, -0.02), colour=_SKIN),
    *(Shape((0.009, 0.085), (0.012, -0.045, z), (0.0, _QUARTER, 0.0), _SKIN) for z in (-0.055, -0.033, -0.011, 0.011)),
    *(Shape((0.009, 0.050), (-0.036, -0.022, z), (_QUARTER, 0.0, 0.0), _SKIN) for z in (-0.055, -0.033, -0.011, 0.011)),
    Shape((0.011, 0.075), (0.018, 0.046, 0.005), (0.0, _QUARTER, 0.0), _SKIN),
    Shape((0.026, 0.07), (0.105, 0.0, -0.02), (0.0, _QUARTER, 0.0), _SKIN),
    Shape((0.038, 0.90), (0.590, 0.0, -0.02), (0.0, _QUARTER, 0.0), _SLEEVE),  # out of the image
)


def iiwa_with_meshes() -> Path:
    """The URDF of the iiwa in `pybullet_data`, next to its meshes. Raises DependencyError without that package."""
    spec = importlib.util.find_spec("pybullet_data")
    if spec is None or spec.origin is None:
        raise DependencyError('the iiwa\'s meshes are in the package pybullet: pip install "kpirl-ocp[perception]".')
    return Path(spec.origin).parent / "kuka_iiwa" / "model.urdf"


def write_arm_with_bottle(directory: Path, urdf: Path | None = None, link: str = FLANGE) -> Path:
    """Write the URDF of an arm that holds the bottle: links `gripper` and `bottle` fixed to its flange.

    Args:
        urdf: of the arm; None for the iiwa.
        link: its flange, whose z axis points out of the arm.

    Raises:
        SceneError: the arm has no such link, or a mesh of it is missing.
    """
    source = iiwa_with_meshes() if urdf is None else urdf
    tree = ET.parse(source)
    robot = tree.getroot()
    if link not in [entry.get("name") for entry in robot.iter("link")]:
        raise SceneError(f"the arm of {source} has no link {link!r} to hold the bottle.")
    for entry in robot.iter("link"):
        for collision in entry.findall("collision"):  # only the gripper and the bottle collide
            entry.remove(collision)
    for mesh in robot.iter("mesh"):
        mesh.set("filename", str(_mesh(source, mesh.attrib["filename"])))
    _append(robot, GRIPPER, GRIPPER_SHAPES, link, (0.0, 0.0, 0.045), (0.0, 0.0, 0.0), mass=0.3)
    _append(robot, BOTTLE, BOTTLE_SHAPES, link, (0.0, 0.0, 0.115), (0.0, -_QUARTER, 0.0), mass=0.4)
    path = directory / "arm_with_bottle.urdf"
    tree.write(path)
    return path


def _mesh(urdf: Path, name: str) -> Path:
    """The file of a mesh, by a path relative to the URDF or by package://PACKAGE/PATH with the package above it.

    Raises SceneError if there is no such file.
    """
    bare = name.removeprefix("file://").removeprefix("package://")
    places = [urdf.parent, *urdf.resolve().parents] if name.startswith("package://") else [urdf.parent]
    found = next((place / bare for place in places if (place / bare).is_file()), None)
    if found is None:
        raise SceneError(f"{urdf} draws the mesh {name}, which is not there.")
    return found


def write_hand_with_bottle(directory: Path) -> Path:
    """Write the URDF of the bottle, its base, in a hand fixed to it."""
    robot = ET.Element("robot", name="hand_with_bottle")
    _add_link(robot, BOTTLE, BOTTLE_SHAPES, mass=0.4)
    _append(robot, "hand", HAND_SHAPES, BOTTLE, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), mass=0.4)
    path = directory / "hand_with_bottle.urdf"
    ET.ElementTree(robot).write(path)
    return path


def _append(
    robot: ET.Element, name: str, shapes: tuple[Shape, ...], parent: str, xyz: Vector, rpy: Vector, mass: float
) -> None:
    """Add a link of shapes and the fixed joint that holds it."""
    _add_link(robot, name, shapes, mass)
    joint = ET.SubElement(robot, "joint", name=f"{name}_joint", type="fixed")
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=name)
    ET.SubElement(joint, "origin", xyz=_text(xyz), rpy=_text(rpy))


def _add_link(robot: ET.Element, name: str, shapes: tuple[Shape, ...], mass: float) -> None:
    link = ET.SubElement(robot, "link", name=name)
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "mass", value=str(mass))
    moment = str(mass * 0.05**2)  # of a body some 0.1 m across
    ET.SubElement(inertial, "inertia", ixx=moment, iyy=moment, izz=moment, ixy="0", ixz="0", iyz="0")
    for index, shape in enumerate(shapes):
        visual = _add_shape(link, "visual", shape)
        material = ET.SubElement(visual, "material", name=f"{name}_{index}")
        ET.SubElement(material, "color", rgba=_text((*shape.colour, 1.0)))
        _add_shape(link, "collision", shape)


def _add_shape(link: ET.Element, kind: str, shape: Shape) -> ET.Element:
    element = ET.SubElement(link, kind)
    ET.SubElement(element, "origin", xyz=_text(shape.xyz), rpy=_text(shape.rpy))
    geometry = ET.SubElement(element, "geometry")
    if len(shape.size) == 3:
        ET.SubElement(geometry, "box", size=_text(shape.size))
    else:
        ET.SubElement(geometry, "cylinder", radius=str(shape.size[0]), length=str(shape.size[1]))
    return element


def _text(numbers: tuple[float, ...]) -> str:
    return " ".join(map(str, numbers))
