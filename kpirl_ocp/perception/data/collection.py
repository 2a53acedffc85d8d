"""Collect a data set: play a motion many times, in parallel over processes, and write the recordings.

Episode i depends on the seed and i alone, and is written whole or not at all; an interrupted collection resumes
where it stopped.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

import joblib
import numpy as np
from tqdm import tqdm

from kpirl_ocp.episodes import episode_path, read_meta, write_meta
from kpirl_ocp.errors import EpisodeError, ProblemError
from kpirl_ocp.perception.data.motions import MOTIONS, ArmMotion, Motion
from kpirl_ocp.perception.scene.camera import Camera
from kpirl_ocp.reporting import results_of


def collect(directory: str | Path, motion: Motion, count: int, seed: int = 0, jobs: int = 1) -> Path:
    """Write `count` episodes of a motion with their `meta.json`; existing ones are kept.

    Raises:
        ProblemError: a count or number of jobs below one, or a negative seed.
        EpisodeError: the directory holds data of other settings.
    """
    directory = Path(directory)
    if count < 1 or jobs < 1 or seed < 0:
        raise ProblemError(
            f"{directory}: needs at least one episode and one process and a seed >= 0, got {count}, {jobs} and {seed}."
        )
    directory.mkdir(parents=True, exist_ok=True)
    _agree(directory, count, describe(motion, seed))
    missing = [i for i in range(count) if not episode_path(directory, i).exists()]
    tasks = (joblib.delayed(_record)(directory, motion, seed, index) for index in missing)
    with closing(results_of(joblib.Parallel(jobs, return_as="generator_unordered"), tasks)) as written:
        for _ in tqdm(written, directory.name, len(missing), unit="episode"):
            pass
    return directory


def describe(motion: Motion, seed: int) -> dict[str, Any]:
    """The meta data of a collection."""
    name = next(name for name, kind in MOTIONS.items() if type(motion) is kind)
    camera = Camera()
    return {
        "motion": name,
        "settings": asdict(motion),  # type: ignore[call-overload]
        "fps": motion.rate,
        "size": [camera.height, camera.width],
        "camera": asdict(camera) | {"intrinsics": camera.intrinsics.tolist()},
        "robot": "iiwa" if isinstance(motion, ArmMotion) else None,
        "seed": seed,
    }


def _agree(directory: Path, count: int, meta: Mapping[str, Any]) -> None:
    """Write the meta data, or check that the data on disk were made with the same settings."""
    if (directory / "meta.json").exists():
        found = read_meta(directory)
        different = [key for key, value in meta.items() if _plain(found.get(key)) != _plain(value)]
        if different:
            raise EpisodeError(
                f"{directory} holds data with another {', '.join(different)}: choose another directory, or delete it."
            )
        count = max(count, found["episodes"])
    write_meta(directory, count, meta)


def _plain(value: Any) -> Any:
    """Tuples as lists, as in JSON."""
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    return [_plain(entry) for entry in value] if isinstance(value, tuple | list) else value


def _record(directory: Path, motion: Motion, seed: int, index: int) -> None:
    motion.write(episode_path(directory, index), np.random.default_rng([seed, index]))
