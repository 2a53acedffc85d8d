"""Robot descriptions: URDF files to Pinocchio models, checked, and the link that is the tool."""

from __future__ import annotations

import re
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pinocchio as pin

from kpirl_ocp.c_output import captured
from kpirl_ocp.errors import DependencyError, RobotError, suggestion

REVOLUTE = ("JointModelRX", "JointModelRY", "JointModelRZ", "JointModelRevoluteUnaligned")
CONTINUOUS = ("JointModelRUBX", "JointModelRUBY", "JointModelRUBZ", "JointModelRevoluteUnboundedUnaligned")
PRISMATIC = ("JointModelPX", "JointModelPY", "JointModelPZ", "JointModelPrismaticUnaligned")
MIMIC = "JointModelMimic"

# Names of tools, the most specific first: those of ROS-Industrial, then those of manufacturers.
_TOOLS = (r"tool0", r"tcp(_link|_frame)?", r"(ee|eef|end_effector)(_link|_frame)?", r"tool(_link|_frame)?")
_SENSORS = r"IMU|(?i:(^|[^a-z])(imu|camera|optical|laser|lidar|sensor|rgbd))"


def read_urdf(path: Path) -> pin.Model:
    """The model of a URDF file; mimic joints follow the joint that they mimic and have no coordinate of their own.

    Raises:
        RobotError: the file is missing, xacro or malformed; a joint is of an unknown type, has no axis or cannot move;
            none does.
    """
    if not path.is_file():
        raise RobotError(f"there is no URDF file {path}.")
    if path.suffix == ".xacro" or _has_xacro_elements(path):
        target = path.with_suffix("") if path.suffix == ".xacro" else path.with_suffix(".expanded.urdf")
        raise RobotError(f"{path} is a xacro file, not yet a URDF: expand it with `xacro {path} > {target}`.")
    try:
        with captured(2) as said:
            model = pin.buildModelFromUrdf(str(path), True)  # True: with mimic joints
    except ValueError as error:
        raise RobotError(f"{path} cannot be read as a URDF: {_reason(error, said)}.") from error
    for line in said:  # of what does not matter to the joints, such as a geometry
        print(line, file=sys.stderr)
    _check_joints(path, model)
    return model


def _has_xacro_elements(path: Path) -> bool:
    """Whether anything is left to expand; comments and a declared namespace do not count."""
    try:
        return any("xacro" in element.tag.partition("}")[0] for element in ET.parse(path).iter())
    except (ET.ParseError, ValueError, LookupError) as error:  # of the text, of its encoding
        raise RobotError(f"{path} cannot be read as a URDF: it is not XML: {error}.") from error


def example_urdf(name: str) -> Path:
    """The URDF of a robot of the package example-robot-data, found next to Pinocchio, as 6.0.0 has no Python module.

    Raises:
        DependencyError: the package is not installed.
        RobotError: it has no such robot.
    """
    roots = [parent / "share" / "example-robot-data" / "robots" for parent in Path(pin.__file__).parents]
    root = next((root for root in roots if root.is_dir()), None)
    if root is None:
        raise DependencyError(
            f"the robot {name!r} is looked for in the package example-robot-data, which is not installed: "
            'pip install "kpirl-ocp[robots]".'
        )
    files = {path.stem.removesuffix("_robot"): path for path in sorted(root.rglob("*.urdf"))}
    if name not in files:
        hint = suggestion(name, ["iiwa", *files]) or f"; it has: {', '.join(sorted(files))}."
        raise RobotError(f"example-robot-data has no robot {name!r}{hint}")
    return files[name]


def link_names(model: pin.Model) -> list[str]:
    """The links of a robot, in the order of the model."""
    return [frame.name for frame in model.frames if frame.type == pin.FrameType.BODY]


def tool_link(model: pin.Model) -> str:
    """The link that holds a tool: named so (tool0, tcp, end_effector, ...), or the only one at the end of the joints.

    Raises:
        RobotError: there are several, as with two arms, legs or fingers.
    """
    moving = [name for name in link_names(model) if model.frames[_frame(model, name)].parentJoint > 0]
    for pattern in _TOOLS:
        if called := [name for name in moving if re.search(rf"(?i)(^|[^a-z]){pattern}$", name)]:
            return _the_only(model, called)
    return _the_only(model, _ends(model, moving))


def _the_only(model: pin.Model, names: list[str]) -> str:
    if len(names) != 1:
        raise RobotError(
            f"the robot {model.name!r} has {len(names)} links that could hold the tool ({', '.join(names)}): "
            "say which, with keypoints={link: points} or `kpirl solve --tool LINK`."
        )
    return names[0]


def _ends(model: pin.Model, names: list[str]) -> list[str]:
    """The links beyond which there is no other one, leaving sensors aside."""
    kept = [name for name in names if not re.search(_SENSORS, name)]
    inner = {name for link in kept for name in _links_towards_base(model, link)}
    return [name for name in kept if name not in inner]


def _links_towards_base(model: pin.Model, link: str) -> Iterable[str]:
    """The links between this one and the base."""
    frame = model.frames[_frame(model, link)]
    while frame.parentFrame > 0:
        frame = model.frames[frame.parentFrame]
        if frame.type == pin.FrameType.BODY:
            yield frame.name


def _frame(model: pin.Model, link: str) -> int:
    return model.getFrameId(link, pin.FrameType.BODY)


def _check_joints(path: Path, model: pin.Model) -> None:
    joints = list(zip(model.names, model.joints, strict=True))[1:]
    if not joints:
        raise RobotError(f"{path} describes a robot without a joint that moves.")
    for name, joint in joints:
        kind = joint.shortname()
        if kind not in (*REVOLUTE, *CONTINUOUS, *PRISMATIC, MIMIC):
            raise RobotError(
                f"joint {name!r} is a {kind}; revolute, continuous, prismatic and fixed joints are "
                "supported. Fix or remove the joint in the URDF."
            )
        if kind == MIMIC and joint.extract().scaling == 0:
            raise RobotError(f"joint {name!r} mimics another one with the multiplier 0: make it a fixed joint.")
    _check_axes(model)
    _check_limits(model, [(name, joint) for name, joint in joints if joint.shortname() in (*REVOLUTE, *PRISMATIC)])


def _check_axes(model: pin.Model) -> None:
    data = model.createData()
    pin.forwardKinematics(model, data, pin.neutral(model))  # sets the subspaces of mimic joints
    for name, joint, motion in list(zip(model.names, model.joints, data.joints, strict=True))[1:]:
        scaling = joint.extract().scaling if joint.shortname() == MIMIC else 1.0
        if not np.isclose(np.linalg.norm(motion.S), abs(scaling), rtol=1e-6):
            raise RobotError(f"joint {name!r} has an axis without a direction: write one that is not zero.")


def _check_limits(model: pin.Model, joints: list[tuple[str, pin.JointModel]]) -> None:
    lower, upper = model.lowerPositionLimit, model.upperPositionLimit
    frozen = [(name, joint.idx_q) for name, joint in joints if not lower[joint.idx_q] < upper[joint.idx_q]]
    if frozen:
        index = frozen[0][1]
        raise RobotError(
            f"{'joint' if len(frozen) == 1 else 'joints'} {', '.join(repr(name) for name, _ in frozen)} cannot move: "
            f"the limits are {lower[index]:g} and {upper[index]:g}, which URDF takes where none are written. "
            "Write lower and upper limits, or make it a continuous or a fixed joint."
        )


def _reason(error: ValueError, said: Iterable[str]) -> str:
    """The first complaint of the parser of URDF, else Pinocchio's message, without the places in their sources."""
    complaints = (line.removeprefix("Error:").strip() for line in said if line.startswith("Error:"))
    message = " ".join(str(error).split("message:\n")[-1].split("\nhint:")[0].split())
    return next(complaints, message).rstrip(".")
