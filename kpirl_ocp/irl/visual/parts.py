"""Parts of a demonstration, and their goals: a part of a coordinate's path ends where it turns back, or has rested.

    z_goal,t[i] = z_demo[i] at the end of the part that step t belongs to

With non-negative weights W, a cost sum_t W_t (z_t - z_goal)^2 draws every coordinate towards its goal at all times, so
a plan never moves away from it. With the paper's single goal, the last keypoints, an object that is lifted, carried and
put down at the same height would not be lifted, and one that moves sideways only at the end would do so too early. A
coordinate that moves to its last value directly has this goal at all times.
"""

from __future__ import annotations

import numpy as np

from kpirl_ocp.types import Array

_REST = 3  # smallest number of steps that count as a rest


def goals_of_parts(observations: Array, least: float) -> Array:
    """The goals (T, n_z) of the steps t = 1..T of a path (T+1, n_z).

    least: a coordinate that goes back by more turns, and one that stays within less rests.
    """
    goals = np.empty_like(observations)
    for path, goal in zip(observations.T, goals.T, strict=True):
        begin = 0
        for end in sorted({*turning_points(path, least), *ends_of_rests(path, least)}):
            goal[begin : end + 1] = path[end]
            begin = end + 1
    return goals[1:]


def turning_points(path: Array, least: float) -> list[int]:
    """Indices at which a path (n,) turns back by more than `least`, and the last index."""
    last = len(path) - 1
    away = np.flatnonzero(np.abs(path - path[0]) > least)
    if not len(away):
        return [last]
    turns, farthest = [], int(away[0])
    direction = np.sign(path[farthest] - path[0])
    for index in range(farthest, len(path)):
        ahead = direction * (path[index] - path[farthest])
        if ahead >= 0:
            farthest = index
        elif -ahead > least:
            turns.append(farthest)
            direction, farthest = -direction, index
    return [*turns, last]


def ends_of_rests(path: Array, least: float) -> list[int]:
    """Last indices of the runs of at least three steps in which a path (n,) stays within `least`."""
    ends, begin = [], 0
    while begin < len(path) - _REST:
        within = np.flatnonzero(np.maximum.accumulate(path[begin:]) - np.minimum.accumulate(path[begin:]) <= least)
        length = int(within[-1])
        if length >= _REST:
            ends.append(begin + length)
        begin += length + 1 if length >= _REST else 1
    return ends
