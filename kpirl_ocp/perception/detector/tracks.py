"""Recordings of the robot, and films, as tracks of detected keypoints."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from kpirl_ocp.episodes import ArmTrack, episode_path, read_meta
from kpirl_ocp.perception.data.recordings import read_arm_film
from kpirl_ocp.perception.detector.detector import KeypointDetector
from kpirl_ocp.perception.detector.keypoints import to_pixels
from kpirl_ocp.perception.tracking.tracks import Tracks

if TYPE_CHECKING:
    from kpirl_ocp.perception.tracking.watch import Film


def recorded_sizes(directory: Path) -> list[tuple[int, int]]:
    """T and number of joints of all recordings of a robot in a directory. Raises EpisodeError as `detect_tracks`."""
    count = read_meta(directory)["episodes"]
    films = (read_arm_film(episode_path(directory, index)) for index in range(count))
    return [film.actions.shape for film in films]


def detect_tracks(detector: KeypointDetector, directory: str | Path) -> list[ArmTrack]:
    """The keypoints of all recordings of a robot in a directory, one recording in memory at a time.

    A recording needs frames, joints, actions and times (`ArmFilm`); no truth about the object.

    Raises:
        EpisodeError: an episode is missing, malformed or not finite.
    """
    directory = Path(directory)
    count = read_meta(directory)["episodes"]
    films = (read_arm_film(episode_path(directory, index)) for index in range(count))
    clips = tqdm(films, f"detect {directory.name}", count, unit="episode")
    return [
        ArmTrack(
            keypoints=detector.detect(clip.images),
            times=clip.times,
            joints=clip.joints,
            velocities=clip.velocities,
            actions=clip.actions,
        )
        for clip in clips
    ]


def detector_tracks(film: Film, card: Path) -> Tracks:
    """Tracks by a trained keypoint detector, which sees the largest square in the middle; mu is the confidence."""
    detector = KeypointDetector.load(card)
    times, positions, confidence = [], [], []
    size = (0, 0)
    for time, image in tqdm(film.frames(), f"detect in {film.name}", unit="frame"):
        height, width = image.shape[:2]
        side, size = min(height, width), (width, height)
        corner = np.array([(width - side) // 2, (height - side) // 2])
        keypoints = detector.detect(image[None, corner[1] : corner[1] + side, corner[0] : corner[0] + side])[0]
        times.append(time)
        positions.append(corner + to_pixels(keypoints, side))
        confidence.append(keypoints[:, 2])
    return Tracks(np.array(times), np.array(positions), np.array(confidence), size)
