"""Similarities of the plane, x -> s R x + t, as matrices (3, 3): where an object is, relative to the first frame."""

from __future__ import annotations

import cv2
import numpy as np

from kpirl_ocp.types import Array, Mask


def transform(pose: Array, points: Array) -> Array:
    """Points (..., 2) moved by a pose (3, 3)."""
    return points @ pose[:2, :2].T + pose[:2, 2]


def scale(pose: Array) -> float:
    """s of a pose (3, 3)."""
    return float(np.sqrt(abs(np.linalg.det(pose[:2, :2]))))


def shifted(pose: Array, offset: Array) -> Array:
    """The pose (3, 3), moved by offset (2,)."""
    moved = pose.copy()
    moved[:2, 2] += offset
    return moved


def apart(one: Array, other: Array, points: Array) -> float:
    """Largest distance between where two poses (3, 3) move points (n, 2)."""
    return float(np.linalg.norm(transform(one, points) - transform(other, points), axis=1).max())


def fit(points: Array, targets: Array, tolerance: float) -> tuple[Array, Mask] | None:
    """The similarity that most pairs agree on within `tolerance` (RANSAC, refined), and which pairs (n,) do.

    Args:
        points, targets: (n, 2).
        tolerance: [pixels].

    Returns:
        None if fewer than three pairs agree.
    """
    if len(points) < 3:
        return None
    cv2.setRNGSeed(0)  # RANSAC draws from a global generator: the same points always give the same pose
    matrix, agree = cv2.estimateAffinePartial2D(
        points, targets, method=cv2.RANSAC, ransacReprojThreshold=tolerance, maxIters=2000, confidence=0.999
    )
    if matrix is None or agree.sum() < 3:
        return None
    return np.vstack([matrix, [0.0, 0.0, 1.0]]), agree.ravel() == 1
