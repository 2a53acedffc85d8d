"""Follow one rigid object through a film.

From frame to frame its points are followed by optical flow, and the pose is the similarity that most of them agree on;
so points that are lost or hidden are restored by the others. A pose counts only if enough points also look as they
should. It is sure if a chain of sharp matches leads to it from the first frame: in the smooth view a window is as large
as a small object and holds what is around it, so that view is believed only while the object is blurred. Steps add up
their errors: where the whole object looks as in the first frame, it is placed as there; else a match from an early
frame corrects them. Where two such matches are far apart neither is believed.
What comes in front of it was seen beside it before; where that is, points are not the object's, and do not vote. What
looks the same is followed, too, and where the ways do not tell which of them is the object, it does not count as found
from then on. An object that is lost is found again as a whole, with the flow from earlier frames, or with its picture
in the neighbourhood; where several places look alike, none is believed. Until then its place is a guess: by a smooth
match, by its outline if that is clear, or where it was; no point counts as found.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from kpirl_ocp.perception.data.video import Frames
from kpirl_ocp.perception.tracking.alignment import Template
from kpirl_ocp.perception.tracking.appearance import Memory, Shown, Views
from kpirl_ocp.perception.tracking.identity.intruders import Intruders
from kpirl_ocp.perception.tracking.identity.lookalikes import Lookalikes, candidates
from kpirl_ocp.perception.tracking.identity.matches import (
    SEEN,
    SURE,
    TOGETHER,
    Match,
    Matcher,
    clear,
    pose_of,
    unambiguous,
)
from kpirl_ocp.perception.tracking.identity.twins import Thing, Twins
from kpirl_ocp.perception.tracking.model import Located, ObjectModel
from kpirl_ocp.perception.tracking.similarity import apart, shifted, transform
from kpirl_ocp.types import Array, Mask

_AS_GOOD = 0.8  # share of the points that must be kept by going back to a sure frame
_FAR = 0.25  # gap of two matches of which one is wrong [size of the object]
_MANY = 100  # points with which no more are looked for
_RESTS = 1.0  # an object that moves less from one frame to the next is not blurred [pixels]
_EQUAL = 0.3  # share of the points that look as remembered at a twin


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

    likes: the things that have the object's colours, itself among them. twins: those that look the same in its points.
    intruders: what comes in front of it. first: the first frame. before: the last one and the pose in it. sure, recent:
    frames to find the object again from. motion: (3, 3) pose by pose. held: (3, 3) the last pose that was sure. lost:
    frames since then. guessed: whether the last pose is of a match that is not sure.
    """

    model: ObjectModel
    matcher: Matcher
    likes: Lookalikes
    twins: Twins
    intruders: Intruders
    first: Memory
    before: Memory
    sure: Memory
    recent: Memory
    motion: Array
    held: Array
    lost: int = 0
    guessed: bool = False

    @classmethod
    def start(cls, views: Views, mask: Mask) -> _Tracker:
        model, intruders = ObjectModel.of(views, mask), Intruders.of(views, mask)
        matcher, first = Matcher(model, Template.of(views, mask), intruders), Memory(views, np.eye(3))
        likes, twins = Lookalikes.of(first, mask), Twins.of(mask)
        return cls(model, matcher, likes, twins, intruders, first, first, first, first, np.eye(3), np.eye(3))

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
        self.held = match.pose
        self.lost, self.guessed, self.before = 0, False, Memory(views, match.pose)
        self.intruders.judge(match.pose)
        return np.zeros_like(match.found) if self.twins.confused else self._learn(match)

    def _found(self, views: Views) -> Match | None:
        """A match; it is sure if sharp ones lead to it from the first frame, or smooth ones while it is blurred."""
        onward = self._onward(views) if self.guessed or not self.lost else None
        if onward and onward.sure and not self.lost:
            return self._corrected(views, onward)
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
                left = clear(self.matcher.by_points(views, self._last(0), guess=ahead, without=[at.pose]))
                match = replace(left, sure=match.sure) if left else None
        mine = twins.settle(pose_of(match), [pose_of(at) for at in seen])
        return match if mine else None

    def _twin(self, views: Views, twin: Thing, without: Sequence[Array] = ()) -> Match | None:
        """A twin, from the frame before if it was seen there, else as the object was seen."""
        match: Match | None = None
        if not twin.unseen:
            there = Shown(self.before.views.sharp, 0, twin.pose)
            match = self.matcher.by_points(views, there, guess=twin.ahead, without=without, own=False)
        return match or self.matcher.by_points(views, self.sure.at(twin.ahead), without=without, own=False)

    def _meet(self, views: Views, match: Match, places: Array) -> None:
        """Take up twins at places (m, 2): things that look like the object in its points, too."""
        for offset in self.twins.unknown(match.pose, places):
            guess = shifted(match.pose, offset)
            found = self.matcher.by_points(views, self.sure.at(guess), without=[match.pose], own=False)
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
                match = self.matcher.by_points(views, self._last(level), guess=guess)
                if match and (best is None or (match.sure, match.share) > (best.sure, best.share)):
                    best = match
                if best and best.sure and best.share > SURE:
                    return best
        return best

    def _last(self, level: int) -> Shown:
        """A view of the frame before."""
        return Shown(self.before.views.grey[level], level, self.before.pose)

    def _corrected(self, views: Views, onward: Match) -> Match:
        """The match where the object looks as in the first frame, else by points; far from there none is sure."""
        whole = self.matcher.as_a_whole(views, onward.pose)
        if whole is None:
            return self._anchored(views, onward)
        self._keep(views, whole)
        return replace(whole, sure=not self._far(whole, onward))

    def _keep(self, views: Views, match: Match) -> None:
        """A frame that shows most of the object is one to find it from."""
        if self.matcher.looks_known(views, match):
            self.sure = Memory(views, match.pose)

    def _far(self, one: Match, other: Match) -> bool:
        return apart(one.pose, other.pose, self.model.points) > _FAR * self.twins.size

    def _anchored(self, views: Views, onward: Match) -> Match:
        """The match from a sure frame, if it is as good: steps add up their errors.

        Where it is far away, neither is sure. Nor is what no such frame confirms while most of the object is hidden.
        """
        confirmed = False
        for memory in (self.first, self.sure):
            anchored = self.matcher.by_points(views, memory.at(onward.pose))
            if anchored is None:
                continue
            if self._far(anchored, onward):
                return replace(onward, sure=False)
            if anchored.alike.sum() >= _AS_GOOD * onward.alike.sum():
                return anchored
            confirmed = True
        self._keep(views, onward)
        return replace(onward, sure=confirmed or not self.matcher.mostly_hidden(onward))

    def _again(self, views: Views) -> Match | None:
        """A match as a whole, or by points: at the last place, at the last that was sure, or near one of them."""
        pose = self.before.pose
        whole = self._again_as_a_whole(views)
        if whole:
            return whole
        for place in (pose, self.held):
            if sharp := self._at_place(views, place, 0):
                return sharp
        matches = [
            match
            for guess in candidates(views, self.sure, pose, self.model.mask, self.lost)
            for level in (0, 1)
            if (match := self.matcher.by_points(views, self.sure.at(guess, level))) and not self._is_other(match)
        ]
        best = unambiguous(matches)
        if best is None or not best.sharp:
            best = self._at_place(views, pose, 1) or best
        return replace(best, sure=best.sharp) if best else None

    def _again_as_a_whole(self, views: Views) -> Match | None:
        """Where the object looks as in the first frame, if that is so in one place only."""
        nearby = candidates(views, self.sure, self.held, self.model.mask, self.lost)
        found = [self.matcher.as_a_whole(views, guess) for guess in (self.before.pose, self.held, *nearby)]
        best = unambiguous([match for match in found if match])
        if best:
            self._keep(views, best)
        return best

    def _is_other(self, match: Match) -> bool:
        return self.likes.is_other(match.pose, self.lost)

    def _at_place(self, views: Views, pose: Array, level: int) -> Match | None:
        """A match at a place, from the last sure frame or the last one with a match."""
        for memory in (self.sure, self.recent):
            match = self.matcher.by_points(views, memory.at(pose, level))
            if match and not self._is_other(match):
                return match
        return None

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
