"""Points of the surroundings that are seen where an object should be: something came in front of it.

Something that hides an object takes the object's points along, and its pose with them. But it was seen beside the
object before, and its corners are followed from there (Kanade, Lucas and Tomasi, 1991), by themselves and without the
object's pose. One that the object covers no longer looks as it did, and is lost; one that still does, inside the
outline, lies in front. It stays an intruder wherever the object is thought to be later, so that a pose that was taken
along does not make it the object's.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from kpirl_ocp.perception.tracking.appearance import Views, correlation, sample
from kpirl_ocp.perception.tracking.model import SPACING, corners
from kpirl_ocp.perception.tracking.optical_flow import follow
from kpirl_ocp.types import Array, Mask

_WINDOW, _GAP = 11, 0.7  # side of the patch that is followed, and gap of its way back [pixels]
_RADIUS, _LIKE = 5, 0.8  # of a look [pixels], and correlation with it of a corner that is seen
_INSIDE = 3.0  # from the outline, of a corner in front of the object [pixels]
_COUNT = 300  # corners taken up in a frame, at most
_NEAR = 12.0  # an intruder hides what is within this: it is in the patch by which a point is followed [pixels]


@dataclass(eq=False)
class Intruders:
    """Corners of other things around the object, those among them that have come onto it, and the frame before.

    depth: (H, W) inside the object's outline in the first frame, negative outside [pixels]. size: of it [pixels].
    places: (n, 2) [pixels]. looks: (n, m) grey values around them at first. inside: (n,) the intruders.
    """

    depth: NDArray[np.float32]
    size: float
    before: Views
    places: Array
    looks: Array
    inside: Mask

    @classmethod
    def of(cls, views: Views, mask: Mask) -> Intruders:
        """The corners around an object (H, W) in the first frame."""
        inside, outside = (_distance(part) for part in (mask, ~mask))
        size, nothing = float(np.sqrt(mask.sum())), np.zeros((0, 2))
        found = cls(inside - outside, size, views, nothing, _looks(views, nothing), np.zeros(0, bool))
        found.judge(np.eye(3))
        return found

    def follow(self, views: Views) -> None:
        """To the next frame."""
        there, held = follow(self.before.sharp, views.sharp, self.places, self.places, _WINDOW, _GAP)
        held &= correlation(self.looks, _looks(views, there)) > _LIKE
        self.places = there
        self._keep(held)
        self.before = views

    def hide(self, places: Array) -> Mask:
        """Which of the places (m, 2) show an intruder."""
        gaps = np.linalg.norm(places[:, None] - self.places[self.inside], axis=-1)
        return np.asarray(gaps.min(axis=1, initial=np.inf) < _NEAR)

    def judge(self, pose: Array) -> None:
        """By the pose (3, 3) of the object in this frame; takes up other corners around it."""
        height, width = self.depth.shape
        depth = cv2.warpAffine(self.depth, pose[:2], (width, height), borderMode=cv2.BORDER_REPLICATE)
        columns, rows = self.places.round().astype(int).T.clip(0, [[width - 1], [height - 1]])
        self.inside |= depth[rows, columns] > _INSIDE
        self._keep(self.inside | (depth[rows, columns] > -2 * self.size))
        self._take_up((depth < -SPACING) & (depth > -self.size))

    def _take_up(self, around: Mask) -> None:
        free = around.astype(np.uint8)
        for x, y in self.places.astype(int).tolist():
            cv2.circle(free, (x, y), SPACING, 0, -1)
        new = corners(self.before.sharp, free > 0, _COUNT)
        self.places = np.vstack([self.places, new])
        self.looks = np.vstack([self.looks, _looks(self.before, new)])
        self.inside = np.append(self.inside, np.zeros(len(new), bool))

    def _keep(self, these: Mask) -> None:
        self.places, self.looks, self.inside = self.places[these], self.looks[these], self.inside[these]


def _distance(part: Mask) -> NDArray[np.float32]:
    """Distance (H, W) of the pixels in a part of an image from the rest of it; 0 in the rest [pixels]."""
    return np.asarray(cv2.distanceTransform(part.astype(np.uint8), cv2.DIST_L2, 5), np.float32)


def _looks(views: Views, places: Array) -> Array:
    return sample(views.sharp, places, np.eye(3), _RADIUS)
