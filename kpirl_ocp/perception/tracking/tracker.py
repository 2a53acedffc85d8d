"""Follow one rigid object through a film.

From frame to frame its points are followed by optical flow, and the pose is the similarity that most of them agree on;
so points that are lost or hidden are restored by the others. A pose counts only if enough points also look as they
should. What comes in front of it was seen beside it before; where that is, points are not the object's, and do not
vote. What looks the same is followed, too, and where the ways do not tell which of them is the object, it does not
count as found from then on. An object that is lost is found again with the flow from earlier frames, or with its
picture in the neighbourhood; where several places look alike, none is believed. Until then it is where its outline is,
if that is clear, and else where it was; no point counts as found.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from kpirl_ocp.perception.data.video import Frames
from kpirl_ocp.perception.tracking.appearance import Greys, Memory, Views
from kpirl_ocp.perception.tracking.identity.intruders import Intruders
from kpirl_ocp.perception.tracking.identity.lookalikes import Lookalikes, candidates
from kpirl_ocp.perception.tracking.identity.twins import Thing, Twins
from kpirl_ocp.perception.tracking.model import ObjectModel
from kpirl_ocp.perception.tracking.optical_flow import follow
from kpirl_ocp.perception.tracking.similarity import fit, scale, shifted, transform
from kpirl_ocp.types import Array, Mask

_WINDOWS, _GAPS, _TOLERANCES = (21, 41), (1.0, 2.0), (1.0, 3.0)  # sharp and smooth [pixels]
_FEWEST = 8  # points that must be found
_SEEN = 0.12  # share of the points in view that must be found
_TOGETHER = 0.8  # share that moves as one from which nothing else is asked: light and mirror images change looks
_SURE = 0.4  # share with which no better match is looked for
_AS_GOOD = 0.8  # share of the points that may be lost by going back to a sure frame
_ALIKE = 0.7  # share that looks as remembered from which a frame is a new reference for later ones
_APART, _RIVAL = 15.0, 0.7  # another place [pixels] is a rival with this share of the best one's points
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


@dataclass(eq=False)
class _Match:
    """A pose, the points found there, those of them that look as remembered, the share of those in view found."""

    pose: Array
    found: Mask
    alike: Mask
    share: float
    sharp: bool


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
    among them. twins: those that look the same in its points. intruders: what comes in front of it.
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
        match = self._onward(views) if not self.lost else None
        match = self._anchored(views, match) if match else self._again(views)
        match = self._told_apart(views, match)
        if match is None:
            self.lost, self.motion = self.lost + 1, np.eye(3)
            outline = self.likes.look(views)
            self.before = Memory(views, pose if outline is None else outline)
            return np.zeros(len(self.model.points), bool)
        others = self.likes.see(Memory(views, match.pose), well=match.sharp and match.share >= _TOGETHER)
        self._meet(views, match, others)
        self.motion = np.eye(3) if self.lost else match.pose @ np.linalg.inv(pose)
        self.lost, self.before = 0, Memory(views, match.pose)
        self.intruders.judge(match.pose)
        return np.zeros_like(match.found) if self.twins.confused else self._learn(match)

    def _told_apart(self, views: Views, match: _Match | None) -> _Match | None:
        """The match, unless it is a twin's; where it may be either's, no later frame tells which is which."""
        twins = self.twins
        if twins.confused:
            return match
        seen = [self._twin(views, twin) for twin in twins.others]
        for index, at in enumerate(seen):
            if match is None or at is None or not twins.same(match.pose, at.pose):
                continue
            if twins.nearer(match.pose, index):  # claimed twice: what is left of the frame shows the other, or nothing
                seen[index] = _clear(self._twin(views, twins.others[index], [match.pose]))
            else:
                ahead = twins.itself.ahead
                match = _clear(self._match(views, self.before.views.grey, self.before.pose, ahead, 0, [at.pose]))
        mine = twins.settle(_pose(match), [_pose(at) for at in seen])
        return match if mine else None

    def _twin(self, views: Views, twin: Thing, without: Sequence[Array] = ()) -> _Match | None:
        """A twin, from the frame before if it was seen there, else as the object was seen."""
        match: _Match | None = None
        if not twin.unseen:
            match = self._match(views, self.before.views.grey, twin.pose, twin.ahead, 0, without, own=False)
        return match or self._match(views, self.sure.at(twin.ahead), twin.ahead, twin.ahead, 0, without, own=False)

    def _meet(self, views: Views, match: _Match, places: Array) -> None:
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

    def _onward(self, views: Views) -> _Match | None:
        """From the frame before: the better of what the sharp and the smooth view say."""
        pose = self.before.pose
        best: _Match | None = None
        for level in (0, 1):
            for guess in (self.motion @ pose, pose):
                match = self._match(views, self.before.views.grey, pose, guess, level)
                if match and (best is None or match.share > best.share):
                    best = match
                if best and best.share > _SURE:
                    return best
        return best

    def _anchored(self, views: Views, onward: _Match) -> _Match:
        """The match from a sure frame, if it is the better one: steps from frame to frame add up their errors."""
        for memory in (self.first, self.sure):
            anchored = self._match(views, memory.at(onward.pose), onward.pose, onward.pose, 0)
            if anchored and anchored.alike.sum() >= _AS_GOOD * onward.alike.sum():
                return anchored
        if onward.sharp and onward.alike.sum() >= _ALIKE * self.model.in_view(onward.pose, views.sharp.shape).sum():
            self.sure = Memory(views, onward.pose)
        return onward

    def _again(self, views: Views) -> _Match | None:
        """A match at the last place, else nearby, from the last sure frame or the last one with a match."""
        pose = self.before.pose
        for memory in (self.sure, self.recent):
            greys = memory.at(pose)
            for level in (0, 1):
                match = self._match(views, greys, pose, pose, level)
                if match and not self.likes.is_other(match.pose):
                    return match
        matches = [
            match
            for guess in candidates(views, self.sure, pose, self.model.mask, self.lost)
            for greys in [self.sure.at(guess)]
            for level in (0, 1)
            if (match := self._match(views, greys, guess, guess, level)) and not self.likes.is_other(match.pose)
        ]
        return _unambiguous(matches)

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
    ) -> _Match | None:
        """The pose to which flow from an earlier image leads, if enough points agree and look right.

        without: poses (3, 3) of other things, whose points are theirs.
        own: what intruders hide is not the object's; a twin may be one of them.
        """
        model, shape = self.model, views.sharp.shape
        chosen = np.flatnonzero(model.in_view(pose_before, shape))
        points = model.points[chosen]
        start, end = transform(pose_before, points), transform(guess, points)
        places, held = follow(before[level], views.grey[level], start, end, _WINDOWS[level], _GAPS[level])
        for pose in without:
            held &= np.linalg.norm(transform(pose, points) - places, axis=1) > 2 * _TOLERANCES[level]
        if own:
            held &= ~self.intruders.hide(places)
        agreed = fit(points[held], places[held], _TOLERANCES[level])
        if agreed is None or not 1 / _GROWTH < scale(agreed[0]) / scale(self.before.pose) < _GROWTH:
            return None
        pose, inliers = agreed[0], chosen[held][agreed[1]]
        in_view = model.in_view(pose, shape)
        agree, alike = np.zeros((2, len(model.points)), bool)
        agree[inliers], alike[inliers] = True, model.alike(views, pose, inliers)
        agree, alike = agree & in_view, alike & in_view
        together = agree.sum() >= _TOGETHER * in_view.sum()
        found = agree if together else alike
        share, looks = (points.sum() / max(1, in_view.sum()) for points in (found, alike))
        return _Match(pose, found, alike, share, level == 0) if found.sum() >= _FEWEST and looks >= _SEEN else None

    def _learn(self, match: _Match) -> Mask:
        """Take from the frame what is sure; gives which points were found.

        Nothing is where a twin is near: it may be the twin's. New points are taken up only where the object rests and
        most of it agrees, but few points are known or they look otherwise than remembered: new ones inherit the error
        of the pose in which they are first seen.
        """
        if self.twins.near(match.pose):
            return match.found
        views, pose, model = self.before.views, match.pose, self.model
        if match.share > _SEEN + 0.1:
            self.recent = self.before
        if not match.sharp:
            return match.found
        model.remember(views, pose, match.alike)
        rests = np.abs(transform(self.motion, model.points) - model.points).max() < _RESTS
        stale = match.alike.sum() < _TOGETHER * match.found.sum() or match.found.sum() < _MANY
        if rests and match.share >= _TOGETHER and stale:
            return model.grow(views, pose, match.alike, match.found)
        return match.found


def _pose(match: _Match | None) -> Array | None:
    return None if match is None else match.pose


def _clear(match: _Match | None) -> _Match | None:
    """A match in what another thing leaves of the frame, if it is much of the object."""
    return match if match and match.share > _SURE else None


def _unambiguous(matches: list[_Match]) -> _Match | None:
    """The best match, unless another place looks nearly as good."""
    if not matches:
        return None
    best = max(matches, key=lambda match: match.share)
    elsewhere = [m for m in matches if np.linalg.norm(m.pose[:2, 2] - best.pose[:2, 2]) > _APART]
    return None if any(match.share > _RIVAL * best.share for match in elsewhere) else best
