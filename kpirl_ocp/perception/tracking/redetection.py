"""Candidate places of a lost object: those with its colours, near its last known place."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kpirl_ocp.perception.tracking.appearance import Greys, Views
from kpirl_ocp.perception.tracking.similarity import shifted
from kpirl_ocp.types import Array, Mask

_RADIUS, _SPREAD, _FARTHEST = 25.0, 10.0, 150.0  # of the search: at first, more with each frame, at most [pixels]
_ALIKE = 0.5  # normalised correlation of colours
_PLACES = 4
_COARSE = 3  # every so many pixels are compared, along x and y; the colours are smooth
_APART = 15  # two places are one within this distance [pixels]
_SMALLEST = 100  # of the object's part in view [pixels]


class Memory(NamedTuple):
    """A frame, and the pose (3, 3) of the object in it."""

    views: Views
    pose: Array

    def at(self, pose: Array) -> Greys:
        """The grey views warped as if the object were at another pose: flow compares patches that are not turned."""
        return self.views.turned(pose @ np.linalg.inv(self.pose))


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
    scores = cv2.matchTemplate(window, picture, cv2.TM_CCOEFF_NORMED, mask=shape)
    scores = np.where(np.isfinite(scores), scores, -1.0)  # windows of one colour have no correlation
    found = []
    for _ in range(_PLACES):
        row, column = np.unravel_index(int(scores.argmax()), scores.shape)
        if scores[row, column] < _ALIKE:
            break
        found.append(shifted(pose, _COARSE * np.array([left + column - x, top + row - y], float)))
        apart = _APART // _COARSE
        scores[max(0, row - apart) : row + apart + 1, max(0, column - apart) : column + apart + 1] = -1.0
    return found


def _coarse(view: cv2.typing.MatLike) -> NDArray[np.uint8]:
    return np.array(view[::_COARSE, ::_COARSE], np.uint8)
