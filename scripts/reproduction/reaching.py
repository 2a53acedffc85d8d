"""Experiment 1 (paper, section 5.1): costs learned from the robot's own demonstrations of moving along x.

Learned from the first demonstrations, judged on the last ones by where the plan ends, and by where the simulated arm
ends when it plays the plan, or plans again after every look.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kpirl_ocp.episodes import ArmTrack
from kpirl_ocp.irl.learning.evaluation import evaluate, relative_distance
from kpirl_ocp.irl.visual.closed_loop import KeypointController
from kpirl_ocp.irl.visual.demonstrations import moving_keypoints, positions, robot_demonstration
from kpirl_ocp.irl.visual.learning import InnerLoop
from kpirl_ocp.irl.visual.planning_costs import planning_problem
from kpirl_ocp.types import Demonstration, Mask
from reproduction.contenders import REACHING, REACHING_EXECUTED, Contender, in_a_name, iterations_of
from reproduction.data import Models
from reproduction.learning import Lesson, learn_or_fail, unpacked
from reproduction.settings import Preset
from reproduction.sweep import Job, Result

RATE = 5  # [Hz]
LOOPS = ("open", "closed", "asynchronous")  # the last: closed, with a parallel detector at 30 Hz


def jobs(
    models: Models, tracks: Sequence[ArmTrack], chosen: InnerLoop, preset: Preset, seeds: Sequence[int]
) -> list[Job]:
    """One for every contender, number of demonstrations and seed."""
    dynamics = models.load_dynamics("reaching")
    demonstrations = [robot_demonstration(dynamics, track) for track in tracks]
    test = demonstrations[-preset.tests :]
    pool = demonstrations[: -preset.tests]
    found = []
    for count in preset.demonstrations:
        for seed in seeds:
            first = seed % len(pool)
            train = (pool[first:] + pool[:first])[:count]  # which one is learned from depends on the seed
            for contender in REACHING:
                iterations = iterations_of(
                    contender, preset.reaching_iterations, preset.reaching_descent_iterations, preset
                )
                arguments = {
                    "models": models,
                    "train": train,
                    "test": test,
                    "moving": moving_keypoints(pool),
                    "lesson": Lesson(contender, contender.inner_loop(chosen), iterations, seed),
                }
                found.append(Job(name_of(contender, count, seed), run, arguments))
    return found


def name_of(contender: Contender, count: int, seed: int) -> str:
    """Name of the job."""
    return f"reaching/{contender.cost}-{in_a_name(contender.method)}-{count}-{seed}"


def run(
    models: Models,
    train: list[Demonstration],
    test: list[Demonstration],
    moving: Mask,
    lesson: Lesson,
) -> Result:
    """Learn, and plan for the test demonstrations: their IRL losses and relative distances (n_test,)."""
    dynamics = models.load_dynamics("reaching")
    learned = learn_or_fail(dynamics, train, lesson)
    if learned["failure"]:
        return learned
    cost = unpacked(learned)
    found = evaluate(planning_problem(dynamics, cost.horizon), test, cost.psi, cost.solver)
    x_of_moving = np.stack([moving, np.zeros_like(moving)], axis=1).ravel()
    planned = [plan.states[:, : dynamics.n_z] for plan in found.solutions]
    pairs = list(zip(planned, test, strict=True))
    return learned | {
        "test": found.losses,
        "distance": found.relative_distances,
        "distance_x": np.array([relative_distance(z, demo, x_of_moving) for z, demo in pairs]),
        "failed_plans": sum(not plan.status.ok for plan in found.solutions),
    }


def execution_jobs(
    models: Models, tracks: Sequence[ArmTrack], learned: dict[str, Result], preset: Preset, seed: int
) -> list[Job]:
    """Play the plans of gradient steps, learned from the most demonstrations, on the simulated arm."""
    count = max(preset.demonstrations)
    return [
        Job(
            f"reaching-executed/{contender.label}-{loop}",
            execute,
            {
                "models": models,
                "tracks": list(tracks[-preset.tests :]),
                "learned": learned[name_of(contender, count, seed)],
                "loop": loop,
            },
        )
        for contender in REACHING_EXECUTED
        for loop in LOOPS
        if not learned[name_of(contender, count, seed)]["failure"]
    ]


def execute(models: Models, tracks: list[ArmTrack], learned: Result, loop: str) -> Result:
    """From the start of every test demonstration: relative distances (n_test,) as seen, and tracking errors [rad]."""
    from kpirl_ocp.perception.plant.asynchronous_plant import AsynchronousPlant
    from kpirl_ocp.perception.plant.camera_plant import CameraPlant
    from kpirl_ocp.perception.scene.scene import Scene

    dynamics, detector = models.load_dynamics("reaching"), models.load_detector()
    controller = KeypointController.build(dynamics, unpacked(learned), loop != "open")
    kind = AsynchronousPlant if loop == "asynchronous" else CameraPlant
    distances, errors = [], []
    with Scene(rate=RATE) as scene:
        for track in tracks:
            demonstration = robot_demonstration(dynamics, track)
            scene.reset(track.joints[0])
            done = controller.run(kind(scene, detector), demonstration.context)
            end = CameraPlant(scene, detector).look().keypoints
            distances.append(relative_distance(positions([*done.keypoints[:-1], end]), demonstration))
            errors.append(done.tracking_error)
    return {"distance": np.array(distances), "tracking_error": np.array(errors)}
