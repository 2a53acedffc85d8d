"""The paper's simulation study with ground-truth keypoints, as jobs (see `experiments.study`)."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np
from experiments.apprenticeship_variants import Variant, run_variants
from experiments.study import Case, Curve, StudySettings, run_case

from kpirl_ocp.irl.cases.tasks import TASKS, write_demonstrations
from kpirl_ocp.ocp.models.robot import Robot
from reproduction.settings import Preset
from reproduction.sweep import Job, Result


def jobs(preset: Preset, seeds: Sequence[int]) -> list[Job]:
    """One for every task and seed."""
    settings = StudySettings(iterations=preset.study_iterations, tests=preset.study_tests)
    return [job_of(task, seed, settings) for task in TASKS for seed in seeds]


def job_of(task: str, seed: int, settings: StudySettings) -> Job:
    """All methods on one task and seed."""
    return Job(f"simulation/{task}-{seed}", run, {"task": task, "seed": seed, "settings": settings})


def run(task: str, seed: int, settings: StudySettings) -> Result:
    """Curves, "<method>/<train, test or distance>", which row was kept and seconds; and "variants/<name>/<field>"."""
    with tempfile.TemporaryDirectory() as directory:
        write_demonstrations(Path(directory), Robot.iiwa(), task, settings.tests, seed, settings.horizon)
        case = Case.read(Path(directory), seed, settings)
    curves = run_case(case)
    found: Result = {}
    for method, curve in curves.items():
        found |= {f"{method}/{field}": getattr(curve, field) for field in ("train", "test", "distance")}
        found[f"{method}/best"], found[f"{method}/seconds"] = np.array(curve.best), np.array(curve.seconds)
    for name, variant in run_variants(case).items():
        found |= {f"variants/{name}/{field}": np.array(value) for field, value in asdict(variant).items()}
    return found


def curve_of(found: Result, method: str) -> Curve:
    """The curve of a method in the result of a job."""
    return Curve(**{field.name: found[f"{method}/{field.name}"] for field in fields(Curve)})


def variants_of(found: Result) -> dict[str, Variant]:
    """The variants of apprenticeship learning in the result of a job."""
    names = dict.fromkeys(key.split("/")[1] for key in found if key.startswith("variants/"))
    fields = ("losses", "test", "swings")
    return {name: Variant(*(found[f"variants/{name}/{field}"] for field in fields)) for name in names}
