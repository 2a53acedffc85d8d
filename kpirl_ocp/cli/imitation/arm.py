"""The arm that repeats a demonstration: where it starts, and its keypoints as the scene's camera sees them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.cli.commands.solve import bent_posture
from kpirl_ocp.errors import DemonstrationError, SceneError
from kpirl_ocp.irl.cases.cost_files import ArmSetting, robot_called
from kpirl_ocp.irl.visual.camera_learning import held_points
from kpirl_ocp.ocp.models.pinhole import Pinhole
from kpirl_ocp.ocp.models.robot import Keypoint, Robot
from kpirl_ocp.ocp.models.robot_files import example_urdf
from kpirl_ocp.ocp.problem.guards import dense
from kpirl_ocp.perception.data.video import Frames
from kpirl_ocp.perception.scene.bodies import BOTTLE, FLANGE
from kpirl_ocp.perception.scene.camera import Camera
from kpirl_ocp.perception.scene.posture import inverse_kinematics
from kpirl_ocp.perception.scene.scene import Scene
from kpirl_ocp.types import Array

BOTTLE_LENGTH = 0.25  # [m]
_WORKSPACE = np.array([[0.46, 0.40], [0.78, 0.80]])  # of the bottle in front of the iiwa, x and z [m]
_VIEW = np.array([0.0, -1.45, 0.08])  # from the bottle to the camera of another arm than the iiwa [m]
_BEND = 1.0  # of the joints of another arm [rad]: almost stretched, three joints hardly move the bottle lengthwise
_SMALLER = 0.9  # of the largest scale that fits
_MARGIN = 5.0  # keypoints stay this far inside the image [pixels]
_SHORTEST = 3.0  # displacement of a keypoint that a plan can show [pixels]
_AWAY = 0.08  # other starts from the first, and the first from joint limits, at most and at least [rad]
_MOST = 0.3  # largest displacement of a joint in one step [rad]


@dataclass(frozen=True, eq=False)
class Arm:
    """An arm with the bottle, in front of a camera.

    name: "iiwa", a name of example-robot-data, or the path of a URDF. flange: the link that holds the bottle.
    start: (n_joints,) [rad]. camera: of the scene. robot: its keypoints are those of the demonstration.
    scale: pixels of the camera per pixel of the film. smaller: whether that is less than the bottle's length says.
    """

    name: str
    flange: str
    start: Array
    camera: Camera
    setting: ArmSetting
    robot: Robot
    scale: float
    smaller: bool

    def scene(self, rate: int = 5) -> Scene:
        """The scene with this arm, to be used in a `with` block."""
        return _scene(self.name, self.flange, self.robot, self.camera, rate)

    def images(self, postures: Array) -> Iterator[Frames]:
        """Images (H, W, 3) of the arm in each of the postures (n, n_joints) [rad], as its camera sees it."""
        with self.scene() as scene:
            for theta in postures:
                scene.reset(np.clip(theta, *scene.joint_limits))  # motors may pass a limit by a rounding error
                yield scene.render().rgb

    def keypoints(self, postures: ArrayLike) -> Array:
        """Keypoints (n, K, 2) [pixels of the camera] of the arm in postures (n, n_joints) [rad]."""
        count = 2 * len(self.setting.keypoints)
        seen = np.array([self.setting.state(self.robot, theta)[:count] for theta in np.asarray(postures, float)])
        return np.asarray(self.setting.unit * seen.reshape(len(seen), -1, 2), float)


@dataclass(frozen=True)
class Scale:
    """Pixels of the arm's camera per pixel of the film: given, or from the length of the object.

    given: the number itself; None to find it. pixels: of the object in the film.
    length: of the object [m]; None if it is not known: that of the bottle, or as much less as the path needs to fit.
    """

    given: float | None
    length: float | None
    pixels: float | None

    def at(self, focal: float, depth: float) -> float:
        """The scale for a focal length [pixels] and a depth [m]. Raises DemonstrationError if nothing tells it."""
        if self.given is not None:
            return self.given
        if self.pixels is None:
            raise DemonstrationError("the tracks do not say how large the object is: give the scale (--scale).")
        return focal / depth * (BOTTLE_LENGTH if self.length is None else self.length) / self.pixels

    @property
    def is_known(self) -> bool:
        """Whether it is more than a guess."""
        return self.given is not None or self.length is not None


def arm_for(name: str, flange: str | None, places: Array, scale: Scale) -> tuple[Arm, Array]:
    """The arm, and the displacements (T+1, K, 2) [pixels of its camera] that it is to repeat.

    Args:
        name, flange: as in `Arm`; without a flange the arm's own tool holds the bottle.
        places: (T+1, K, 2) keypoints in the film [pixels].

    Raises:
        RobotError, SceneError: there is no such arm, or it cannot hold the bottle.
        DemonstrationError: the path leaves the image at a known scale, or hardly moves.
    """
    bare = robot_called(name)
    link = flange or (FLANGE if name == "iiwa" else bare.keypoints[0].link)
    with _scene(name, link, bare, Camera()) as scene:
        camera, start = (Camera(), _middle()) if name == "iiwa" else _elsewhere(scene, bare)
        depth = _bottle(scene, camera, start)[2]
        factor = scale.at(camera.intrinsics[0, 0], depth)
        displacements = factor * (places - places[0])
        if name == "iiwa":
            start = _start_for(bare, camera, displacements)
        rotation, position, depth = _bottle(scene, camera, start)
    figure = factor * (places[0] - places[0].mean(axis=0))
    fits = _share_that_fits(camera, camera.project(position), figure + displacements)
    if fits < 1 and not scale.is_known:
        arm, displacements = arm_for(name, flange, places, Scale(_SMALLER * fits * factor, None, None))
        return replace(arm, smaller=True), displacements
    _check_size(camera, figure + displacements, fits, factor)
    pinhole = Pinhole(camera.intrinsics, *camera.extrinsics)
    held = held_points(pinhole, rotation, position, figure)
    keypoints = _on_flange(link, bare, start, rotation, position, held)
    setting = ArmSetting(name, keypoints, camera.height / 2, pinhole, max_displacement=_MOST)
    return Arm(name, link, start, camera, setting, setting.build(), factor, smaller=False), displacements


def other_starts(arm: Arm, count: int, seed: int | tuple[int, ...]) -> list[Array]:
    """The arm's start (n_joints,) and count - 1 others, up to 0.08 rad away in each joint and within its limits."""
    rng = np.random.default_rng(seed)
    lower, upper = arm.robot.joint_limits
    away = rng.uniform(-_AWAY, _AWAY, (count - 1, arm.robot.n_joints))
    return [arm.start, *(np.clip(arm.start + offset, lower + 1e-6, upper - 1e-6) for offset in away)]


def _scene(name: str, flange: str, robot: Robot, camera: Camera, rate: int = 5) -> Scene:
    pairs = list(zip(robot.model.names, robot.model.joints, strict=True))[1:]  # without the universe
    joints = tuple(name for name, joint in pairs if joint.nv == 1)
    return Scene(camera=camera, shelf=False, rate=rate, arm=_urdf(name), flange=flange, joints=joints)


def _urdf(name: str) -> Path | None:
    if name == "iiwa":
        return None
    return Path(name) if "." in name or "/" in name else example_urdf(name)


def _bottle(scene: Scene, camera: Camera, theta: Array) -> tuple[Array, Array, float]:
    """Rotation (3, 3) and position (3,) [m] of the bottle, and its depth before a camera [m]."""
    scene.reset(theta)
    rotation, position = scene.link_pose(BOTTLE)
    turn, shift = camera.extrinsics
    return rotation, position, float((turn @ position + shift)[2])


def _on_flange(
    flange: str, robot: Robot, theta: Array, rotation: Array, position: Array, held: Array
) -> tuple[Keypoint, ...]:
    """Points (K, 3) of the bottle's frame as keypoints of the link that holds it."""
    world = held @ rotation.T + position
    turn, shift = (dense(value) for value in robot.link_function(flange)(theta))
    local = (world - shift.ravel()) @ turn
    return tuple(Keypoint(flange, (x, y, z)) for x, y, z in local.tolist())


def _middle() -> Array:
    x, z = _WORKSPACE.mean(axis=0)
    return inverse_kinematics(x, z)


def _start_for(iiwa: Robot, camera: Camera, displacements: Array) -> Array:
    """Joints (7,) [rad] of the iiwa from which displacements (T+1, K, 2) [pixels] lie in the middle of its workspace.

    A place too near for its joint limits is moved away. Raises SceneError if that does not help.
    """
    per_pixel = np.linalg.norm(camera.in_plane([1.0, 0.0]) - camera.in_plane([0.0, 0.0]))
    path = displacements.mean(axis=1) * [per_pixel, -per_pixel]
    centre = (path.min(axis=0) + path.max(axis=0)) / 2
    x, z = np.clip(_WORKSPACE.mean(axis=0) - centre, *_WORKSPACE)
    lower, upper = iiwa.joint_limits
    for farther in np.arange(0.0, 0.3, 0.01):
        theta = inverse_kinematics(float(x + farther), float(z))
        if ((theta > lower + _AWAY) & (theta < upper - _AWAY)).all():
            return theta
    raise SceneError(f"the iiwa cannot hold the bottle at x = {x:.2f} m, z = {z:.2f} m, nor farther away.")


def _elsewhere(scene: Scene, robot: Robot) -> tuple[Camera, Array]:
    """A camera next to the bottle of another arm, and a bent posture."""
    start = bent_posture(robot, _BEND)
    scene.reset(start)
    _, position = scene.link_pose(BOTTLE)
    eye, target = (tuple(map(float, place)) for place in (position + _VIEW, position))
    return Camera(eye=eye, target=target), start  # type: ignore[arg-type]


def _share_that_fits(camera: Camera, place: Array, offsets: Array) -> float:
    """The factor by which offsets (T+1, K, 2) from a place (2,) just stay in the image [pixels]."""
    size = np.array([camera.width, camera.height])
    room = np.where(offsets < 0, place - _MARGIN, size - _MARGIN - place)
    return float((room / np.maximum(np.abs(offsets), 1e-9)).min())


def _check_size(camera: Camera, offsets: Array, fits: float, scale: float) -> None:
    """Raise DemonstrationError if offsets (T+1, K, 2) fit only when scaled by less than 1, or hardly move."""
    if fits < 1:
        span = np.ptp(offsets.reshape(-1, 2), axis=0).max()
        raise DemonstrationError(
            f"scaled by {scale:.3g}, the path spans {span:.0f} of the {camera.width} pixels of the arm's camera and "
            f"leaves its image: choose a smaller scale, as --scale {_SMALLER * fits * scale:.2g}, or a smaller "
            "--object-size."
        )
    moved = float(np.linalg.norm(offsets - offsets[0], axis=-1).max())
    if moved < _SHORTEST:
        raise DemonstrationError(
            f"scaled by {scale:.3g}, the keypoints move by {moved:.2g} pixels of the arm's camera: choose a larger "
            f"one, as --scale {10 * _SHORTEST / moved * scale:.2g}, or a larger --object-size."
        )
