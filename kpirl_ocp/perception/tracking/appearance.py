"""Looks: patches around points of an object, sharp and smoothed, so that motion blur hides none; and its colours."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kpirl_ocp.perception.data.video import Frames
from kpirl_ocp.types import Array

_BLUR = 3.0  # standard deviation of the smooth view [pixels]
RADII = (10, 20)  # of a patch in the sharp and in the smooth view [pixels]
_ACROSS = 11  # samples along a side of a patch
COARSE = 3  # every so many pixels of the colours are compared, along x and y; they are smooth
_PLACES = 4  # that look alike, at most


Greys = tuple[NDArray[np.uint8], NDArray[np.uint8]]


class Views(NamedTuple):
    """A frame as it is compared: grey sharp and smooth, each (H, W), and in smooth colours (H, W, 3)."""

    sharp: NDArray[np.uint8]
    smooth: NDArray[np.uint8]
    colour: Frames

    @classmethod
    def of(cls, image: Frames) -> Views:
        """The views of an image (H, W, 3) RGB."""
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
        smooth, colour = (np.asarray(cv2.GaussianBlur(view, (0, 0), _BLUR), np.uint8) for view in (grey, image))
        return cls(grey, smooth, colour)

    @property
    def grey(self) -> Greys:
        """The sharp and the smooth view."""
        return self.sharp, self.smooth

    def patches(self, points: Array, pose: Array) -> tuple[Array, Array]:
        """Grey values around points (n, 2), turned and scaled with the object: (n, m) sharp and (n, m) smooth."""
        sharp, smooth = (sample(view, points, pose, r) for view, r in zip(self.grey, RADII, strict=True))
        return sharp, smooth


class Shown(NamedTuple):
    """A grey view (H, W) of a frame, 0: the sharp one, 1: the smooth one, and the pose (3, 3) of an object in it."""

    view: NDArray[np.uint8]
    level: int
    pose: Array


class Memory(NamedTuple):
    """A frame, and the pose (3, 3) of the object in it."""

    views: Views
    pose: Array

    def at(self, pose: Array, level: int = 0) -> Shown:
        """A view warped as if the object were at another pose: flow compares patches that are not turned."""
        view, motion = self.views.grey[level], pose @ np.linalg.inv(self.pose)
        moved = cv2.warpAffine(view, motion[:2], view.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
        return Shown(np.asarray(moved, np.uint8), level, pose)


def sample(view: NDArray[np.uint8], points: Array, pose: Array, radius: int) -> Array:
    """Values (n, m) of a view (H, W) on grids around points (n, 2), turned and scaled by a pose (3, 3)."""
    grid = _grid(radius) @ pose[:2, :2].T
    if not len(points):
        return np.zeros((0, len(grid)))
    x, y = ((points[:, None, axis] + grid[:, axis]).astype(np.float32) for axis in (0, 1))
    sampled = cv2.remap(view, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(sampled, float).reshape(len(points), -1)


@lru_cache(maxsize=8)
def _grid(radius: int) -> Array:
    """Places (m, 2) of the values around a point."""
    axis = np.linspace(-radius, radius, _ACROSS)
    return np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)


def correlation(one: Array, other: Array) -> Array:
    """Normalised cross-correlation (n,) of patches (n, m); 0 where a patch is of one grey."""
    one, other = (values - values.mean(1, keepdims=True) for values in (one, other))
    return (one * other).sum(1) / np.maximum(np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1), 1e-9)


def detail(patches: Array) -> float:
    """Mean difference of neighbouring samples in patches (n, m)."""
    grids = patches.reshape(-1, _ACROSS, _ACROSS)
    return float(np.abs(np.diff(grids, axis=1)).mean() + np.abs(np.diff(grids, axis=2)).mean())


def correlations(scene: NDArray[np.uint8], picture: NDArray[np.uint8], shape: NDArray[np.uint8]) -> Array:
    """Normalised correlation of a picture, where its shape is, with every window of a scene."""
    scores = np.asarray(cv2.matchTemplate(scene, picture, cv2.TM_CCOEFF_NORMED, mask=shape), float)
    return np.where(np.isfinite(scores), scores, -1.0)  # windows of one colour have no correlation


def peaks(scores: Array, least: float, apart: tuple[int, int]) -> NDArray[np.intp]:
    """The few places (n, 2), x and y, with the largest scores of at least so much.

    apart: semi-axes of the ellipse around each in which there is no other.
    """
    found, left = [], np.array(scores, np.float32)
    for _ in range(_PLACES):
        row, column = np.unravel_index(int(left.argmax()), left.shape)
        if left[row, column] < least:
            break
        found.append((int(column), int(row)))
        cv2.ellipse(left, found[-1], apart, 0, 0, 360, -1.0, cv2.FILLED)
    return np.array(found, np.intp).reshape(-1, 2)


def coarse(view: cv2.typing.MatLike) -> NDArray[np.uint8]:
    """Every third pixel along x and y."""
    return np.array(view[::COARSE, ::COARSE], np.uint8)
