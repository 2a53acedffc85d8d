"""Follow one rigid object through a film.

From frame to frame its points are followed by optical flow, and the pose is the similarity that most of them agree on;
so points that are lost or hidden are restored by the others. A pose counts only if enough points also look as they
should. It is sure if a chain of sharp matches leads to it from the first frame: in the smooth view a window is as large
as a small object and holds what is around it, so that view is believed only while the object is blurred. Steps add up
their errors, so that a match from an early frame corrects them, and where the two are far apart neither is believed.
What comes in front of it was seen beside it before; where that is, points are not the object's, and do not vote. What
looks the same is followed, too, and where the ways do not tell which of them is the object, it does not count as found
from then on. An object that is lost is found again with the flow from earlier frames, or with its picture in the
neighbourhood; where several places look alike, none is believed. Until then its place is a guess: by a smooth match, by
its outline if that is clear, or where it was; no point counts as found.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from kpirl_ocp.perception.data.video import Frames
from kpirl_ocp.perception.tracking.appearance import Greys, Memory, Views
from kpirl_ocp.perception.tracking.identity.intruders import Intruders
from kpirl_ocp.perception.tracking.identity.lookalikes import Lookalikes, candidates
from kpirl_ocp.perception.tracking.identity.matches import (
    SEEN,
    SURE,
    TOGETHER,
    Match,
    clear,
    matched,
    pose_of,
    unambiguous,
)
from kpirl_ocp.perception.tracking.identity.twins import Thing, Twins
from kpirl_ocp.perception.tracking.model import ObjectModel
from kpirl_ocp.perception.tracking.similarity import apart, scale, shifted, transform
from kpirl_ocp.types import Array, Mask

_AS_GOOD = 0.8  # share of the points that may be lost by going back to a sure frame
_NEAR, _FAR = 0.05, 0.25  # gap of matches that say the same, and of those of which one is wrong [size of the object]
_ALIKE = 0.7  # share that looks as remembered from which a frame is a new reference for later ones
_MANY = 100  # points with which no more are looked for
_RESTS = 1.0  # an object that moves less from one frame to the next is not blurred [pixels]
_EQUAL = 0.3  # share of the points that look as remembered at a twin
_GROWTH = 1.25  # largest change of scale from one frame to the next


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


def track(frames: Iterable[tuple[float, Frames]], mask: Mask) -> Iterator[Located]:
    """Follow the object that `mask` (H, W) shows in the first of the frames (time [s], image (H, W, 3) RGB).

    Raises DemonstrationError if the object has too few corners.
    """
    tracker: _Tracker | None = None
    for time, image in frames:
        views = Views.of(image)
        if tracker is None:
            tracker = _Tracker.start(views, mask)
            yield tracker.located(time, np.ones(len(tracker.model.points), bool))
        else:
            yield tracker.located(time, tracker.step(views))


@dataclass(eq=False)
class _Tracker:
    """State between frames.

    first: the first frame. before: the last one and the pose in it. sure, recent: frames to find the object again from.
    motion: (3, 3) pose by pose. lost: frames since it was last found. likes: the things that have its colours, itself
    among them. twins: those that look the same in its points. intruders: what comes in front of it. guessed: whether
    the last pose is of a match that is not sure.
    """

    model: ObjectModel
    likes: Lookalikes
    first: Memory
    before: Memory
    sure: Memory
    recent: Memory
    motion: Array
    twins: Twins
    intruders: Intruders
    lost: int = 0
    guessed: bool = False

    @classmethod
    def start(cls, views: Views, mask: Mask) -> _Tracker:
        first = Memory(views, np.eye(3))
        likes = Lookalikes.of(first, mask)
        model, intruders = ObjectModel.of(views, mask), Intruders.of(views, mask)
        return cls(model, likes, first, first, first, first, np.eye(3), Twins.of(mask), intruders)

    def located(self, time: float, found: Mask) -> Located:
        pose, model = self.before.pose, self.model
        in_view = model.in_view(pose, self.before.views.sharp.shape)
        return Located(time, pose, transform(pose, model.points), found & in_view, in_view)

    def step(self, views: Views) -> Mask:
        """Find the object in the next frame; gives which of its points were found (n,)."""
        pose = self.before.pose
        self.intruders.follow(views)
        match = self._told_apart(views, self._found(views))
        if match is None or not match.sure:
            self._guess(views, match)
            return np.zeros(len(self.model.points), bool)
        self._meet(views, match, self._see(views, match))
        self.motion = np.eye(3) if self.lost else match.pose @ np.linalg.inv(pose)
        self.lost, self.guessed, self.before = 0, False, Memory(views, match.pose)
        self.intruders.judge(match.pose)
        return np.zeros_like(match.found) if self.twins.confused else self._learn(match)

    def _found(self, views: Views) -> Match | None:
        """A match; it is sure if sharp ones lead to it from the first frame, or smooth ones while it is blurred."""
        onward = self._onward(views) if self.guessed or not self.lost else None
        if onward and onward.sure and not self.lost:
            return self._anchored(views, onward)
        again = self._again(views)
        if onward and not (again and again.sure):
            return replace(onward, sure=False)
        return again

    def _guess(self, views: Views, match: Match | None) -> None:
        """Where an object that is not seen for sure may be: by a match, else by its outline, else where it was."""
        pose, self.guessed = self.before.pose, match is not None and self.lost > 0
        self.lost, self.motion = self.lost + 1, np.eye(3)
        if match is None:
            outline = self.likes.look(views)
            self.before = Memory(views, pose if outline is None else outline)
            return
        gone = transform(match.pose, self.twins.centre) - transform(pose, self.twins.centre)
        there = match.pose if match.sharp else shifted(pose, gone)
        self._see(views, replace(match, pose=there))
        self.motion, self.before = there @ np.linalg.inv(pose), Memory(views, there)

    def _see(self, views: Views, match: Match) -> Array:
        """Follow the things of its kind; gives their places (m, 2)."""
        return self.likes.see(Memory(views, match.pose), well=match.sharp and match.share >= TOGETHER)

    def _told_apart(self, views: Views, match: Match | None) -> Match | None:
        """The match, unless it is a twin's; where it may be either's, no later frame tells which is which."""
        twins = self.twins
        if twins.confused:
            return match
        seen = [self._twin(views, twin) for twin in twins.others]
        for index, at in enumerate(seen):
            if match is None or at is None or not twins.same(match.pose, at.pose):
                continue
            if twins.nearer(match.pose, index):  # claimed twice: what is left of the frame shows the other, or nothing
                seen[index] = clear(self._twin(views, twins.others[index], [match.pose]))
            else:
                ahead = twins.itself.ahead
                left = clear(self._match(views, self.before.views.grey, self.before.pose, ahead, 0, [at.pose]))
                match = replace(left, sure=match.sure) if left else None
        mine = twins.settle(pose_of(match), [pose_of(at) for at in seen])
        return match if mine else None

    def _twin(self, views: Views, twin: Thing, without: Sequence[Array] = ()) -> Match | None:
        """A twin, from the frame before if it was seen there, else as the object was seen."""
        match: Match | None = None
        if not twin.unseen:
            match = self._match(views, self.before.views.grey, twin.pose, twin.ahead, 0, without, own=False)
        return match or self._match(views, self.sure.at(twin.ahead), twin.ahead, twin.ahead, 0, without, own=False)

    def _meet(self, views: Views, match: Match, places: Array) -> None:
        """Take up twins at places (m, 2): things that look like the object in its points, too."""
        for offset in self.twins.unknown(match.pose, places):
            guess = shifted(match.pose, offset)
            found = self._match(views, self.sure.at(guess), guess, guess, 0, [match.pose], own=False)
            if (
                found
                and not self.twins.same(found.pose, match.pose)
                and found.alike.sum() >= _EQUAL * self.model.in_view(found.pose, views.sharp.shape).sum()
            ):
                self.twins.add(found.pose)

    def _onward(self, views: Views) -> Match | None:
        """From the frame before: the better of what the sharp and the smooth view say, sure ones first."""
        pose = self.before.pose
        best: Match | None = None
        for level in (0, 1):
            for guess in (self.motion @ pose, pose):
                match = self._match(views, self.before.views.grey, pose, guess, level)
                if match and (best is None or (match.sure, match.share) > (best.sure, best.share)):
                    best = match
                if best and best.sure and best.share > SURE:
                    return best
        return best

    def _anchored(self, views: Views, onward: Match) -> Match:
        """The match from a sure frame, if it is as good or a little elsewhere: steps add up their errors.

        Where it is far away, neither is sure.
        """
        for memory in (self.first, self.sure):
            anchored = self._match(views, memory.at(onward.pose), onward.pose, onward.pose, 0)
            if anchored is None:
                continue
            gap = apart(anchored.pose, onward.pose, self.model.points) / self.twins.size
            if gap > _FAR:
                return replace(onward, sure=False)
            if gap > _NEAR or anchored.alike.sum() >= _AS_GOOD * onward.alike.sum():
                return anchored
        if onward.sharp and onward.alike.sum() >= _ALIKE * self.model.in_view(onward.pose, views.sharp.shape).sum():
            self.sure = Memory(views, onward.pose)
        return onward

    def _again(self, views: Views) -> Match | None:
        """A match at the last place, else nearby, from the last sure frame or the last one with a match."""
        pose = self.before.pose
        sharp = self._at_place(views, 0)
        if sharp:
            return sharp
        matches = [
            match
            for guess in candidates(views, self.sure, pose, self.model.mask, self.lost)
            for greys in [self.sure.at(guess)]
            for level in (0, 1)
            if (match := self._match(views, greys, guess, guess, level)) and not self.likes.is_other(match.pose)
        ]
        best = unambiguous(matches)
        if best is None or not best.sharp:
            best = self._at_place(views, 1) or best
        return replace(best, sure=best.sharp) if best else None

    def _at_place(self, views: Views, level: int) -> Match | None:
        """A match at the last place, from the last sure frame or the last one with a match."""
        pose = self.before.pose
        for memory in (self.sure, self.recent):
            match = self._match(views, memory.at(pose), pose, pose, level)
            if match and not self.likes.is_other(match.pose):
                return match
        return None

    def _match(
        self,
        views: Views,
        before: Greys,
        pose_before: Array,
        guess: Array,
        level: int,
        without: Sequence[Array] = (),
        *,
        own: bool = True,
    ) -> Match | None:
        """The match to which flow from an earlier image leads, of about the size that the object had.

        own: what intruders hide is not the object's; a twin may be one of them.
        """
        hidden_by = self.intruders if own else None
        match = matched(self.model, views, before, pose_before, guess, level, without, hidden_by)
        growth = scale(match.pose) / scale(self.before.pose) if match else np.inf
        return match if 1 / _GROWTH < growth < _GROWTH else None

    def _learn(self, match: Match) -> Mask:
        """Take from the frame what is sure; gives which points were found.

        Nothing is where a twin is near: it may be the twin's. New points are taken up only where the object rests and
        most of it agrees, but few points are known or they look otherwise than remembered: new ones inherit the error
        of the pose in which they are first seen.
        """
        if self.twins.near(match.pose):
            return match.found
        views, pose, model = self.before.views, match.pose, self.model
        if match.share > SEEN + 0.1:
            self.recent = self.before
        if not match.sharp:
            return match.found
        model.remember(views, pose, match.alike)
        rests = np.abs(transform(self.motion, model.points) - model.points).max() < _RESTS
        stale = match.alike.sum() < TOGETHER * match.found.sum() or match.found.sum() < _MANY
        if rests and match.share >= TOGETHER and stale:
            return model.grow(views, pose, match.alike, match.found)
        return match.found
