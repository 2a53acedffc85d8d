"""Candidate places of a lost object: those with its colours, near its last known place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kpirl_ocp.perception.tracking.appearance import Greys, Views
from kpirl_ocp.perception.tracking.similarity import shifted, transform
from kpirl_ocp.types import Array, Mask

_RADIUS, _SPREAD, _FARTHEST = 25.0, 10.0, 150.0  # of the search: at first, more with each frame, at most [pixels]
_ALIKE = 0.5  # normalised correlation of colours
_PLACES = 4
_COARSE = 3  # every so many pixels are compared, along x and y; the colours are smooth
_APART = 15  # two places are one within this distance [pixels]
_SMALLEST = 100  # of the object's part in view [pixels]
_TWIN = 0.7  # normalised correlation of colours of another thing that looks like the object
_SAME = 12.0  # mean difference of colours of a thing that rests where it was, light and noise [grey values]


class Memory(NamedTuple):
    """A frame, and the pose (3, 3) of the object in it."""

    views: Views
    pose: Array

    def at(self, pose: Array) -> Greys:
        """The grey views warped as if the object were at another pose: flow compares patches that are not turned."""
        return self.views.turned(pose @ np.linalg.inv(self.pose))


@dataclass(frozen=True, eq=False)
class Twins:
    """Things that look like the object, where they are in the first frame: as long as they rest there, they are not it.

    first: the first frame. mask: (H, W) the object there. offsets: (n, 2) from the object to the others [pixels].
    """

    first: Views
    mask: Mask
    offsets: Array

    @classmethod
    def of(cls, first: Views, mask: Mask) -> Twins:
        """Those of the first frame."""
        scene, there = _coarse(first.colour), _coarse(mask.astype(np.uint8))
        x, y, w, h = cv2.boundingRect(there)
        picture, shape = scene[y : y + h, x : x + w], there[y : y + h, x : x + w]
        scores = _correlations(scene, picture, shape)
        scores[max(0, y - h) : y + h, max(0, x - w) : x + w] = -1.0
        places = _peaks(scores, _TWIN, max(w, h) // 2)
        return cls(first, mask, _COARSE * (np.array(places, float).reshape(-1, 2) - [x, y]))

    def is_one(self, views: Views, pose: Array) -> bool:
        """Whether it is one of them that is seen at a pose (3, 3) of the object."""
        rows, columns = np.nonzero(self.mask)
        middle = np.array([columns.mean(), rows.mean()])
        gaps = np.linalg.norm(self.offsets + middle - transform(pose, middle), axis=1)
        return any(self._rests(views, offset) for offset in self.offsets[gaps < _APART])

    def _rests(self, views: Views, offset: Array) -> bool:
        height, width = self.mask.shape
        there = cv2.warpAffine(self.mask.astype(np.uint8), shifted(np.eye(3), offset)[:2], (width, height)) > 0
        difference = np.abs(views.colour[there].astype(float) - self.first.colour[there])
        return bool(there.any() and difference.mean() < _SAME)


def candidates(views: Views, memory: Memory, pose: Array, mask: Mask, lost: int) -> list[Array]:
    """Poses (3, 3) at which the object may be, by its picture in a remembered frame, turned as in `pose`.

    Args:
        mask: (H, W) the object in the first frame.
        lost: for how many frames it has been lost.
    """
    height, width = mask.shape
    there = cv2.warpAffine(mask.astype(np.uint8), pose[:2], (width, height))
    if there.sum() < _SMALLEST:
        return []
    turned = cv2.warpAffine(memory.views.colour, (pose @ np.linalg.inv(memory.pose))[:2], (width, height))
    scene, turned, there = (_coarse(view) for view in (views.colour, turned, there))
    x, y, w, h = cv2.boundingRect(there)
    r = int(min(_RADIUS + _SPREAD * lost, _FARTHEST)) // _COARSE
    left, top = max(0, x - r), max(0, y - r)
    window = scene[top : y + h + r, left : x + w + r]
    picture, shape = turned[y : y + h, x : x + w], there[y : y + h, x : x + w]
    scores = _correlations(window, picture, shape)
    corner = np.array([left - x, top - y])
    return [
        shifted(pose, _COARSE * (place + corner).astype(float)) for place in _peaks(scores, _ALIKE, _APART // _COARSE)
    ]


def _correlations(scene: NDArray[np.uint8], picture: NDArray[np.uint8], shape: NDArray[np.uint8]) -> Array:
    """Normalised correlation of a picture, where its shape is, with every window of a scene."""
    scores = np.asarray(cv2.matchTemplate(scene, picture, cv2.TM_CCOEFF_NORMED, mask=shape), float)
    return np.where(np.isfinite(scores), scores, -1.0)  # windows of one colour have no correlation


def _peaks(scores: Array, least: float, apart: int) -> list[Array]:
    """The few places (x, y) with the largest scores of at least so much, further apart than so many pixels."""
    found: list[Array] = []
    scores = scores.copy()
    for _ in range(_PLACES):
        row, column = np.unravel_index(int(scores.argmax()), scores.shape)
        if scores[row, column] < least:
            break
        found.append(np.array([column, row]))
        scores[max(0, row - apart) : row + apart + 1, max(0, column - apart) : column + apart + 1] = -1.0
    return found


def _coarse(view: cv2.typing.MatLike) -> NDArray[np.uint8]:
    return np.array(view[::_COARSE, ::_COARSE], np.uint8)
