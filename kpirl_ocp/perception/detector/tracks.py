"""Recordings of the robot as tracks of detected keypoints."""

from __future__ import annotations

from pathlib import Path

from tqdm import tqdm

from kpirl_ocp.episodes import ArmTrack, episode_path, read_meta
from kpirl_ocp.perception.data.recordings import read_arm_film
from kpirl_ocp.perception.detector.detector import KeypointDetector


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
