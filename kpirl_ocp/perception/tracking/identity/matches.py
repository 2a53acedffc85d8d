"""Where an object is found by optical flow from an earlier image, and which of several such places is believed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kpirl_ocp.perception.tracking.appearance import Greys, Views
from kpirl_ocp.perception.tracking.identity.intruders import Intruders
from kpirl_ocp.perception.tracking.model import ObjectModel
from kpirl_ocp.perception.tracking.optical_flow import follow
from kpirl_ocp.perception.tracking.similarity import fit, transform
from kpirl_ocp.types import Array, Mask

_WINDOWS, _GAPS, _TOLERANCES = (21, 41), (1.0, 2.0), (1.0, 3.0)  # sharp and smooth [pixels]
_FEWEST = 8  # points that must be found
SEEN = 0.12  # share of the points in view that must be found
TOGETHER = 0.8  # share that moves as one from which nothing else is asked: light and mirror images change looks
SURE = 0.4  # share with which no better match is looked for
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


def matched(
    model: ObjectModel,
    views: Views,
    before: Greys,
    pose_before: Array,
    guess: Array,
    level: int,
    without: Sequence[Array] = (),
    hidden_by: Intruders | None = None,
) -> Match | None:
    """The pose to which flow from an earlier image leads, if enough points agree and look right.

    Args:
        before, pose_before: the earlier image, sharp and smooth, and the pose (3, 3) there.
        guess: (3, 3) where about the object may be now.
        level: 0: sharp, 1: smooth.
        without: poses (3, 3) of other things, whose points are theirs.
        hidden_by: what may be in front of the object.
    """
    shape = views.sharp.shape
    chosen = np.flatnonzero(model.in_view(pose_before, shape))
    points = model.points[chosen]
    start, end = transform(pose_before, points), transform(guess, points)
    places, held = follow(before[level], views.grey[level], start, end, _WINDOWS[level], _GAPS[level])
    for pose in without:
        held &= np.linalg.norm(transform(pose, points) - places, axis=1) > 2 * _TOLERANCES[level]
    if hidden_by:
        held &= ~hidden_by.hide(places)
    agreed = fit(points[held], places[held], _TOLERANCES[level])
    return None if agreed is None else _judged(model, views, agreed[0], chosen[held][agreed[1]], level)


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
