"""The two tasks of the paper's simulation study, with an expert that demonstrates them.

reaching: the object moves along a straight line to a random goal.
placing: first along x, then down, as a bottle is put on a shelf.

The expert moves the object without turning it, with a minimum-jerk speed profile; the joints follow by tracking that
path with the OCP toolkit, within the joint limits. A demonstration is the arm's motion.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from kpirl_ocp.episodes import Episode, episode_path, read_episodes, write_episodes
from kpirl_ocp.errors import EpisodeError, ProblemError
from kpirl_ocp.motion import forward_then_down, minimum_jerk
from kpirl_ocp.ocp.models.keypoint_problems import keypoint_state, visible_keypoints
from kpirl_ocp.ocp.models.pinhole import Pinhole
from kpirl_ocp.ocp.models.robot import Robot
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.solvers.riccati import Riccati
from kpirl_ocp.types import Array, Demonstration

HORIZON = 9
FPS = 5.0
# The object in front of the arm, about 0.6 m away and 0.5 m up [rad].
_POSTURE = np.array([0.0, 0.6, 0.0, -1.4, 0.0, 1.1, 0.0])
_POSTURE_SPREAD = 0.15  # [rad]
_TRACKING_TOLERANCE = 5e-3  # [m]


def reaching_path(horizon: int, rng: np.random.Generator) -> Array:
    """Displacement (T+1, 3) [m] along a straight line to a random goal, 0.15 to 0.3 m away."""
    direction = rng.normal(size=3)
    goal = rng.uniform(0.15, 0.30) * direction / np.linalg.norm(direction)
    return minimum_jerk(np.linspace(0, 1, horizon + 1))[:, None] * goal


def placing_path(horizon: int, rng: np.random.Generator) -> Array:
    """Displacement (T+1, 3) [m]: 0.12 to 0.22 m along x in the first half, then 0.12 to 0.22 m down."""
    forward, down = rng.uniform(0.12, 0.22, size=2)
    return forward_then_down(forward, down, np.linspace(0, 1, horizon + 1))


TASKS: Mapping[str, Callable[[int, np.random.Generator], Array]] = {"reaching": reaching_path, "placing": placing_path}


def demonstrate(robot: Robot, task: str, count: int, seed: int, horizon: int = HORIZON) -> list[Episode]:
    """`count` demonstrations from random starts to random goals; the same seed gives the same ones.

    A path that leaves the workspace (more than 5 mm off, or joint limits in the way) is drawn again.
    """
    if task not in TASKS:
        raise ProblemError(f"task must be one of {', '.join(TASKS)}; got {task!r}.")
    if count < 1:
        raise ProblemError(f"there must be at least one demonstration, not {count}.")
    if robot.n_joints != len(_POSTURE):
        raise ProblemError(f"the demonstrations start from an iiwa posture; this arm has {robot.n_joints} joints.")
    rng = np.random.default_rng([seed, sorted(TASKS).index(task)])
    tracker = tracking_problem(robot, horizon)
    episodes: list[Episode] = []
    for _ in range(20 * count):
        if len(episodes) == count:
            return episodes
        start = _POSTURE + rng.uniform(-_POSTURE_SPREAD, _POSTURE_SPREAD, len(_POSTURE))
        episode = _track(robot, tracker, start, TASKS[task](horizon, rng))
        episodes += [] if episode is None else [episode]
    raise ProblemError(f"only {len(episodes)} of {count} demonstrations of {task} stayed within the arm's reach.")


def write_demonstrations(
    directory: Path, robot: Robot, task: str, tests: int, seed: int, horizon: int = HORIZON
) -> list[Episode]:
    """Demonstrate, the first episode for training and `tests` more for testing, and write them as episode files."""
    episodes = demonstrate(robot, task, 1 + tests, seed, horizon)
    meta = {"task": task, "robot": "iiwa", "fps": FPS, "seed": seed, "train": [0], "test": list(range(1, 1 + tests))}
    write_episodes(directory, episodes, meta)
    return episodes


def tracking_problem(robot: Robot, horizon: int, unit: float = 1.0, camera: Pinhole | None = None) -> OCP:
    """Follow reference keypoints, the context (T n_z,), for t = 1..T, with a little effort to settle the null space.

    unit, camera: as in `keypoint_ocp`.
    """
    n_z, n_q = (2 if camera else 3) * robot.n_keypoints, robot.n_joints
    theta, u = ca.SX.sym("theta", n_q), ca.SX.sym("u", n_q)
    reference, selector = ca.SX.sym("c", n_z * horizon), ca.SX.sym("d", horizon)
    error = visible_keypoints(robot, camera, theta) / unit - ca.reshape(reference, n_z, horizon) @ selector
    tracking = ca.sum1(selector) * ca.sumsqr(error)
    return OCP.from_expressions(
        state=theta,
        action=u,
        context=reference,
        stage=selector,
        dynamics=theta + u,
        stage_cost=tracking + 1e-4 * ca.sumsqr(u),
        terminal_cost=tracking,
        horizon=horizon,
        state_bounds=robot.joint_limits,
        schedule=np.vstack([np.zeros(horizon), np.eye(horizon)]),
    )


def _track(robot: Robot, tracker: OCP, start: Array, displacement: Array) -> Episode | None:
    """The arm's motion along a displacement (T+1, 3) [m] of the object, or None if it cannot follow."""
    reference = robot.locate(start)[None] + displacement[:, None]  # (T+1, K, 3)
    solution = Riccati().solve(tracker, start, (), reference[1:].ravel())
    if not solution.status.ok:
        return None
    keypoints = np.array([robot.locate(theta) for theta in solution.states])
    if np.abs(keypoints - reference).max() > _TRACKING_TOLERANCE:
        return None
    return Episode(solution.states, keypoints, solution.actions, np.arange(len(reference)) / FPS)


def read_demonstrations(robot: Robot, directory: Path) -> tuple[list[Episode], dict[str, Any]]:
    """Episodes and meta data of a directory.

    Raises EpisodeError, naming the file, if anything is amiss or belongs to an arm with other joints or keypoints.
    """
    episodes, meta = read_episodes(directory, Episode)
    expected = robot.n_joints, robot.n_keypoints
    for index, episode in enumerate(episodes):
        found = episode.joints.shape[1], episode.keypoints.shape[1]
        if found != expected:
            raise EpisodeError(
                f"{episode_path(directory, index)} has {found[0]} joints and {found[1]} keypoints; "
                f"the {robot.model.name} has {expected[0]} and {expected[1]}."
            )
    return episodes, meta


def as_demonstration(robot: Robot, episode: Episode, unit: float = 1.0) -> Demonstration:
    """The episode as keypoints in units of `unit` [m], with the last ones as the goal."""
    observations = episode.keypoints.reshape(len(episode.keypoints), -1) / unit
    return Demonstration(keypoint_state(robot, episode.joints[0], unit), observations[-1], observations)
