"""Where an object may be whose points are lost: its colours nearby, and its outline among things that look like it.

Where it turns, or is blurred, colours and outline still say where things of its kind are; which of them it is follows
from where all of them were. The places seen in a frame are assigned to the things so that their way together is
shortest (Kuhn, 1955); if the object could as well be elsewhere, no place is believed.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from kpirl_ocp.perception.tracking.appearance import COARSE, Memory, Views, coarse, correlations, peaks
from kpirl_ocp.perception.tracking.similarity import shifted, transform
from kpirl_ocp.types import Array, Mask

_RADIUS, _LARGER, _WIDEST = 25.0, 10.0, 150.0  # of the search: at first, more per frame, at most [pixels]
_COLOURS = 0.5  # normalised correlation of colours, without surroundings
_SMALLEST = 100  # of the object's part in view [pixels]
_MARGIN = 0.12  # of surroundings, against which the outline is seen [size of the object]
_ALIKE = 0.6  # normalised correlation of colours, margin included, of a thing of the object's kind
_OVERLAP = 0.6  # two things are further apart, along x or y [size of the object]
_FORGOTTEN = 60  # frames after which a thing that is not seen is one no longer
_REACH, _SPREAD, _FARTHEST = 20.0, 5.0, 150.0  # from where a thing should be: at first, per frame unseen, most [pixels]
_CLEAR = 15.0  # by which the next best assignment is longer; nearer places are the same [pixels]
_UNSEEN = 1e3  # cost of a thing that is not seen: more than the ways of a few things
_NEWEST = 0.5  # weight of the newest step in a velocity
_FADING = 0.8  # of the velocity of a thing that is not seen, per frame


@dataclass(eq=False)
class Lookalikes:
    """The object and the things that look like it.

    mask: (H, W) the object in the first frame. memory: the last frame in which it was seen well.
    places, velocities: (n, 2) middles [pixels], and their steps from frame to frame; the object's first.
    unseen, seen: (n,) for how many frames in a row each has not been seen, and has been.
    """

    mask: Mask
    memory: Memory
    places: Array
    velocities: Array
    unseen: NDArray[np.intp]
    seen: NDArray[np.intp]

    @classmethod
    def of(cls, first: Memory, mask: Mask) -> Lookalikes:
        """The object alone, in the first frame."""
        place = transform(first.pose, middle(mask))
        return cls(mask, first, place[None], np.zeros((1, 2)), np.zeros(1, int), np.ones(1, int))

    def see(self, now: Memory, *, well: bool) -> Array:
        """Follow the others while the object's pose is known; well: most of the object is seen, and sharp.

        Gives the places (m, 2) of its kind that are not the object's.
        """
        self.memory = now if well else self.memory
        place = transform(now.pose, middle(self.mask))
        found = self._detect(now.views)
        others = found[np.linalg.norm(found - place, axis=1) > np.sqrt(self.mask.sum()) / 2]
        chosen = self._assign(self._ways(others)[1:])
        self._move(np.vstack([place, others]), np.append(0, np.where(chosen < 0, -1, chosen + 1)))
        keep, new = self.unseen < _FORGOTTEN, np.delete(others, chosen[chosen >= 0], axis=0)
        self.places = np.vstack([self.places[keep], new])
        self.velocities = np.vstack([self.velocities[keep], np.zeros_like(new)])
        self.unseen = np.append(self.unseen[keep], np.zeros(len(new), int))
        self.seen = np.append(self.seen[keep], np.ones(len(new), int))
        return others

    def look(self, views: Views) -> Array | None:
        """The pose (3, 3) of an object whose points are lost; None if it is not seen, or might be another thing."""
        found = self._detect(views)
        ways = self._ways(found)
        chosen = self._assign(ways)
        if chosen[0] >= 0 and not _clear(ways, chosen[0], len(found)):
            chosen[:] = -1
        self._move(found, chosen)
        if chosen[0] < 0:
            return None
        return shifted(self.memory.pose, self.places[0] - transform(self.memory.pose, middle(self.mask)))

    def is_other(self, pose: Array, frames: int) -> bool:
        """Whether another thing is at a pose (3, 3) of the object that has been seen in all of the last frames."""
        gaps = np.linalg.norm(self.places - transform(pose, middle(self.mask)), axis=1)
        return bool(((gaps < _CLEAR) & (self.seen > frames))[1:].any())

    def _detect(self, views: Views) -> Array:
        """Middles (m, 2) [pixels] of the things of the object's kind in a frame."""
        height, width = self.mask.shape
        side = 2 * round(_MARGIN * np.sqrt(self.mask.sum())) + 1
        there = cv2.warpAffine(self.mask.astype(np.uint8), self.memory.pose[:2], (width, height))
        there = cv2.dilate(there, np.ones((side, side), np.uint8))
        scene, picture, shape = (coarse(view) for view in (views.colour, self.memory.views.colour, there))
        x, y, w, h = cv2.boundingRect(shape)
        scores = correlations(scene, picture[y : y + h, x : x + w], shape[y : y + h, x : x + w])
        found = peaks(scores, _ALIKE, (round(_OVERLAP * w), round(_OVERLAP * h)))
        return transform(self.memory.pose, middle(self.mask)) + COARSE * (found - [x, y])

    def _ways(self, found: Array) -> Array:
        """Costs (n, m + n) of the places (m, 2) for each thing, and of not being seen."""
        ways = np.linalg.norm((self.places + self.velocities)[:, None] - found, axis=-1)
        reach = np.minimum(_REACH + _SPREAD * self.unseen, _FARTHEST)
        ways[ways > reach[:, None]] = 2 * _UNSEEN
        return np.hstack([ways, np.full((len(ways), len(ways)), _UNSEEN)])

    def _assign(self, ways: Array) -> NDArray[np.intp]:
        """Which place (n,) each thing is at; -1: it is not seen."""
        chosen = linear_sum_assignment(ways)[1]
        return np.where(chosen < ways.shape[1] - len(self.places), chosen, -1)

    def _move(self, found: Array, chosen: NDArray[np.intp]) -> None:
        """To the chosen places; things that are not seen go on for a while."""
        seen = chosen >= 0
        steps = (found[chosen[seen]] - self.places[seen]) / (1 + self.unseen[seen])[:, None]
        self.places[seen] = found[chosen[seen]]
        self.places[~seen] += self.velocities[~seen]
        self.velocities[seen] += _NEWEST * (steps - self.velocities[seen])
        self.velocities[~seen] *= _FADING
        self.unseen = np.where(seen, 0, self.unseen + 1)
        self.seen = np.where(seen, self.seen + 1, 0)


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
    scene, turned, there = (coarse(view) for view in (views.colour, turned, there))
    x, y, w, h = cv2.boundingRect(there)
    r = int(min(_RADIUS + _LARGER * lost, _WIDEST)) // COARSE
    left, top = max(0, x - r), max(0, y - r)
    window = scene[top : y + h + r, left : x + w + r]
    picture, shape = turned[y : y + h, x : x + w], there[y : y + h, x : x + w]
    scores = correlations(window, picture, shape)
    corner = np.array([left - x, top - y])
    found = peaks(scores, _COLOURS, (int(_CLEAR) // COARSE,) * 2)
    return [shifted(pose, COARSE * (place + corner)) for place in found.astype(float)]


def _clear(ways: Array, place: int, places: int) -> bool:
    """Whether the way of all is clearly longer if the object is at another of the places than this one."""

    def shortest(costs: Array) -> float:
        return float(costs[linear_sum_assignment(costs)].sum())

    elsewhere = ways.copy()
    elsewhere[0, place] = elsewhere[0, places:] = 2 * _UNSEEN
    return shortest(elsewhere) > shortest(ways) + _CLEAR


def middle(mask: Mask) -> Array:
    """Middle (2,) [pixels] of an object (H, W)."""
    rows, columns = np.nonzero(mask)
    return np.array([columns.mean(), rows.mean()])
