"""Appearance model of an object: points on it in the coordinates of the first frame, with the patches around them.

Points of an image are compared with the model, so that blur, an occluder or a look-alike that drags points along is
noticed; sure matches update the model, and new points replace those that stay hidden.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kpirl_ocp.errors import DemonstrationError
from kpirl_ocp.perception.tracking.appearance import Views, correlation, detail
from kpirl_ocp.perception.tracking.similarity import transform
from kpirl_ocp.types import Array, Mask

_POINTS = 200
_LIKE = 0.6  # correlation from which a point looks as it should
_RENEWAL = 0.1  # weight of the newest look in the memory
SPACING = 4  # between corners [pixels]
_BLURRED = 0.6  # share of the detail that a blurred object shows
_EDGE = 3.0  # points nearer to the image's edge are out of view [pixels]
_FEWEST = 8


class Located(NamedTuple):
    """An object located in a frame.

    time: [s]. pose: (3, 3) similarity from the first frame. points: (n, 2) [pixels], its points in this frame.
    found: (n,) which of them were found there and look as they should; none while the object is lost.
    in_view: (n,) which of them the image should show.
    """

    time: float
    pose: Array
    points: Array
    found: Mask
    in_view: Mask

    @property
    def confidence(self) -> float:
        """Share of the points in view that were found."""
        return float(self.found.sum() / max(1, self.in_view.sum()))


@dataclass(eq=False)
class ObjectModel:
    """Points of an object.

    mask: (H, W) bool, the object in the first frame. points: (n, 2) [pixels] there.
    looks: grey values around them, (n, m) in the sharp and (n, m) in the smooth view.
    """

    mask: Mask
    points: Array
    looks: tuple[Array, Array]

    @classmethod
    def of(cls, views: Views, mask: Mask) -> ObjectModel:
        """The corners on a mask in the first frame. Raises DemonstrationError if there is too little to hold on to."""
        points = corners(views.sharp, mask, _POINTS)
        if len(points) < _FEWEST:
            raise DemonstrationError(
                f"the object shows {len(points)} corners where at least {_FEWEST} are needed: mark a larger part of "
                "it, or film it nearer, sharper, or with something printed on it."
            )
        return cls(mask, points, views.patches(points, np.eye(3)))

    def in_view(self, pose: Array, shape: tuple[int, ...]) -> Mask:
        """Mask of the points (n,) that are inside an image of the shape (H, W) at a pose."""
        places = transform(pose, self.points)
        return np.all((places > _EDGE) & (places < np.array(shape[1::-1]) - 1 - _EDGE), axis=1)

    def alike(self, views: Views, pose: Array, chosen: NDArray[np.intp]) -> Mask:
        """Mask of the chosen points whose patches match the model, in one of the two views."""
        seen = views.patches(transform(pose, self.points[chosen]), pose)
        pairs = zip(self.looks, seen, strict=True)
        return np.any([correlation(look[chosen], now) > _LIKE for look, now in pairs], axis=0)

    def blurred(self, views: Views, pose: Array, found: Mask) -> bool:
        """Whether the points found (n,) show much less detail than remembered."""
        now = views.patches(transform(pose, self.points[found]), pose)[0]
        return detail(now) < _BLURRED * detail(self.looks[0][found])

    def remember(self, views: Views, pose: Array, found: Mask) -> None:
        """Renew the looks of the points found (n,)."""
        now = views.patches(transform(pose, self.points[found]), pose)
        for look, values in zip(self.looks, now, strict=True):
            look[found] += _RENEWAL * (values - look[found])

    def grow(self, views: Views, pose: Array, alike: Mask, found: Mask) -> Mask:
        """Add corners where the object has none that looks as remembered, in the place of those that do not.

        Gives `found` (n,) for the new set of points.
        """
        height, width = views.sharp.shape
        free = cv2.warpAffine(self.mask.astype(np.uint8), pose[:2], (width, height))
        for x, y in transform(pose, self.points[alike]).astype(int).tolist():
            cv2.circle(free, (x, y), SPACING + 1, 0, -1)
        new = corners(views.sharp, free > 0, _POINTS // 5)
        keep = np.sort(np.argsort(~alike, kind="stable")[: _POINTS - len(new)])
        looks = views.patches(new, pose)
        self.points = np.vstack([self.points[keep], transform(np.asarray(np.linalg.inv(pose), float), new)])
        first, second = (np.vstack([old[keep], added]) for old, added in zip(self.looks, looks, strict=True))
        self.looks = first, second
        return np.append(found[keep], np.ones(len(new), bool))


def corners(grey: NDArray[np.uint8], mask: Mask, count: int) -> Array:
    """At most `count` corners (n, 2) on a mask (Shi and Tomasi, 1994), best first."""
    found = cv2.goodFeaturesToTrack(grey, count, 0.005, SPACING, mask=mask.astype(np.uint8), blockSize=5)
    return np.zeros((0, 2)) if found is None else found.reshape(-1, 2).astype(float)
