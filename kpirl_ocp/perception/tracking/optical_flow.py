"""Points of one image in another, by optical flow: pyramidal Lucas and Kanade, there and back.

A point whose way back does not end where it began is lost (forward-backward check, Kalal et al., 2010).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from kpirl_ocp.types import Array, Mask

_LEVELS = 4  # of the pyramid: motions of up to about 16 windows
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)


def follow(
    before: NDArray[np.uint8],
    after: NDArray[np.uint8],
    points: Array,
    guess: Array,
    window: int = 21,
    tolerance: float = 1.0,
) -> tuple[Array, Mask]:
    """Follow points (n, 2) [pixels] from one grey image to another.

    Args:
        before, after: (H, W).
        points, guess: (n, 2) where they are in `before`, and where about they may be in `after`.
        window: side of the patch that is compared [pixels].
        tolerance: how far from its start the way back of a point may end [pixels].

    Returns:
        Positions (n, 2), and which of them (n,) passed the check.
    """
    start, end = (np.ascontiguousarray(values, np.float32).reshape(-1, 1, 2) for values in (points, guess))
    there, held = _flow(before, after, start, end, window)
    back, returned = _flow(after, before, there[held], (there - end + start)[held], window)
    gap = np.linalg.norm((back - start[held]).reshape(-1, 2), axis=1)
    held[held] = returned & (gap < tolerance)
    return there.reshape(-1, 2).astype(float), held


def _flow(
    before: NDArray[np.uint8],
    after: NDArray[np.uint8],
    start: NDArray[np.float32],
    guess: NDArray[np.float32],
    side: int,
) -> tuple[NDArray[np.float32], Mask]:
    if not len(start):
        return start, np.zeros(0, bool)
    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        before,
        after,
        start,
        guess.copy(),
        winSize=(side, side),
        maxLevel=_LEVELS,
        criteria=_STOP,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return np.asarray(moved, np.float32), found.ravel() == 1
