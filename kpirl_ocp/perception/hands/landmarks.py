"""Hands in images: where they are, and their 21 landmarks (Zhang et al., MediaPipe Hands, 2020).

A palm detector sees the whole image at 192 x 192 pixels; the landmark network sees the hand that it found, upright, at
224 x 224. Needs the extra `hands`, and the networks (`networks`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from kpirl_ocp.errors import DependencyError
from kpirl_ocp.perception.data.video import Frames
from kpirl_ocp.perception.hands.networks import FETCH, are_there, network
from kpirl_ocp.types import Array, Mask

try:
    from ai_edge_litert.interpreter import Interpreter
except ImportError:  # the extra is not installed
    Interpreter = None

WRIST, INDEX_KNUCKLE, MIDDLE_KNUCKLE, LITTLE_KNUCKLE = 0, 5, 9, 17
FINGER_TIPS = (4, 8, 12, 16, 20)
PALM = (WRIST, INDEX_KNUCKLE, MIDDLE_KNUCKLE, LITTLE_KNUCKLE)  # they move as one body
_PALM_SIZE, _HAND_SIZE = 192, 224  # of the images that the networks see [pixels]
_GRIDS = ((8, 2), (16, 6))  # of the palm detector: stride [pixels], anchors a cell
_SURE = 0.5  # score from which on it is a hand
_OVERLAP = 0.3  # share of the union of two palms' boxes above which they are one hand
_GROWTH, _SHIFT = 2.6, 0.5  # from a palm's box to the hand's, in its own size, along the fingers


@dataclass(frozen=True, eq=False)
class Hand:
    """A hand in an image.

    landmarks: (21, 2) [pixels]: the wrist, and four points of each finger from the thumb on, tips last.
    score: in [0, 1], whether this is a hand.
    """

    landmarks: Array
    score: float

    def mask(self, shape: tuple[int, ...]) -> Mask:
        """The hand in an image of the shape (H, W): the hull of its landmarks, widened by half a finger."""
        there = np.zeros(shape[:2], np.uint8)
        cv2.fillConvexPoly(there, cv2.convexHull(self.landmarks.astype(np.int32)), 1)
        palm = np.linalg.norm(self.landmarks[MIDDLE_KNUCKLE] - self.landmarks[WRIST])
        size = 2 * max(1, round(0.12 * palm)) + 1
        return np.asarray(cv2.dilate(there, np.ones((size, size), np.uint8)) > 0)


def hands_are_installed() -> bool:
    """Whether the extra `hands` is installed and its networks have been fetched."""
    return Interpreter is not None and are_there()


def check_hands() -> None:
    """Raise DependencyError, with the command that brings it, if the extra or one of its networks is missing."""
    for name in ("palm", "landmarks"):
        _interpreter(name)


def find_hands(image: Frames) -> list[Hand]:
    """All hands in an image (H, W, 3) RGB, the surest first.

    Raises DependencyError if the extra or the networks are missing.
    """
    hands = [_landmarks(image, corner, sides) for corner, sides in _palms(image)]
    return sorted((hand for hand in hands if hand.score >= _SURE), key=lambda hand: -hand.score)


def _palms(image: Frames) -> list[tuple[Array, Array]]:
    """Squares around hands: their upper left corners (2,) and sides (2, 2) [pixels], along the rows and columns."""
    side = max(image.shape[:2])
    square = np.zeros((side, side, 3), np.uint8)
    square[: image.shape[0], : image.shape[1]] = image
    small = cv2.resize(square, (_PALM_SIZE, _PALM_SIZE), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    boxes, scores = _run("palm", small)
    certainty = 1 / (1 + np.exp(-np.clip(scores[0, :, 0], -50, 50)))
    sure = certainty >= _SURE
    points = (boxes[0, sure].reshape(-1, 9, 2) / _PALM_SIZE).astype(float)
    points[:, [0, *range(2, 9)]] += _anchors()[sure][:, None]  # centre, size, and seven points of the palm
    corners = np.column_stack([points[:, 0] - points[:, 1] / 2, points[:, 1]])
    kept = cv2.dnn.NMSBoxes(corners.tolist(), certainty[sure].tolist(), _SURE, _OVERLAP)
    return [_upright(side * points[index]) for index in np.ravel(kept).astype(int)]


def _upright(points: Array) -> tuple[Array, Array]:
    """The square around a hand, turned so that its fingers point up, from a palm's box and points (9, 2) [pixels]."""
    centre, size, wrist, knuckle = points[0], points[1].max(), points[2], points[4]
    up = (knuckle - wrist) / max(float(np.linalg.norm(knuckle - wrist)), 1e-9)
    right = np.array([-up[1], up[0]])
    middle, side = centre + _SHIFT * size * up, _GROWTH * size
    return middle + side / 2 * (up - right), side * np.array([right, -up])


def _landmarks(image: Frames, corner: Array, sides: Array) -> Hand:
    """Landmarks in a turned square of the image."""
    matrix = np.column_stack([sides.T / _HAND_SIZE, corner])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    crop = cv2.warpAffine(image, matrix, (_HAND_SIZE, _HAND_SIZE), flags=flags).astype(np.float32) / 255
    landmarks, score, *_ = _run("landmarks", crop)
    return Hand(landmarks.reshape(21, 3)[:, :2].astype(float) @ matrix[:, :2].T + corner, float(score.ravel()[0]))


@lru_cache(maxsize=1)
def _anchors() -> Array:
    """Centres (2016, 2) of the palm detector's anchors, in shares of the image."""
    centres = []
    for stride, count in _GRIDS:
        axis = (np.arange(_PALM_SIZE // stride) + 0.5) * stride / _PALM_SIZE
        grid = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
        centres.append(np.repeat(grid, count, axis=0))
    return np.concatenate(centres)


@lru_cache(maxsize=2)
def _interpreter(name: str) -> Any:
    """The network "palm" or "landmarks", ready to run."""
    if Interpreter is None:
        raise DependencyError('hands need the package ai-edge-litert: pip install "kpirl-ocp[hands]".')
    path = network(name)
    try:
        interpreter = Interpreter(str(path))
    except ValueError as error:
        raise DependencyError(f"{path} is damaged: fetch it again with `{FETCH}`.") from error
    interpreter.allocate_tensors()
    return interpreter


def _run(name: str, image: Array) -> list[Array]:
    """Outputs of a network for an image (size, size, 3) with values in [0, 1]."""
    interpreter = _interpreter(name)
    interpreter.set_tensor(interpreter.get_input_details()[0]["index"], image[None])
    interpreter.invoke()
    return [interpreter.get_tensor(output["index"]) for output in interpreter.get_output_details()]
