"""Where an object is found, by flow from an earlier image or as a whole, and which of several places is believed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kpirl_ocp.perception.tracking.alignment import Template
from kpirl_ocp.perception.tracking.appearance import Shown, Views
from kpirl_ocp.perception.tracking.identity.intruders import Intruders
from kpirl_ocp.perception.tracking.model import ObjectModel
from kpirl_ocp.perception.tracking.optical_flow import follow
from kpirl_ocp.perception.tracking.similarity import fit, scale, transform
from kpirl_ocp.types import Array, Mask

_WINDOWS, _GAPS, _TOLERANCES = (21, 41), (1.0, 2.0), (1.0, 3.0)  # sharp and smooth [pixels]
_FEWEST = 8  # points that must be found
SEEN = 0.12  # share of the points in view that must be found
TOGETHER = 0.8  # share that moves as one from which nothing else is asked: light and mirror images change looks
SURE = 0.4  # share with which no better match is looked for
_GROWTH = 1.25  # largest change of scale from a guess
# Correlation from which an object looks as in the first frame: below, it is turned, hidden or lit otherwise.
_WHOLE = 0.9
_KNOWN = 0.7  # share that looks as remembered from which a frame is a new reference for later ones
_APART, _RIVAL = 15.0, 0.7  # another place [pixels] is a rival with this share of the best one's points


@dataclass(eq=False)
class Match:
    """A pose, the points found there, those of them that look as remembered, the share of those in view found.

    sharp: whether the sharp view shows it. sure: whether that, or the smooth view of an object that is blurred.
    """

    pose: Array
    found: Mask
    alike: Mask
    share: float
    sharp: bool
    sure: bool


@dataclass(frozen=True, eq=False)
class Matcher:
    """Finds an object in an image. whole: all of it in the first frame. intruders: what may be in front of it."""

    model: ObjectModel
    whole: Template
    intruders: Intruders

    def by_points(
        self,
        views: Views,
        earlier: Shown,
        *,
        guess: Array | None = None,
        without: Sequence[Array] = (),
        own: bool = True,
    ) -> Match | None:
        """The pose to which flow from an earlier image leads, if enough points agree and look right.

        Args:
            guess: (3, 3) where about the object may be, and about how large; by default as it was.
            without: poses (3, 3) of other things, whose points are theirs.
            own: points that intruders hide are not the object's; those of its twin may be, which may be an intruder.
        """
        model, level, guess = self.model, earlier.level, earlier.pose if guess is None else guess
        chosen = np.flatnonzero(model.in_view(earlier.pose, views.sharp.shape))
        points = model.points[chosen]
        start, end = transform(earlier.pose, points), transform(guess, points)
        window, gap, tolerance = _WINDOWS[level], _GAPS[level], _TOLERANCES[level]
        places, held = follow(earlier.view, views.grey[level], start, end, window, gap)
        for pose in without:
            held &= np.linalg.norm(transform(pose, points) - places, axis=1) > 2 * tolerance
        if own:
            held &= ~self.intruders.hide(places)
        agreed = fit(points[held], places[held], tolerance)
        if agreed is None or not 1 / _GROWTH < scale(agreed[0]) / scale(guess) < _GROWTH:
            return None
        return _judged(model, views, agreed[0], chosen[held][agreed[1]], level)

    def as_a_whole(self, views: Views, guess: Array) -> Match | None:
        """The pose near a guess (3, 3) at which the whole object looks as in the first frame, in which no step errs."""
        pose, correlation = self.whole.align(views, guess)
        in_view = self.model.in_view(pose, views.sharp.shape)
        alike = self.model.alike(views, pose, np.arange(len(in_view))) & in_view
        if correlation < _WHOLE or alike.sum() < _FEWEST:
            return None
        return Match(pose, alike, alike, alike.sum() / in_view.sum(), sharp=True, sure=True)

    def mostly_hidden(self, match: Match) -> bool:
        """Whether intruders hide more of the object's points than were found."""
        return bool(self.intruders.hide(transform(match.pose, self.model.points)).sum() >= match.found.sum())

    def looks_known(self, views: Views, match: Match) -> bool:
        """Whether a sharp match shows most of the object as remembered: a frame for later ones to be compared with."""
        in_view = self.model.in_view(match.pose, views.sharp.shape)
        return match.sharp and bool(match.alike.sum() >= _KNOWN * in_view.sum())


def _judged(model: ObjectModel, views: Views, pose: Array, inliers: NDArray[np.intp], level: int) -> Match | None:
    """The match of points that agree on a pose, if enough of them look right."""
    in_view = model.in_view(pose, views.sharp.shape)
    agree, alike = np.zeros((2, len(model.points)), bool)
    agree[inliers], alike[inliers] = True, model.alike(views, pose, inliers)
    agree, alike = agree & in_view, alike & in_view
    found = agree if agree.sum() >= TOGETHER * in_view.sum() else alike
    share, looks = (points.sum() / max(1, in_view.sum()) for points in (found, alike))
    if found.sum() < _FEWEST or looks < SEEN:
        return None
    return Match(pose, found, alike, share, level == 0, level == 0 or model.blurred(views, pose, found))


def pose_of(match: Match | None) -> Array | None:
    """The pose (3, 3) of a match."""
    return None if match is None else match.pose


def clear(match: Match | None) -> Match | None:
    """A match in what another thing leaves of the frame, if it is much of the object."""
    return match if match and match.share > SURE else None


def unambiguous(matches: list[Match]) -> Match | None:
    """The best match, unless another place looks nearly as good."""
    if not matches:
        return None
    best = max(matches, key=lambda match: match.share)
    elsewhere = [m for m in matches if np.linalg.norm(m.pose[:2, 2] - best.pose[:2, 2]) > _APART]
    return None if any(match.share > _RIVAL * best.share for match in elsewhere) else best
