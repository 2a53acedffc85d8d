"""Points of the surroundings that are seen where an object should be: something came in front of it.

Something that hides an object takes the object's points along, and its pose with them. But it was seen beside the
object before, and its points are followed from there (Kanade, Lucas and Tomasi, 1991), by themselves and without the
object's pose. Where they are in the outline, they explain what is seen there, and the object does not. Each is first
seen outside, and one that the object hides is lost, so none of them is the object's own.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from kpirl_ocp.perception.tracking.appearance import Views
from kpirl_ocp.perception.tracking.optical_flow import follow
from kpirl_ocp.types import Array, Mask

_MARGIN, _INSIDE, _FAR = 0.1, 0.05, 0.8  # of the outline where none begins, inside which they count, where they begin
_AROUND = 0.2  # what is nearer to one is what it belongs to [size of the object]
_POINTS, _SPACING = 150, 5  # corners that begin, at most; between points [pixels]
_WINDOW, _GAP = 15, 0.5  # [pixels]
_CORNER = 0.01  # quality of a corner, of the best one's


@dataclass(eq=False)
class Intruders:
    """Points (n, 2) [pixels] of the surroundings in the last frame, and its views. size: of the object [pixels]."""

    mask: Mask
    size: float
    points: Array
    before: Views

    @classmethod
    def of(cls, views: Views, mask: Mask) -> Intruders:
        """The surroundings of an object (H, W) in the first frame."""
        things = cls(mask, float(np.sqrt(mask.sum())), np.zeros((0, 2)), views)
        things.begin(views, np.eye(3))
        return things

    def follow(self, views: Views) -> None:
        """To the next frame."""
        there, held = follow(self.before.sharp, views.sharp, self.points, self.points, _WINDOW, _GAP)
        self.points, self.before = there[held], views

    def hide(self, pose: Array, places: Array) -> Mask:
        """Which of the places (m, 2) of an object at a pose (3, 3) show something that came in front of it."""
        outline = self._outline(pose, -_INSIDE)
        columns, rows = np.clip(self.points.round().astype(int), 0, np.array(outline.shape[::-1]) - 1).T
        inside = self.points[outline[rows, columns] > 0]
        if not len(inside):
            return np.zeros(len(places), bool)
        gaps = np.linalg.norm(places[:, None] - inside, axis=-1)
        return np.asarray(gaps.min(axis=1) < _AROUND * self.size, bool)

    def begin(self, views: Views, pose: Array) -> None:
        """New points around the object, where there are none."""
        free = cv2.subtract(self._outline(pose, _FAR), self._outline(pose, _MARGIN))
        for x, y in self.points.astype(int).tolist():
            cv2.circle(free, (x, y), _SPACING, 0, -1)
        new = cv2.goodFeaturesToTrack(views.sharp, _POINTS, _CORNER, _SPACING, mask=free, blockSize=5)
        if new is not None:
            self.points = np.vstack([self.points, new.reshape(-1, 2)])

    def _outline(self, pose: Array, margin: float) -> cv2.typing.MatLike:
        """The object at a pose, 255 or 0, larger by a margin [size of the object], or smaller."""
        height, width = self.mask.shape
        there = cv2.warpAffine(255 * self.mask.astype(np.uint8), pose[:2], (width, height), flags=cv2.INTER_NEAREST)
        side = 2 * round(abs(margin) * self.size) + 1
        change = cv2.dilate if margin > 0 else cv2.erode
        return change(there, np.ones((side, side), np.uint8))
