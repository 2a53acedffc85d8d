"""Recordings of the camera, with the ground truth of the object, which only a simulation knows (for evaluation)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from kpirl_ocp.episodes import check_archive, read_episode, stored
from kpirl_ocp.perception.data.video import read_demonstration, sample_indices
from kpirl_ocp.perception.scene.frame import Frame
from kpirl_ocp.pictures import Brief
from kpirl_ocp.types import Array


@dataclass(frozen=True, eq=False, repr=False)
class GroundTruth(Brief):
    """The bottle in a clip of T+1 frames, as the simulation knows it.

    bottle: (T+1, H, W) bool, the pixels that show it.
    place: (T+1, 2) its projected middle [pixels].
    times: (T+1,) [s].
    """

    bottle: NDArray[np.bool_] = stored("observation.masks.bottle", np.bool_, "T+1", "H", "W")
    place: Array = stored("observation.place", np.float64, "T+1", 2)
    times: Array = stored("timestamp", np.float64, "T+1")

    @staticmethod
    def columns(frames: Sequence[Frame], rate: float) -> dict[str, Any]:
        """The arrays of a clip at `rate` [Hz] by name."""
        return {
            "bottle": np.array([frame.bottle for frame in frames]),
            "place": np.array([frame.place for frame in frames]),
            "times": np.arange(len(frames)) / rate,
        }


@dataclass(frozen=True, eq=False, repr=False)
class Recording(GroundTruth):
    """A clip with its ground truth; images: (T+1, H, W, 3) uint8 RGB."""

    images: NDArray[np.uint8] = stored("observation.images.camera", np.uint8, "T+1", "H", "W", 3)


@dataclass(frozen=True, eq=False, repr=False)
class ArmFilm(Brief):
    """A recording of any robot, as users have it: frames, joints and commands.

    images: (T+1, H, W, 3) uint8 RGB. joints: (T+1, n_joints) [rad]. actions: (T, n_joints) displacements [rad].
    times: (T+1,) [s].
    """

    images: NDArray[np.uint8] = stored("observation.images.camera", np.uint8, "T+1", "H", "W", 3)
    joints: Array = stored("observation.state", np.float64, "T+1", "n_joints")
    actions: Array = stored("action", np.float64, "T", "n_joints")
    times: Array = stored("timestamp", np.float64, "T+1")


@dataclass(frozen=True, eq=False, repr=False)
class MeasuredArmFilm(ArmFilm):
    """The same with velocities (T+1, n_joints) [rad/s]."""

    velocities: Array = stored("observation.velocity", np.float64, "T+1", "n_joints")


def read_arm_film(path: Path) -> MeasuredArmFilm:
    """A recording of a robot; velocities that the file lacks are differences from the frame before.

    Raises EpisodeError, naming file and key, if anything is amiss.
    """
    try:
        check_archive(path)
        with np.load(path, allow_pickle=False) as file:
            measured = "observation.velocity" in file.files
    except (OSError, ValueError, BadZipFile):
        measured = False  # read_episode says what is wrong
    if measured:
        return read_episode(path, MeasuredArmFilm)
    film = read_episode(path, ArmFilm)
    moved = np.diff(film.joints, axis=0) / np.diff(film.times)[:, None]
    velocities = np.vstack([np.zeros_like(film.joints[:1]), moved])  # at rest in the first frame
    return MeasuredArmFilm(film.images, film.joints, film.actions, film.times, velocities)


@dataclass(frozen=True, eq=False, repr=False)
class ArmRecording(Recording):
    """A clip of the robot, with its measured joints and its commands.

    joints: (T+1, 7) [rad]. velocities: (T+1, 7) [rad/s]. actions: (T, 7) commanded joint displacements [rad].
    """

    joints: Array = stored("observation.state", np.float64, "T+1", "n_joints")
    velocities: Array = stored("observation.velocity", np.float64, "T+1", "n_joints")
    actions: Array = stored("action", np.float64, "T", "n_joints")


def read_hand(path: Path, rate: float = 5.0) -> Recording:
    """A hand's demonstration at `rate` [Hz]: the ground truth from the episode `path`, the frames from its .avi."""
    truth = read_episode(path, GroundTruth)
    images = read_demonstration(path.with_suffix(".avi"), rate=rate, size=truth.bottle.shape[1])
    chosen = sample_indices(len(truth.times), 1 / (truth.times[1] - truth.times[0]), rate)
    return Recording(truth.bottle[chosen], truth.place[chosen], truth.times[chosen], images)
