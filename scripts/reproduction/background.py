"""The paper's red keypoint: one of four that stands still in the background. Does its weight become small?

Both experiments once more with a fifth keypoint that no action moves and that the detector sees with noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.visual.learning import InnerLoop
from kpirl_ocp.ocp.models.keypoint_dynamics import NetworkDynamics
from kpirl_ocp.perception.dynamics.augmentation import DETECTION
from kpirl_ocp.types import Array, Demonstration
from reproduction.contenders import LITERAL, MORE_STEPS, SMALL_START, UNROLLED, Contender, in_a_name
from reproduction.data import Models
from reproduction.learning import Lesson, learn_or_fail
from reproduction.sweep import Job, Result

TASKS = ("reaching", "placing")
PLACE = np.array([-0.6, 0.4])  # of the background keypoint [image half-widths]
CONTENDERS = (*UNROLLED, *MORE_STEPS, *LITERAL, *SMALL_START)


def jobs(
    task: str,
    models: Models,
    demonstrations: Sequence[Demonstration],
    chosen: InnerLoop,
    iterations: dict[Contender, int],
    seed: int,
) -> list[Job]:
    """One for every contender."""
    return [
        Job(
            name_of(task, contender),
            run,
            {
                "task": task,
                "models": models,
                "demonstrations": list(demonstrations),
                "lesson": Lesson(contender, contender.inner_loop(chosen), iterations[contender], seed),
            },
        )
        for contender in CONTENDERS
    ]


def name_of(task: str, contender: Contender) -> str:
    """Name of the job."""
    return f"background/{task}-{in_a_name(contender.label)}"


def run(task: str, models: Models, demonstrations: list[Demonstration], lesson: Lesson) -> Result:
    """Learn with the background keypoint, the last one."""
    rng = np.random.default_rng([lesson.seed, 13])
    seen = [with_background(demonstration, rng) for demonstration in demonstrations]
    return learn_or_fail(with_static_keypoint(models.load_dynamics(task)), seen, lesson)


@lru_cache(maxsize=2)
def with_static_keypoint(dynamics: NetworkDynamics) -> NetworkDynamics:
    """The model with one keypoint more, the last, that never moves and does not matter to the others."""
    if not dynamics.residual:
        raise ProblemError("a static keypoint needs dynamics that predict changes (residual).")
    weights, n_z = list(dynamics.mlp.weights), dynamics.n_z
    weights[0] = np.insert(weights[0], [n_z, n_z], 0.0, axis=1)
    weights[-1] = np.vstack([weights[-1], np.zeros((2, weights[-1].shape[1]))])
    biases = (*dynamics.mlp.biases[:-1], np.append(dynamics.mlp.biases[-1], [0.0, 0.0]))
    return replace(dynamics, mlp=replace(dynamics.mlp, weights=tuple(weights), biases=biases), n_z=n_z + 2)


def with_background(demonstration: Demonstration, rng: np.random.Generator) -> Demonstration:
    """The demonstration with the background keypoint, seen with the noise of the detector."""
    n_z = demonstration.observations.shape[1]
    extra: Array = PLACE + rng.normal(0.0, DETECTION, (len(demonstration.observations), 2))
    observations = np.hstack([demonstration.observations, extra])
    return Demonstration(np.insert(demonstration.s0, [n_z, n_z], extra[0]), observations[-1], observations)
