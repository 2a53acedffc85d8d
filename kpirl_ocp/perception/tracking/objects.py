"""Choice of the object to follow: a box or clicks in the first frame, or what moves. The outline comes from GrabCut."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from kpirl_ocp.errors import DemonstrationError
from kpirl_ocp.perception.data.video import Frames
from kpirl_ocp.perception.tracking.optical_flow import follow
from kpirl_ocp.perception.tracking.similarity import fit
from kpirl_ocp.types import Array, Mask

_ITERATIONS = 5  # of GrabCut
_CLICK, _REACH = 0.01, 0.12  # radius that surely, and that possibly, belongs to a clicked object [image sides]
_MOVED = 0.015  # displacement that is motion [image sides]
_PATIENCE = 15  # frames without more points in motion after which looking ends
_FEWEST = 10  # points that must move together
_CORNERS = 800
_AGREE = 3.0  # [pixels]
_SECONDS = 4.0  # in which something must begin to move


def in_box(image: Frames, box: ArrayLike) -> Mask:
    """The object (H, W) in a box (left, top, right, bottom) [pixels] of an image (H, W, 3).

    Raises DemonstrationError if the box is not inside the image, or nothing in it differs from its surroundings.
    """
    left, top, right, bottom = check_box(image, box)
    labels = np.full(image.shape[:2], cv2.GC_BGD, np.uint8)
    labels[top:bottom, left:right] = cv2.GC_PR_FGD
    return _cut(image, labels)


def around(image: Frames, points: ArrayLike) -> Mask:
    """The object (H, W) that points (n, 2) [pixels] were clicked on.

    Raises DemonstrationError for points outside the image, or if the object's colours are those around it.
    """
    clicks = check_points(image, points)
    labels = np.full(image.shape[:2], cv2.GC_BGD, np.uint8)
    side = max(image.shape)
    _mark(labels, clicks, round(_REACH * side), cv2.GC_PR_FGD)
    if len(clicks) > 2:
        cv2.fillConvexPoly(labels, cv2.convexHull(clicks.astype(np.int32)), cv2.GC_PR_FGD)
    _mark(labels, clicks, max(2, round(_CLICK * side)), cv2.GC_FGD)
    return _cut(image, labels)


def check_box(image: Frames, box: ArrayLike) -> tuple[int, int, int, int]:
    """The sides (left, top, right, bottom) [pixels] of a box. Raises DemonstrationError if it leaves the image."""
    left, top, right, bottom = (round(float(side)) for side in np.asarray(box, float))
    height, width = image.shape[:2]
    if not (0 <= left < right <= width and 0 <= top < bottom <= height):
        raise DemonstrationError(
            f"the box {left},{top},{right},{bottom} is not inside the image of {width} x {height} pixels: give its "
            "left, top, right and bottom in these."
        )
    return left, top, right, bottom


def check_points(image: Frames, points: ArrayLike) -> Array:
    """The points (n, 2) [pixels]. Raises DemonstrationError if one is outside the image."""
    clicks = np.atleast_2d(np.asarray(points, float))
    height, width = image.shape[:2]
    if not np.all((clicks >= 0) & (clicks < [width, height])):
        raise DemonstrationError(
            f"a clicked point is outside the image of {width} x {height} pixels: give x and y in these."
        )
    return clicks


def moving(frames: Iterable[tuple[float, Frames]], hidden: Mask | None = None) -> Mask:
    """The object (H, W) in the first of the frames that moves as one rigid body while the rest stays.

    Args:
        frames: times [s] and images (H, W, 3).
        hidden: (H, W) pixels of the first frame that belong to the hand and not to the object.

    Raises:
        DemonstrationError: nothing moves within four seconds, or nothing rigid.
    """
    first, start, went, places, still = _farthest(frames)
    agreed = fit(start[went], places[went], _AGREE)
    if agreed is None or agreed[1].sum() < _FEWEST:
        raise DemonstrationError(
            f"nothing moves as one body within {_SECONDS:g} s: start later (--start), take a part in which something "
            "is carried, or say what to follow (--points, --box)."
        )
    return _outline(first, start[went][agreed[1]], start[still], hidden)


def _farthest(frames: Iterable[tuple[float, Frames]]) -> tuple[Frames, Array, Mask, Array, Mask]:
    """The first frame, its corners, and when most of them have moved: which ones have, where all are, which rest."""
    first: Frames | None = None
    most, waited = 0, 0
    for time, image in frames:
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
        if first is None:
            first, start, before, side = image, _corners(grey), grey, max(grey.shape)
            places, alive = start.copy(), np.ones(len(start), bool)
            best = (alive & False, places, alive)
            continue
        places, held = follow(before, grey, places, places)
        alive, before = alive & held, grey
        way = np.linalg.norm(places - start, axis=1) / side
        count, waited = int((alive & (way > _MOVED)).sum()), waited + 1
        if count > most:
            best, most, waited = (alive & (way > _MOVED), places, alive & (way < _MOVED / 4)), count, 0
        if time > _SECONDS or (most >= _FEWEST and waited > _PATIENCE):
            break
    if first is None:
        raise DemonstrationError("there are no frames to look for a moving object in.")
    return first, start, *best


def _outline(image: Frames, body: Array, still: Array, hidden: Mask | None) -> Mask:
    """The object around points that move, without those that stay."""
    side = max(image.shape[:2])
    labels = np.full(image.shape[:2], cv2.GC_BGD, np.uint8)
    cv2.fillConvexPoly(labels, cv2.convexHull(body.astype(np.int32)), cv2.GC_PR_FGD)
    _mark(labels, body, round(0.04 * side), cv2.GC_PR_FGD)
    _mark(labels, still, 2, cv2.GC_BGD)
    _mark(labels, body, 3, cv2.GC_FGD)
    if hidden is not None:
        labels[hidden] = cv2.GC_BGD
    return _cut(image, labels)


def _cut(image: Frames, labels: NDArray[np.uint8]) -> Mask:
    """GrabCut (Rother et al., 2004), from labels of sure and possible background and object."""
    cv2.setRNGSeed(0)  # its colour clusters are drawn from a global generator
    behind, front = np.zeros((2, 1, 65))
    labels = labels.copy()
    colours, nowhere = cv2.cvtColor(image, cv2.COLOR_RGB2BGR), (0, 0, 1, 1)
    cv2.grabCut(colours, labels, nowhere, behind, front, _ITERATIONS, cv2.GC_INIT_WITH_MASK)
    found = (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)
    if not found.any():
        raise DemonstrationError("nothing there differs in colour from what is around: use another box, or points.")
    return _largest_part(found)


def _largest_part(mask: Mask) -> Mask:
    """The largest connected part, its gaps closed."""
    gap = np.ones((2 * (max(mask.shape) // 100) + 1,) * 2, np.uint8)
    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, gap)
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(closed)
    return np.asarray(labels == 1 + statistics[1:, cv2.CC_STAT_AREA].argmax(), bool)


def _corners(grey: NDArray[np.uint8]) -> Array:
    found = cv2.goodFeaturesToTrack(grey, _CORNERS, 0.005, 5, blockSize=5)
    return np.zeros((0, 2)) if found is None else found.reshape(-1, 2).astype(float)


def _mark(labels: NDArray[np.uint8], points: Array, radius: int, label: int) -> None:
    for x, y in points.round().astype(int).tolist():
        cv2.circle(labels, (x, y), radius, label, -1)
