"""The demonstrations of the experiments, collected when they are missing, through the trained detector."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import joblib
import numpy as np
import torch

from kpirl_ocp.assets import shipped_model
from kpirl_ocp.episodes import ArmTrack, KeypointTrack
from kpirl_ocp.errors import ModelError
from kpirl_ocp.irl.cases.planar_arm import planar_dynamics
from kpirl_ocp.ocp.models.keypoint_dynamics import NetworkDynamics
from kpirl_ocp.perception.data.clips import read_recordings
from kpirl_ocp.perception.data.collection import collect
from kpirl_ocp.perception.data.motions import HandPlacing, Reaching
from kpirl_ocp.perception.detector.detector import KeypointDetector
from kpirl_ocp.perception.detector.tracks import detect_tracks
from kpirl_ocp.types import Array

# Seeds of the collections; no model was trained or scored on them.
_REACHING, _REACHING_VALIDATION, _PLACING, _PLACING_VALIDATION = 100, 101, 102, 103
NAMES = ("detector", "reaching", "placing")


@dataclass(frozen=True)
class Models:
    """Cards of the three trained models, and a hash of their files."""

    detector: Path
    reaching: Path
    placing: Path
    digest: str

    @classmethod
    def find(cls, directory: str | None) -> Models:
        """The models in a directory, or the ones that come with the package. Raises ModelError if one is missing."""
        cards = [shipped_model(name) if directory is None else Path(directory) / f"{name}.json" for name in NAMES]
        paths = [path for card in cards for path in (card, card.with_suffix(".safetensors"))]
        missing = [str(path) for path in paths if not path.is_file()]
        if missing:
            raise ModelError(f"--models {directory}: there is no {', '.join(missing)}.")
        files = [path.read_bytes() for path in paths]
        return cls(*(card.resolve() for card in cards), digest=str(joblib.hash(files)))

    def load_detector(self) -> KeypointDetector:
        """The detector; read once per process."""
        return _load_detector(self)

    def load_dynamics(self, task: str) -> NetworkDynamics:
        """The dynamics of a task, "reaching" or "placing"; read once per process, so that problems can be shared."""
        return _load_dynamics(self, task)


@lru_cache(maxsize=1)
def _load_detector(models: Models) -> KeypointDetector:
    torch.set_num_threads(1)  # jobs run side by side
    return KeypointDetector.load(models.detector)


@lru_cache(maxsize=2)
def _load_dynamics(models: Models, task: str) -> NetworkDynamics:
    return planar_dynamics({"reaching": models.reaching, "placing": models.placing}[task])


@dataclass(frozen=True, eq=False)
class HandClip:
    """A person's demonstration at 5 Hz.

    track: detected keypoints. places: (T+1, 2) truth about the bottle [pixels].
    images: (3, H, W, 3), the first, the middle and the last.
    """

    track: KeypointTrack
    places: Array
    images: np.ndarray


@dataclass(frozen=True, eq=False)
class Data:
    """Demonstrations of both tasks, to learn from and to validate with."""

    reaching: list[ArmTrack]
    reaching_validation: list[ArmTrack]
    placing: list[HandClip]
    placing_validation: list[HandClip]


def prepare(directory: Path, models: Models, reaching: int, validation: int, clips: int, workers: int) -> Data:
    """Collect what is missing, `reaching` and `clips` demonstrations and `validation` of each task, and detect."""
    detector = models.load_detector()

    def arm(name: str, count: int, seed: int) -> list[ArmTrack]:
        place = collect(directory / name, Reaching(), count, seed, workers)
        return detect_tracks(detector, place)[:count]

    def hand(name: str, count: int, seed: int) -> list[HandClip]:
        place = collect(directory / name, HandPlacing(), count, seed, workers)
        return [_clip(detector, recording) for recording in read_recordings(place)[:count]]

    return Data(
        arm("reaching", reaching, _REACHING),
        arm("reaching-validation", validation, _REACHING_VALIDATION),
        hand("placing", clips, _PLACING),
        hand("placing-validation", validation, _PLACING_VALIDATION),
    )


def _clip(detector: KeypointDetector, recording) -> HandClip:  # type: ignore[no-untyped-def]
    images = recording.images[[0, len(recording.images) // 2, -1]]
    return HandClip(KeypointTrack(detector.detect(recording.images), recording.times), recording.place, images)
