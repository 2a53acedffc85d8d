"""Motions of the robot and the hand in front of the camera: one small record per data set of the paper.

Each has the paper's numbers as defaults, a `rate` [Hz], a default number of `episodes`, and `write(path, rng)`, which
plays one episode. Numbers that the paper leaves open (postures, amplitudes) are chosen so that the bottle stays in the
image. `kpirl collect` has every setting as an option.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import ClassVar, Protocol, TypeVar

import numpy as np

from kpirl_ocp.episodes import write_episode
from kpirl_ocp.errors import ProblemError
from kpirl_ocp.motion import forward_then_down, minimum_jerk
from kpirl_ocp.perception.data.encoding import write_video
from kpirl_ocp.perception.data.recordings import ArmRecording, GroundTruth
from kpirl_ocp.perception.data.references import IN_PLANE, SHELF, carried, first_visible, random_posture, sine
from kpirl_ocp.perception.data.surroundings import filmed
from kpirl_ocp.perception.scene.frame import Frame
from kpirl_ocp.perception.scene.hand import RATE, HandScene, placing_path, wandering_path
from kpirl_ocp.perception.scene.posture import UPRIGHT
from kpirl_ocp.perception.scene.scene import JointState, Scene
from kpirl_ocp.types import Array

T = TypeVar("T", int, float)


def setting(default: T, least: float = 1) -> T:
    """A number of a motion, with its smallest value."""
    value: T = field(default=default, metadata={"least": least})
    return value


@dataclass(frozen=True)
class _Checked:
    """Settings that are checked before anything is played."""

    def __post_init__(self) -> None:
        for entry in fields(self):
            value, least = getattr(self, entry.name), entry.metadata["least"]
            if not value >= least:
                raise ProblemError(f"{entry.name} must be at least {least}, got {value}.")


class Motion(Protocol):
    """A data set in the making."""

    episodes: ClassVar[int]

    @property
    def rate(self) -> int:
        """Frames per second."""
        ...

    def film(self, rng: np.random.Generator) -> list[Frame]:
        """The frames of one episode in front of the white wall."""
        ...

    def write(self, path: Path, rng: np.random.Generator) -> None:
        """Play one episode and write it to `path`; the same generator state gives the same one."""
        ...


@dataclass(frozen=True)
class Played:
    """An episode of the robot: frames and measured states at T+1 times, and T commands (7,) [rad] between them."""

    frames: list[Frame]
    states: list[JointState]
    actions: list[Array]


@dataclass(frozen=True)
class ArmMotion(_Checked, ABC):
    """A motion of the robot, recorded with its encoders and camera.

    rate: frames per second, a divisor of 240. surroundings: level, see `kpirl_ocp.perception.data.surroundings`.
    """

    rate: int = setting(5)
    surroundings: int = setting(0, 0)

    def __post_init__(self) -> None:
        super().__post_init__()
        Scene(rate=self.rate)  # refuses a rate that it cannot keep

    @abstractmethod
    def play(self, rng: np.random.Generator) -> Played:
        """Play one episode."""

    def film(self, rng: np.random.Generator) -> list[Frame]:
        """The frames of one episode in front of the white wall."""
        return self.play(rng).frames

    def record(self, rng: np.random.Generator) -> ArmRecording:
        """Play one episode and film it in the surroundings."""
        played = self.play(rng)
        frames = filmed(played.frames, self.surroundings, rng)
        return ArmRecording(
            **ArmRecording.columns(frames, self.rate),
            images=np.array([frame.rgb for frame in frames]),
            joints=np.array([state.positions for state in played.states]),
            velocities=np.array([state.velocities for state in played.states]),
            actions=np.array(played.actions),
        )

    def write(self, path: Path, rng: np.random.Generator) -> None:
        """Play one episode and write it to `path`."""
        write_episode(path, self.record(rng))


@dataclass(frozen=True)
class LastJoint(ArmMotion):
    """Data for the detector (A.2): the arm goes to a random posture, and then only its last joint moves.

    frames: per sequence. swing: largest amplitude of the last joint [rad].
    off_plane: largest angle of joints 1, 3 and 5 from the plane of the camera [rad].
    """

    episodes: ClassVar[int] = 108
    frames: int = setting(10, 2)
    swing: float = setting(0.8, 0.0)
    off_plane: float = setting(0.1, 0.0)

    def play(self, rng: np.random.Generator) -> Played:
        """One sequence."""

        def draw() -> Array:
            start = np.where(IN_PLANE, random_posture(rng), rng.uniform(-self.off_plane, self.off_plane, 7))
            swing = sine(rng, self.frames, self.rate, (0.5 * self.swing, self.swing), (0.10, 0.25))
            return start + np.outer(swing, np.eye(7)[6])

        with Scene(rate=self.rate) as scene:
            return _follow(scene, first_visible(scene, draw))


@dataclass(frozen=True)
class Sines(ArmMotion):
    """Data for the dynamics of reaching (A.3): sine motions of all joints, mostly of joints 2, 4 and 6.

    steps: actions per trajectory. amplitude, others: largest amplitude of joints 2, 4 and 6, and of the others [rad].
    """

    episodes: ClassVar[int] = 100
    steps: int = setting(50)
    amplitude: float = setting(0.25, 0.0)
    others: float = setting(0.03, 0.0)

    def play(self, rng: np.random.Generator) -> Played:
        """One trajectory."""

        def draw() -> Array:
            most = np.where(IN_PLANE, self.amplitude, self.others)
            sines = [sine(rng, self.steps + 1, self.rate, (0.3 * a, a), (0.05, 0.30)) for a in most]
            return random_posture(rng) + np.column_stack(sines)

        with Scene(rate=self.rate) as scene:
            return _follow(scene, first_visible(scene, draw))


@dataclass(frozen=True)
class Placing(ArmMotion):
    """Data for the dynamics of placing (A.3): a scripted expert places the bottle roughly, with noise on its actions.

    The augmentation is the noise and the random turn of the bottle: the expert's path is played from many starts and
    disturbed at every step, so that the data also cover the neighbourhood of the path.

    steps: actions per trajectory. noise, others: standard deviation of the noise on every action of joints 2, 4 and 6,
    and of the others [rad].
    """

    episodes: ClassVar[int] = 100
    rate: int = setting(1)
    steps: int = setting(10)
    noise: float = setting(0.03, 0.0)
    others: float = setting(0.005, 0.0)

    def play(self, rng: np.random.Generator) -> Played:
        """One trajectory."""

        def draw() -> Array:
            forward, down = rng.uniform(0.08, 0.22), rng.uniform(0.08, 0.25)
            end = np.array([rng.uniform(0.64, 0.74), 0.0, SHELF + rng.uniform(0.0, 0.06)])
            path = end - [forward, 0.0, -down] + forward_then_down(forward, down, np.linspace(0, 1, self.steps + 1))
            return carried(path, UPRIGHT + rng.uniform(-0.2, 0.2))

        with Scene(rate=self.rate) as scene:
            reference = first_visible(scene, draw)
            spread = np.where(IN_PLANE, self.noise, self.others)
            noise = rng.normal(0.0, spread, (self.steps, 7))
            return _follow(scene, reference, noise)


@dataclass(frozen=True)
class Reaching(ArmMotion):
    """Demonstrations of reaching (5.1): the robot moves the object along the x axis of the image only.

    steps: actions per demonstration.
    """

    episodes: ClassVar[int] = 15
    steps: int = setting(25)

    def play(self, rng: np.random.Generator) -> Played:
        """One demonstration, with a person's speed profile."""

        def draw() -> Array:
            progress = minimum_jerk(np.linspace(0, 1, self.steps + 1))
            start = np.array([rng.uniform(0.50, 0.58), 0.0, rng.uniform(0.46, 0.66)])
            path = start + np.outer(progress, [rng.uniform(0.12, 0.20), 0.0, 0.0])
            return carried(path, UPRIGHT)

        with Scene(rate=self.rate) as scene:
            return _follow(scene, first_visible(scene, draw))


@dataclass(frozen=True)
class HandMotion(_Checked, ABC):
    """A motion of a hand that holds the bottle: a lossless video, and an episode with the ground truth.

    rate: frames per second. seconds: length of the clip. tremor: standard deviation of the hand's wander [m].
    surroundings: level, see `kpirl_ocp.perception.data.surroundings`.
    """

    rate: int = setting(int(RATE))
    seconds: float = setting(2.0, 0.1)
    tremor: float = setting(1e-3, 0.0)
    surroundings: int = setting(0, 0)

    @abstractmethod
    def path(self, rng: np.random.Generator) -> Array:
        """Path of the bottle (n, 3) [m]."""

    def film(self, rng: np.random.Generator) -> list[Frame]:
        """The frames of one clip in front of the white wall."""
        with HandScene() as scene:
            return [scene.look(position) for position in self.path(rng)]

    def write(self, path: Path, rng: np.random.Generator) -> None:
        """Film one clip: the ground truth goes to `path`, the video next to it, as .avi."""
        frames = filmed(self.film(rng), self.surroundings, rng)
        write_video(path.with_suffix(".avi"), np.array([frame.rgb for frame in frames]), self.rate)
        write_episode(path, GroundTruth(**GroundTruth.columns(frames, self.rate)))


@dataclass(frozen=True)
class HandPlacing(HandMotion):
    """Demonstrations of placing (5.2): a hand puts the bottle on the shelf."""

    episodes: ClassVar[int] = 12

    def path(self, rng: np.random.Generator) -> Array:
        """Along x, then down."""
        return placing_path(rng, seconds=self.seconds, rate=self.rate, tremor=self.tremor)


@dataclass(frozen=True)
class HandWandering(HandMotion):
    """Clips for the detector: a hand carries the bottle about."""

    episodes: ClassVar[int] = 24
    seconds: float = setting(4.0, 0.1)

    def path(self, rng: np.random.Generator) -> Array:
        """To a new place every second."""
        return wandering_path(rng, seconds=self.seconds, rate=self.rate, tremor=self.tremor)


MOTIONS: Mapping[str, type[Motion]] = {
    "keypoints": LastJoint,
    "sines": Sines,
    "placing": Placing,
    "reaching": Reaching,
    "hand-placing": HandPlacing,
    "hand-wandering": HandWandering,
}


def _follow(scene: Scene, reference: Array, noise: Array | None = None) -> Played:
    """The robot following joint positions (T+1, 7) [rad]; every action aims at the next one."""
    states, frames, actions = [scene.reset(reference[0])], [scene.render()], []
    for step, target in enumerate(reference[1:]):
        actions.append(target - states[-1].positions + (0.0 if noise is None else noise[step]))
        states.append(scene.step(actions[-1]))
        frames.append(scene.render())
    return Played(frames, states, actions)
