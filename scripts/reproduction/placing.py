"""Experiment 2 (paper, section 5.2): a person places a bottle, and the robot learns what mattered from the video.

Start 1 is near the person's start, start 2 nearer the goal. The goal is where the person's displacement takes the
robot's keypoints from start 1; costs are learned at start 1 and used at both. The demonstration is read at 5 Hz; its
ten steps are those of the plan, which the robot takes at 1 Hz.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from kpirl_ocp.irl.visual.closed_loop import Execution, KeypointController
from kpirl_ocp.irl.visual.demonstrations import positions, transferred_demonstration
from kpirl_ocp.irl.visual.learning import InnerLoop
from kpirl_ocp.ocp.models.keypoint_dynamics import NetworkDynamics
from kpirl_ocp.perception.detector.keypoints import to_pixels
from kpirl_ocp.perception.plant.asynchronous_plant import AsynchronousPlant
from kpirl_ocp.perception.plant.camera_plant import CameraPlant, Disturbance
from kpirl_ocp.perception.plant.starts import RATE, placing_starts
from kpirl_ocp.perception.scene.camera import Camera
from kpirl_ocp.perception.scene.scene import Scene
from kpirl_ocp.types import Array, Demonstration
from reproduction.contenders import PLACING, Contender, in_a_name, iterations_of
from reproduction.data import HandClip, Models
from reproduction.learning import Lesson, learn_or_fail, unpacked
from reproduction.settings import STARTS, Preset
from reproduction.sweep import Job, Result

SIZE = Camera().height  # of the images [pixels]
SUCCESS = 8.0  # the middle of the bottle ends within this of its goal [pixels]; 8 are about 31 mm


@dataclass(frozen=True, eq=False)
class Setup:
    """The robot's task.

    joints: (2, 7) [rad] of the two starts. demonstration: the person's, moved to the robot at start 1.
    goal_place: (2,) where the middle of the bottle should end [pixels], known to the simulation only.
    """

    joints: Array
    demonstration: Demonstration
    goal_place: Array


def set_up(models: Models, clip: HandClip, seed: int) -> Setup:
    """Put the arm at its starts, look once, and take over the person's displacements."""
    starts = placing_starts(models.load_detector(), clip.places, np.random.default_rng([seed, 7]))
    dynamics = models.load_dynamics("placing")
    demonstration = transferred_demonstration(dynamics, clip.track, starts.keypoints, starts.joints[0])
    return Setup(starts.joints, demonstration, starts.goal)


def setups(models: Models, clips: Sequence[HandClip], seeds: Sequence[int]) -> dict[int, Setup]:
    """One per seed; each seed has a demonstration of its own, as long as there are enough."""
    return {seed: set_up(models, clips[seed % len(clips)], seed) for seed in seeds}


def jobs(models: Models, found: dict[int, Setup], chosen: InnerLoop, preset: Preset) -> list[Job]:
    """One for every contender and seed."""
    made = []
    for seed, setup in found.items():
        for contender in PLACING:
            iterations = iterations_of(contender, preset.placing_iterations, preset.descent_iterations, preset)
            lesson = Lesson(contender, contender.inner_loop(chosen), iterations, seed)
            arguments = {"models": models, "demonstration": setup.demonstration, "lesson": lesson}
            made.append(Job(name_of(contender, seed), run, arguments))
    return made


def name_of(contender: Contender, seed: int) -> str:
    """Name of the job."""
    return f"placing/{contender.cost}-{in_a_name(contender.method)}-{seed}"


def run(models: Models, demonstration: Demonstration, lesson: Lesson) -> Result:
    """Learn from the one demonstration."""
    return learn_or_fail(models.load_dynamics("placing"), [demonstration], lesson)


@dataclass(frozen=True)
class Condition:
    """A disturbed condition.

    model_gain: the model's keypoints move this many times as far as they were trained to.
    asynchronous: the detector runs in parallel with the controller, at 30 Hz.
    """

    disturbance: Disturbance = Disturbance()
    model_gain: float = 1.0
    confidence: float = 0.0
    asynchronous: bool = False


def execution_jobs(models: Models, found: dict[int, Setup], learned: dict[str, Result]) -> list[Job]:
    """Every contender from both starts, in open and in closed loop."""
    return [
        Job(
            executed_name(contender, seed, start, closed),
            execute,
            {
                "models": models,
                "learned": learned[name_of(contender, seed)],
                "joints": setup.joints[start - 1],
                "setup": setup,
                "closed_loop": closed,
            },
        )
        for seed, setup in found.items()
        for contender in PLACING
        for start in STARTS
        for closed in (False, True)
        if not learned[name_of(contender, seed)]["failure"]
    ]


def executed_name(contender: Contender, seed: int, start: int, closed: bool) -> str:
    """Name of the job."""
    loop = "closed" if closed else "open"
    return f"placing-executed/{in_a_name(contender.label)}-{seed}-{start}-{loop}"


def execute(models: Models, learned: Result, joints: Array, setup: Setup, closed_loop: bool) -> Result:
    """Play it from `joints` (7,) and keep what the camera saw at t = 0, 5 and 10."""
    done, plant = play(models, learned, joints, setup, closed_loop, Condition(), np.random.default_rng(0))
    shown = [0, len(plant.images) // 2, len(plant.images) - 1]
    return scores(done, plant, setup) | {
        "images": np.array(plant.images)[shown],
        "keypoints": done.keypoints[shown],
        "goal": setup.demonstration.context,
        "failed_plans": sum(not plan.status.ok for plan in done.plans),
    }


def play(
    models: Models,
    learned: Result,
    joints: Array,
    setup: Setup,
    closed_loop: bool,
    condition: Condition,
    rng: np.random.Generator,
) -> tuple[Execution, CameraPlant]:
    """Run a learned cost on the simulated arm, from `joints` or the nearest within the limits."""
    dynamics = _exaggerated(models.load_dynamics("placing"), condition.model_gain)
    controller = KeypointController.build(dynamics, unpacked(learned), closed_loop, condition.confidence)
    with Scene(rate=RATE) as scene:
        scene.reset(np.clip(joints, *scene.joint_limits))
        kind = AsynchronousPlant if condition.asynchronous else CameraPlant
        plant = kind(scene, models.load_detector(), condition.disturbance, rng)
        return controller.run(plant, setup.demonstration.context), plant


@lru_cache(maxsize=4)
def _exaggerated(dynamics: NetworkDynamics, gain: float) -> NetworkDynamics:
    """The model with keypoints that move `gain` times as far."""
    zeros, ones = np.zeros(dynamics.mlp.n_in), np.ones(dynamics.mlp.n_in)
    outputs = np.zeros(dynamics.n_z), np.full(dynamics.n_z, gain)
    return replace(dynamics, mlp=dynamics.mlp.normalised(zeros, ones, *outputs))


def scores(done: Execution, plant: CameraPlant, setup: Setup) -> Result:
    """squared: mean over keypoints of the squared distance to the goal at the end [pixels^2].

    bottle: distance of the bottle's middle from where it should be [pixels]. tracking_error: [rad].
    """
    goal = setup.demonstration.context
    missed = (positions(done.keypoints[-1]) - goal) * SIZE / 2
    return {
        "squared": float(np.square(missed).reshape(-1, 2).sum(axis=1).mean()),
        "bottle": float(np.linalg.norm(plant.places[-1] - setup.goal_place)),
        "path": to_pixels(positions(done.keypoints).reshape(len(done.keypoints), -1, 2), SIZE),
        "tracking_error": done.tracking_error,
    }


def shown(clips: Sequence[HandClip], seed: int) -> Result:
    """The person's demonstration of a seed, for the image strips; its goal is where it ended."""
    clip = clips[seed % len(clips)]
    seen = clip.track.keypoints
    return {
        "images": clip.images,
        "keypoints": seen[[0, len(seen) // 2, len(seen) - 1]],
        "goal": positions(seen[-1]),
    }
