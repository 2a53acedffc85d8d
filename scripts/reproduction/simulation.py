"""The paper's simulation study with ground-truth keypoints, as jobs (see `experiments.study`)."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from experiments.study import StudySettings, run_case

from kpirl_ocp.irl.cases.tasks import TASKS, write_demonstrations
from kpirl_ocp.ocp.models.robot import Robot
from reproduction.settings import Preset
from reproduction.sweep import Job, Result


def jobs(preset: Preset, seeds: Sequence[int]) -> list[Job]:
    """One for every task and seed."""
    settings = StudySettings(iterations=preset.study_iterations, tests=preset.study_tests)
    return [
        Job(f"simulation/{task}-{seed}", run, {"task": task, "seed": seed, "settings": settings})
        for task in TASKS
        for seed in seeds
    ]


def run(task: str, seed: int, settings: StudySettings) -> Result:
    """Curves of every method: "<method>/<train, test or distance>", and which row was kept."""
    with tempfile.TemporaryDirectory() as directory:
        write_demonstrations(Path(directory), Robot.iiwa(), task, settings.tests, seed, settings.horizon)
        curves = run_case(Path(directory), seed, settings)
    found: Result = {}
    for method, curve in curves.items():
        found |= {f"{method}/{field}": getattr(curve, field) for field in ("train", "test", "distance")}
        found[f"{method}/best"] = np.array(curve.best)
    return found
