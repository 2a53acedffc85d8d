"""Admission of tracks as a demonstration: they must move, not jump, and be sure; else a refusal in plain words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kpirl_ocp.errors import DemonstrationError
from kpirl_ocp.perception.tracking.tracks import Tracks
from kpirl_ocp.types import Array, Mask

_STILL = 0.03  # a demonstration moves farther than this [longer side of the image]
_JUMP = 2.5  # faster than this is no hand but another object [longer sides per second]
_SURE = 0.15  # confidence below which a frame is unsure; tracking itself gives up there
_UNSURE = 0.2  # share of the frames that may be unsure
_GAP = 0.4  # for how long in a row they may be [s]
_COARSE = 0.1  # share of the way by which steps may miss the path between them
_RESTS = 0.01  # an object that is within this of where it starts or ends rests there [longer side]


@dataclass(frozen=True)
class Refusal:
    """Why tracks are no demonstration, and the frames that show it."""

    reason: str
    frames: tuple[int, ...]


def refusal(tracks: Tracks) -> Refusal | None:
    """Why tracks cannot be learned from; None if they can."""
    return _unsure(tracks) or _jumps(tracks) or _still(tracks)


def good_until(tracks: Tracks) -> float | None:
    """Until when [s, down to a hundredth] refused tracks can be learned from; None if no such beginning can."""
    ends = np.floor(100 * tracks.times[_before_trouble(tracks)] + 1e-6) / 100
    for end in ends[np.searchsorted(tracks.times, ends, side="right") > 1]:
        if refusal(tracks.between(tracks.times[0], end)) is None:
            return float(end)
    return None


def moving_part(tracks: Tracks) -> tuple[float, float]:
    """From when to when [s] the keypoints move: without the rest before and after, a tenth of a second around."""
    side = max(tracks.size)

    def away(from_: int) -> Array:
        return np.linalg.norm(tracks.positions - tracks.positions[from_], axis=-1).max(axis=1) / side

    left, arrived = np.flatnonzero(away(0) > _RESTS), np.flatnonzero(away(-1) > _RESTS)
    if not len(left) or not len(arrived):
        return float(tracks.times[0]), float(tracks.times[-1])
    start, end = tracks.times[max(left[0] - 1, 0)], tracks.times[min(arrived[-1] + 1, len(tracks.times) - 1)]
    return max(float(tracks.times[0]), float(start) - 0.1), min(float(tracks.times[-1]), float(end) + 0.1)


def check_steps(tracks: Tracks, steps: int) -> None:
    """Raise DemonstrationError if so many steps are too few for the path, or the frames too few for the steps."""
    seconds = float(tracks.times[-1] - tracks.times[0])
    straight = tracks.at_rate(steps / seconds).places_at(tracks.times - tracks.times[0])
    gap = np.linalg.norm(straight - tracks.positions, axis=-1).mean()
    way = np.linalg.norm(tracks.positions - tracks.positions[0], axis=-1).mean(axis=1).max()
    if gap > _COARSE * way:
        raise DemonstrationError(
            f"{steps} steps are too few for this motion of {seconds:.1f} s: between them it is {gap / way:.0%} "
            "of its way elsewhere. Take more steps (--steps), or a shorter part of the film (--start, --end)."
        )


def _still(tracks: Tracks) -> Refusal | None:
    way = np.linalg.norm(tracks.positions - tracks.positions[0], axis=-1).mean(axis=1)
    farthest = int(way.argmax())
    if way[farthest] >= _STILL * max(tracks.size):
        return None
    return Refusal(
        f"the keypoints hardly move: {way[farthest]:.1f} pixels at most, in frames of {tracks.size[0]} x "
        f"{tracks.size[1]}. Film the motion itself, nearer or over a longer way.",
        (0, farthest),
    )


def _jumps(tracks: Tracks) -> Refusal | None:
    speed = _speeds(tracks)
    worst = int(speed.argmax())
    if speed[worst] <= _JUMP:
        return None
    gap = np.linalg.norm(tracks.centre[worst + 1] - tracks.centre[worst])
    return Refusal(
        f"the keypoints jump at {tracks.times[worst + 1]:.2f} s, by {gap:.0f} pixels from one frame to the next: they "
        "have gone over to something else. End before that (--end).",
        (worst, worst + 1),
    )


def _unsure(tracks: Tracks) -> Refusal | None:
    unsure = _unsure_frames(tracks)
    start, longest = _longest_run(unsure)
    if unsure.mean() <= _UNSURE and longest <= _GAP * tracks.rate:
        return None
    end = min(start + longest, len(unsure) - 1)
    return Refusal(
        f"the object was not seen for sure from {tracks.times[start]:.2f} to {tracks.times[end]:.2f} s "
        f"({unsure.mean():.0%} of all frames): something hides it or looks like it, it leaves the picture, is too "
        "blurred, or moves too far from one frame to the next. Choose a part of the film (--start, --end), or "
        "film it again.",
        (max(start - 1, 0), start + longest // 2, end),
    )


def _before_trouble(tracks: Tracks) -> list[int]:
    """The sure frames after which the object is not seen for sure, or jumps; the latest first."""
    unsure = _unsure_frames(tracks)
    trouble = unsure[1:] | (_speeds(tracks) > _JUMP)
    return np.flatnonzero(trouble & ~unsure[:-1])[::-1].tolist()


def _unsure_frames(tracks: Tracks) -> Mask:
    return tracks.confidence.mean(axis=1) < _SURE


def _speeds(tracks: Tracks) -> Array:
    """From each frame to the next (n - 1,) [longer sides per second]."""
    gaps = np.linalg.norm(np.diff(tracks.centre, axis=0), axis=1)
    return np.asarray(gaps / np.diff(tracks.times) / max(tracks.size), float)


def _longest_run(flags: Mask) -> tuple[int, int]:
    """Start and length of the longest run of true values."""
    best, start = (0, 0), 0
    for index, flag in enumerate([*flags, False]):
        if flag:
            continue
        best, start = max(best, (start, index - start), key=lambda run: run[1]), index + 1
    return best
