"""Which of several equal things is the object: their looks do not tell, only the ways on which they are followed.

Each twin is followed like the object itself, so that what it shows is not taken for the object (explaining away). A
place belongs to the object if the ways of all to their places are clearly shorter together than with a twin there
(Kuhn, 1955), by a margin that grows while one is not seen. A thing may be hidden only where another one is seen. If the
ways do not tell, nothing later does, since nothing else distinguishes them: the object is confused for good.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from kpirl_ocp.perception.tracking.identity.lookalikes import middle
from kpirl_ocp.perception.tracking.similarity import shifted, transform
from kpirl_ocp.types import Array, Mask

_CLEAR, _SPREAD, _FARTHEST = 15.0, 10.0, 100.0  # margin: at first, more per frame unseen, largest addition [pixels]
_VANISHED = 30.0  # cost of a thing that is not seen though nothing hides it [pixels]
_ADDED = 100.0  # cost of a place of none of the things
_NEVER = 1e6
_FORGOTTEN = 60  # frames after which a twin that is not seen is one no longer


@dataclass(frozen=True)
class Thing:
    """One of the equal things: its pose (3, 3), the step (2,) to the next one, and for how many frames it is unseen."""

    pose: Array
    step: Array
    unseen: int = 0

    @property
    def ahead(self) -> Array:
        """The pose in the next frame, at constant velocity."""
        return shifted(self.pose, self.step)

    def moved(self, pose: Array | None, centre: Array) -> Thing:
        """To a pose in the next frame, or on, unseen."""
        if pose is None:
            return replace(self, pose=self.ahead, unseen=self.unseen + 1)
        missed = transform(pose, centre) - transform(self.ahead, centre)
        return Thing(pose, self.step + missed / (1 + self.unseen))


@dataclass(eq=False)
class Twins:
    """The object itself, its twins, and whether it is confused with one of them.

    centre: (2,) of the object in the first frame. size: of it [pixels].
    """

    centre: Array
    size: float
    itself: Thing
    others: list[Thing] = field(default_factory=list)
    confused: bool = False

    @classmethod
    def of(cls, mask: Mask) -> Twins:
        """The object (H, W) alone, at rest."""
        return cls(middle(mask), float(np.sqrt(mask.sum())), Thing(np.eye(3), np.zeros(2)))

    def same(self, one: Array, other: Array) -> bool:
        """Whether two poses (3, 3) are of one thing."""
        return self._gap(one, other) < _CLEAR

    def nearer(self, pose: Array, twin: int) -> bool:
        """Whether the object was expected nearer to a pose (3, 3) than a twin."""
        return self._gap(self.itself.ahead, pose) < self._gap(self.others[twin].ahead, pose)

    def near(self, pose: Array) -> bool:
        """Whether a twin may hide a part of the object at a pose (3, 3), or show it."""
        return any(self._gap(thing.pose, pose) < 2 * self.size for thing in self.others)

    def unknown(self, pose: Array, places: Array) -> list[Array]:
        """Offsets (2,), from the object at a pose (3, 3), of those of the places (m, 2) where no twin is known."""
        known = np.array([transform(thing.pose, self.centre) for thing in self.others if not thing.unseen])
        offsets = places - transform(pose, self.centre)
        return [
            offset
            for place, offset in zip(places, offsets, strict=True)
            if not len(known) or np.linalg.norm(known - place, axis=1).min() > self.size / 2
        ]

    def add(self, pose: Array) -> None:
        """A twin at a pose (3, 3): the nearest one that was not seen, or a new one."""
        hidden = [index for index, thing in enumerate(self.others) if thing.unseen]
        if hidden:
            nearest = min(hidden, key=lambda index: self._gap(self.others[index].pose, pose))
            if self._gap(self.others[nearest].pose, pose) < self._margin(self.others[nearest]):
                self.others[nearest] = Thing(pose, np.zeros(2))
                return
        self.others.append(Thing(pose, np.zeros(2)))
        self.confused |= self._gap(self.itself.pose, pose) < self.size / 2

    def settle(self, pose: Array | None, others: Sequence[Array | None]) -> bool:
        """Move all to where they are seen (3, 3), or None; gives whether the object is at its pose.

        If that may be a twin, the object is confused from now on.
        """
        owner = 0 if pose is None else self._owner(pose, others)
        mine = pose is not None and owner == 0
        self.itself = self.itself.moved(pose if mine else None, self.centre)
        places = [pose if owner == twin + 1 else at for twin, at in enumerate(others)]
        moved = [thing.moved(at, self.centre) for thing, at in zip(self.others, places, strict=True)]
        self.others = [thing for thing in moved if thing.unseen < _FORGOTTEN]
        return mine

    def _owner(self, pose: Array, others: Sequence[Array | None]) -> int:
        """Whose a pose is: 0 the object's, else that of a twin, counted from 1."""
        seen = [pose, *(at for at in others if at is not None and not self.same(at, pose))]
        lengths = np.array([self._length(seen, thing) for thing in range(len(self.others) + 1)])
        best = int(lengths.argmin())
        things = [self.itself, *self.others]
        slack = np.array([_CLEAR + self._margin(things[0]) + self._margin(thing) for thing in things])
        rivals = (lengths - lengths[0] < slack)[1:] if best == 0 else lengths[:1] - lengths[best] < slack[best]
        self.confused |= bool(rivals.any())
        return best

    def _length(self, seen: Sequence[Array], owner: int) -> float:
        """Length of the shortest way of all to what is seen, if the first of it is the owner's."""
        things = [self.itself, *self.others]
        ways = np.array([[self._gap(thing.ahead, at) for at in seen] for thing in things])
        hidden = np.where((ways.min(axis=1) < self.size) | [thing.unseen > 0 for thing in things], 0.0, _VANISHED)
        costs = np.full((len(things) + len(seen),) * 2, _NEVER)
        costs[: len(things), : len(seen)] = ways
        costs[: len(things), len(seen) :] = np.where(np.eye(len(things)) > 0, hidden, _NEVER)
        costs[len(things) :, : len(seen)] = _ADDED
        costs[len(things) :, len(seen) :] = 0.0
        costs[np.arange(len(costs)) != owner, 0] = _NEVER
        rows, columns = linear_sum_assignment(costs)
        return float(costs[rows, columns].sum())

    def _gap(self, one: Array, other: Array) -> float:
        return float(np.linalg.norm(transform(one, self.centre) - transform(other, self.centre)))

    def _margin(self, thing: Thing) -> float:
        return min(_SPREAD * thing.unseen, _FARTHEST)
