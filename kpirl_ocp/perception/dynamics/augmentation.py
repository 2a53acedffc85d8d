"""Data augmentation for the dynamics of an arm that rests at every look: motions backwards, and noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kpirl_ocp.episodes import ArmTrack
from kpirl_ocp.errors import TrainingError

DETECTION = 0.5 / 120  # noise of a detected keypoint: half a pixel of 240 [half an image]
_ENCODERS = 2e-3  # noise of a measured velocity, so that nothing is read from the rounding of a rest [rad/s]
_AT_REST = 0.02  # largest velocity of an arm that rests, also against the shelf [rad/s]


def augmented(tracks: Sequence[ArmTrack], rng: np.random.Generator) -> list[ArmTrack]:
    """All tracks forwards and backwards, each with keypoints as detected and with noise: four times as many.

    All velocities have noise.

    Raises:
        TrainingError: an arm that does not rest at every look, whose motions cannot be turned round.
    """
    both = [*tracks, *map(backwards, tracks)]
    return [_measured(track, rng) for track in both + [_blurred(track, rng) for track in both]]


def backwards(track: ArmTrack) -> ArmTrack:
    """The motion from its end to its start; its actions are the displacements that the arm carried out.

    Raises:
        TrainingError: the arm does not rest at every look.
    """
    fastest = np.abs(track.velocities).max()
    if fastest > _AT_REST:
        raise TrainingError(
            "motions can be reversed only if the arm rests whenever the camera looks; it moves at "
            f"{fastest:.2g} rad/s. Train without --augment, or record at a lower rate."
        )
    return replace(
        track,
        keypoints=track.keypoints[::-1],
        joints=track.joints[::-1],
        velocities=-track.velocities[::-1],
        actions=np.diff(track.joints[::-1], axis=0),
    )


def _blurred(track: ArmTrack, rng: np.random.Generator) -> ArmTrack:
    keypoints = track.keypoints.copy()
    keypoints[..., :2] += rng.normal(0.0, DETECTION, keypoints[..., :2].shape)
    return replace(track, keypoints=keypoints)


def _measured(track: ArmTrack, rng: np.random.Generator) -> ArmTrack:
    return replace(track, velocities=track.velocities + rng.normal(0.0, _ENCODERS, track.velocities.shape))
