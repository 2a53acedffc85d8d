"""The pose in which an object looks most like itself in an earlier frame, by all of its pixels.

A point is followed by what is in a window around it. Near the outline of an object that is the background as well, and
it draws the point along: steps from frame to frame then lag behind a faint object. Here only pixels inside the outline
count. With T the values of the template and I(W) those of the image at the places W x, both with mean 0 and norm 1,
the enhanced correlation coefficient rho = T' I(W) (Evangelidis and Psarakis, 2008) is raised by Gauss-Newton steps in
the coordinates of the template (inverse composition: Baker and Matthews, 2004). J is the derivative of T by the
similarity S(d), d = 0 standing for the identity:

    d = argmin |I(W) / rho - T - J d|^2,    W <- W S(d)^-1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kpirl_ocp.perception.tracking.appearance import Views
from kpirl_ocp.perception.tracking.similarity import transform
from kpirl_ocp.types import Array, Mask

_STEPS = 20  # of Gauss-Newton, at most, in each of the two views
_SETTLED = 0.01  # a step that moves no pixel farther is the last [pixels]
_MOST = 4000  # pixels that are compared, at most
_UNLIKE = 0.3  # correlation below which a step leads nowhere


class Look(NamedTuple):
    """Values T (n,) of a template in one view, and the pseudo-inverse (4, n) of J: along x, along y, growth, turn."""

    values: Array
    inverse: Array


@dataclass(frozen=True, eq=False)
class Template:
    """An object in a frame.

    places: (n, 2) pixels inside its outline. middle: (2,) of them. radius: distance of the farthest from it [pixels].
    looks: what the sharp and the smooth view show there.
    """

    places: Array
    middle: Array
    radius: float
    looks: tuple[Look, Look]

    @classmethod
    def of(cls, views: Views, mask: Mask) -> Template:
        """The object under a mask (H, W)."""
        rows, columns = np.nonzero(mask)
        places = np.column_stack([columns, rows])[:: 1 + len(rows) // _MOST]
        middle = places.mean(axis=0)
        radius = max(1.0, float(np.linalg.norm(places - middle, axis=1).max()))
        sharp, smooth = (_look(view, places, (places - middle) / radius) for view in views.grey)
        return cls(places.astype(float), middle, radius, (sharp, smooth))

    def align(self, views: Views, pose: Array) -> tuple[Array, float]:
        """The pose (3, 3) near a guess in which an image looks most like the template, and rho in the sharp view.

        The smooth view leads there from farther away, some six pixels.
        """
        for level in (1, 0):
            pose, rho = self._climb(views.grey[level], self.looks[level], pose)
        return pose, rho

    def _climb(self, view: NDArray[np.uint8], look: Look, pose: Array) -> tuple[Array, float]:
        """Steps d in one view (H, W), until they are short or nothing is alike; gives the pose and rho."""
        seen, rho = self._correlated(view, look, pose)
        length = np.inf
        for _ in range(_STEPS):
            if rho < _UNLIKE or length < _SETTLED:
                break
            step = look.inverse @ (seen / rho - look.values)
            pose, length = pose @ np.linalg.inv(self._similarity(step)), float(np.abs(step).sum())
            seen, rho = self._correlated(view, look, pose)
        return pose, rho

    def _correlated(self, view: NDArray[np.uint8], look: Look, pose: Array) -> tuple[Array, float]:
        """Values I(W) (n,) of a view (H, W), and their rho."""
        at = transform(pose, self.places).astype(np.float32)[:, None]
        seen = cv2.remap(view, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        values = _normalised(np.asarray(seen, float).ravel())
        return values, float(look.values @ values)

    def _similarity(self, step: Array) -> Array:
        """S(d) (3, 3) about the middle; growth and turn move the farthest pixel by d [pixels]."""
        grown, turned = 1 + step[2] / self.radius, step[3] / self.radius
        linear = np.array([[grown, -turned], [turned, grown]])
        moved = np.eye(3)
        moved[:2, :2], moved[:2, 2] = linear, step[:2] + self.middle - linear @ self.middle
        return moved


def _look(view: NDArray[np.uint8], places: NDArray[np.intp], arms: Array) -> Look:
    """The look of a view (H, W) at places (n, 2) of pixels. arms: (n, 2) from the middle to them [radius]."""
    columns, rows = places.T
    grey = view.astype(float)
    values = grey[rows, columns]
    along_y, along_x = (slope[rows, columns] for slope in np.gradient(grey))
    growth, turn = along_x * arms[:, 0] + along_y * arms[:, 1], along_y * arms[:, 0] - along_x * arms[:, 1]
    slopes = np.column_stack([along_x, along_y, growth, turn])
    slopes = (slopes - slopes.mean(axis=0)) / _length(values - values.mean())
    values = _normalised(values)
    return Look(values, np.linalg.pinv(slopes - np.outer(values, values @ slopes)))  # J of T at mean 0 and norm 1


def _normalised(values: Array) -> Array:
    centred = values - values.mean()
    return np.asarray(centred / _length(centred), float)


def _length(values: Array) -> float:
    """Norm of values (n,); of one grey level at least, so that a surface of one grey is like nothing."""
    return max(1.0, float(np.linalg.norm(values)))
