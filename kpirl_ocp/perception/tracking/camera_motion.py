"""Motion of a hand-held camera, from the background of its film, so that an object's motion is told from the camera's.

The background is what most corners of the picture agree on, as one similarity from the first frame. Corners are
followed from a key frame and not from frame to frame, so that errors do not add up; a new key frame is taken when too
few of them are left in view. Where many corners stay where they are, the camera is at rest.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from kpirl_ocp.errors import DemonstrationError
from kpirl_ocp.perception.data.video import Frames
from kpirl_ocp.perception.tracking.optical_flow import follow
from kpirl_ocp.perception.tracking.similarity import fit, transform
from kpirl_ocp.types import Array, Mask

_CELLS, _CORNERS, _SPACING = 6, 12, 5  # cells along each side, corners followed in each, [pixels] between them
_WINDOWS = 21, 41  # that are compared around a corner [pixels]: the larger one finds farther
_RESTS = 0.5  # displacement of a corner that stays where it is [pixels]
_AT_REST = 0.25  # share of the corners that stay, from which the camera is at rest
_AGREE = 3.0  # tolerance of the background [pixels]: what is near moves more than what is far
_MOST, _FEWEST = 0.4, 20  # share of the corners found that makes a background, and their number
_SPREAD = 0.15  # standard deviation of the background's corners along x and y [image sides]
_RENEWAL = 0.7  # share of the key frame's corners in view below which there is a new key frame
_FARTHEST = 0.25  # displacement of the picture beyond which the object leaves it [longer side]


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """Similarities from the first frame to every frame that the background undergoes.

    times: (n,) [s]. poses: (n, 3, 3). reach: largest displacement of a corner of the background [pixels].
    """

    times: Array
    poses: Array
    reach: float

    def at(self, time: float) -> Array:
        """The pose (3, 3) in the frame nearest to a time [s]."""
        return np.asarray(self.poses[np.abs(self.times - time).argmin()], float)

    def steady(self, frames: Iterable[tuple[float, Frames]]) -> Iterator[tuple[float, Frames]]:
        """The frames (time [s], image (H, W, 3)) as the camera would have seen them from its first place.

        What it does not see at a moment stays as it was last seen: a black edge would move, and be taken for a thing.
        """
        canvas: Frames | None = None
        for time, image in frames:
            canvas = image if canvas is None else canvas
            back, size = np.linalg.inv(self.at(time))[:2], image.shape[1::-1]
            still = cv2.warpAffine(image, back, size, dst=canvas.copy(), borderMode=cv2.BORDER_TRANSPARENT)
            canvas = np.asarray(still, np.uint8)
            yield time, canvas


def camera_motion(frames: Iterable[tuple[float, Frames]]) -> CameraMotion | None:
    """The motion of the camera; None if it is at rest, or if there is no background to tell it from.

    frames: times [s] and images (H, W, 3).

    Raises DemonstrationError if the camera moves and its background is lost, or by more than a quarter of the picture.
    """
    times, reaches = [], []
    poses: list[Array] = []
    key: _KeyFrame | None = None
    for time, image in frames:
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
        key = _KeyFrame.of(grey, np.eye(3)) if key is None else key
        near = poses[-1] if poses else np.eye(3)
        pose = key.background(grey, near)
        times.append(time)
        poses.append(near if pose is None else pose)
        reaches.append(np.nan if pose is None else _reach(pose, grey.shape))
        if pose is not None and key.share_in_view(pose) < _RENEWAL:
            key = _KeyFrame.of(grey, pose)
    if np.fmax.reduce(reaches, initial=0.0) <= _AGREE:
        return None
    _check(np.array(times), np.array(reaches), max(image.shape))
    return CameraMotion(np.array(times), np.array(poses), float(max(reaches)))


def _check(times: Array, reaches: Array, side: int) -> None:
    """Raise DemonstrationError at the first time at which the camera's motion is unknown (NaN) or too large."""
    unknown, far = np.isnan(reaches), reaches > _FARTHEST * side
    if unknown.any():
        at, reason = times[unknown][0], "the background is lost"
    elif far.any():
        at, reason = times[far][0], f"its picture has moved by {reaches[far][0]:.0f} of {side} pixels"
    else:
        return
    raise DemonstrationError(
        f"the camera moves, and at {at:.2f} s {reason}: choose a part of the film (--start, --end), or film it again "
        "with the camera at rest."
    )


def _reach(pose: Array, shape: tuple[int, ...]) -> float:
    """Largest displacement of a corner of the picture (H, W) [pixels]."""
    height, width = shape
    corners = np.array([[0, 0], [width, 0], [0, height], [width, height]], float)
    return float(np.linalg.norm(transform(pose, corners) - corners, axis=1).max())


@dataclass(frozen=True)
class _KeyFrame:
    """A grey image (H, W), corners in it (n, 2), and the pose (3, 3) of the background there."""

    grey: NDArray[np.uint8]
    corners: Array
    pose: Array

    @classmethod
    def of(cls, grey: NDArray[np.uint8], pose: Array) -> _KeyFrame:
        return cls(grey, _corners(grey), pose)

    def background(self, grey: NDArray[np.uint8], near: Array) -> Array | None:
        """The pose of the background in another image (H, W); None if there is none. near: about where it is."""
        for guess in (near, self.pose):
            for window in _WINDOWS:
                found = self._background(grey, transform(self._onward(guess), self.corners), window)
                if found is not None:
                    return found
        return None

    def _background(self, grey: NDArray[np.uint8], guess: Array, window: int) -> Array | None:
        places, held = follow(self.grey, grey, self.corners, guess, window)
        start, end = self.corners[held], places[held]
        if len(start) < _FEWEST:
            return None
        rests = np.mean(np.linalg.norm(end - start, axis=1) < _RESTS) >= _AT_REST
        agreed = fit(start, end, _AGREE)
        if agreed is None or not _makes_a_background(start, agreed[1], grey.shape):
            return self.pose if rests else None
        carried = rests and _reach(agreed[0], grey.shape) > _AGREE  # it is a moving body that most corners are on
        return self.pose if carried else np.asarray(agreed[0] @ self.pose, float)

    def share_in_view(self, pose: Array) -> float:
        """Share of the corners that the picture shows at a pose of the background."""
        places = transform(self._onward(pose), self.corners)
        return float(np.all((places > 0) & (places < self.grey.shape[::-1]), axis=1).mean())

    def _onward(self, pose: Array) -> Array:
        """The motion (3, 3) of the background from here to a pose."""
        return np.asarray(pose @ np.linalg.inv(self.pose), float)


def _makes_a_background(corners: Array, agree: Mask, shape: tuple[int, ...]) -> bool:
    """Whether the corners (n, 2) that agree (n,) are many, and all over the picture (H, W)."""
    if agree.sum() < max(_FEWEST, _MOST * len(corners)):
        return False
    return bool((corners[agree].std(axis=0) > _SPREAD * np.array(shape[::-1])).all())


def _corners(grey: NDArray[np.uint8]) -> Array:
    """Corners (n, 2) of every part of an image: the sharpest of the whole would all be on the object."""
    height, width = grey.shape
    found = [np.zeros((0, 2))]
    for rows in np.array_split(np.arange(height), _CELLS):
        for columns in np.array_split(np.arange(width), _CELLS):
            cell = grey[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
            corners = cv2.goodFeaturesToTrack(cell, _CORNERS, 0.02, _SPACING, blockSize=5)
            found += [] if corners is None else [corners.reshape(-1, 2) + np.array([columns[0], rows[0]])]
    return np.concatenate(found)
