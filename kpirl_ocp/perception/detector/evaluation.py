"""Errors of keypoints, one by one, against the truth of the simulation, in pixels of the camera's image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from kpirl_ocp.errors import TrainingError
from kpirl_ocp.perception.data.recordings import Recording
from kpirl_ocp.perception.detector.detector import KeypointDetector
from kpirl_ocp.perception.detector.keypoints import to_pixels
from kpirl_ocp.types import Array, Mask

_GAP = np.ones((9, 9), np.uint8)  # [pixels]
ON_OBJECT = 0.8  # a keypoint is on the object if it is in at least this share of the frames


@dataclass(frozen=True)
class DetectorScores:
    """Scores per keypoint, (K,) each.

    error: mean distance [pixels] between the bottle's middle and the best affine map of the keypoint to it. The map is
        fitted on half of the clips and measured on the other half, both ways.
    on_mask: share of frames in which the keypoint is on the bottle (see `on_mask`).
    displacement: median error [pixels] of its displacement since the first frame, without any map.
    jitter: root mean square change [pixels] of the mapped keypoint's error from one frame to the next.
    """

    error: Array
    on_mask: Array
    displacement: Array
    jitter: Array

    @property
    def on_object(self) -> int:
        """Number of keypoints on the object."""
        return int((self.on_mask >= ON_OBJECT).sum())


def score(detector: KeypointDetector, recordings: Sequence[Recording]) -> DetectorScores:
    """Score a detector on clips it has not been trained on.

    Raises:
        TrainingError: fewer than two clips.
    """
    if len(recordings) < 2:
        raise TrainingError(f"scores need at least two clips, got {len(recordings)}.")
    size = recordings[0].images.shape[1]
    tracks = [to_pixels(detector.detect(recording.images), size) for recording in recordings]  # (n, K, 2) each
    places = [recording.place for recording in recordings]
    residuals = _residuals(tracks, places)
    moved = [
        np.linalg.norm((track - track[0])[1:] - (place - place[0])[1:, None], axis=-1)
        for track, place in zip(tracks, places, strict=True)
    ]
    hits = [on_mask(track, recording.bottle) for track, recording in zip(tracks, recordings, strict=True)]
    jumps = np.concatenate([np.diff(residual, axis=0) for residual in residuals])
    return DetectorScores(
        error=np.linalg.norm(np.concatenate(residuals), axis=-1).mean(axis=0),
        on_mask=np.concatenate(hits).mean(axis=0),
        displacement=np.median(np.concatenate(moved), axis=0),
        jitter=np.sqrt(np.square(jumps).sum(axis=-1).mean(axis=0)),
    )


def on_mask(track: Array, mask: Mask) -> Mask:
    """Mask (n, K) of the keypoints (n, K, 2) [pixels] that lie on the masks (n, H, W).

    Gaps of a mask are closed first: a finger of the gripper, 6 pixels wide, lies across the bottle.
    """
    mask = np.array([_closed(image) for image in mask])
    size = np.array([mask.shape[2], mask.shape[1]])
    columns, rows = np.moveaxis(np.clip(np.floor(track), 0, size - 1).astype(int), -1, 0)
    return mask[np.arange(len(mask))[:, None], rows, columns]


def _closed(mask: Mask) -> Mask:
    """The mask (H, W) without gaps up to `_GAP`; a margin keeps it from growing to the edge of the image."""
    margin = len(_GAP)
    wide = np.pad(mask.astype(np.uint8), margin)
    return np.asarray(cv2.morphologyEx(wide, cv2.MORPH_CLOSE, _GAP)[margin:-margin, margin:-margin], bool)


def _residuals(tracks: Sequence[Array], places: Sequence[Array]) -> list[Array]:
    """Errors (n, K, 2) [pixels] of the mapped keypoints, clip by clip; maps come from the clips of the other half."""
    residuals: list[Array] = []
    for index, (track, place) in enumerate(zip(tracks, places, strict=True)):
        train = [np.concatenate(values[1 - index % 2 :: 2]) for values in (tracks, places)]
        maps = [_affine_map(train[0][:, k], train[1]) for k in range(track.shape[1])]
        mapped = np.stack([_extended(track[:, k]) @ matrix for k, matrix in enumerate(maps)], axis=1)
        residuals.append(mapped - place[:, None])
    return residuals


def _affine_map(points: Array, targets: Array) -> Array:
    """The matrix (3, 2) that minimises |[points, 1] @ matrix - targets|^2."""
    return np.asarray(np.linalg.lstsq(_extended(points), targets, rcond=None)[0], float)


def _extended(points: Array) -> Array:
    return np.column_stack([points, np.ones(len(points))])
