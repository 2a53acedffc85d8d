"""Learning from tracks in an image, with an arm whose keypoints are seen through a camera model: no learned dynamics.

Only the displacements from the first frame are kept, and scaled between the two cameras:

    z_demo,t = z_robot,0 + scale (p_person,t - p_person,0)

The arm's keypoints are points fixed to what it holds that make the same figure in its image as the person's do in the
film, scaled; so a turn of the object is demonstrated, too.

The cost is that of the paper with weights W_t on the keypoints and rho_t on the effort, both of each step,

    C_psi = sum_t  sum_i W_t[i] (z_t[i] - z_goal,t[i])^2  +  rho_t |u_t|^2,    W > 0,  rho >= 0.03

With one rho for all steps a plan towards a goal cannot gain speed: along one coordinate, optimality means
rho u_t = sum_{k > t} W_k (z_goal - z_k), a sum that loses a term with each step. A person starts slowly and pauses.
The factor common to W and rho is free, so the least rho bounds their ratio alone: without effort, joints that the
keypoints leave free would not be determined, and no gradient could be certified.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.cases.cost_files import ArmSetting, LearnedCost
from kpirl_ocp.irl.hypergradients.implicit import Implicit
from kpirl_ocp.irl.learning.learn import LearningResult, learn
from kpirl_ocp.irl.learning.optimisers import LBFGS
from kpirl_ocp.irl.visual.parts import goals_of_parts
from kpirl_ocp.ocp.models.keypoint_costs import KeypointCost, TimeDependent
from kpirl_ocp.ocp.models.pinhole import Pinhole
from kpirl_ocp.ocp.models.robot import Robot
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.solvers.riccati import Riccati
from kpirl_ocp.types import Array, Demonstration, Solution, Trajectory

_SOLVER = Riccati(tolerance=1e-9)
_OPTIMISER = LBFGS(first_step=1.0, tolerance=1e-4)
_PROGRESS = 0.05  # relative decrease of the loss for which a restart is worthwhile
_ENOUGH = 0.015  # share of the path's extent, root mean square, by which the tracks themselves may be off
_TURN = 0.05  # share of the path's extent by which a coordinate goes back where it turns, and within which it rests
FIRST_WEIGHTS = 0.01  # with efforts of 1, plans begin slowly; with larger weights they leap, each psi elsewhere
_LEAST_EFFORT = 0.03  # of the initial effort weights


def held_points(camera: Pinhole, rotation: Array, position: Array, offsets: ArrayLike) -> Array:
    """Points (K, 3) [m] in the frame of a link that appear at offsets (K, 2) [pixels] from the link's origin.

    Args:
        rotation, position: (3, 3) and (3,) [m] of the link in the world.
        offsets: in the plane through the link's origin that is parallel to the image.
    """
    origin = camera.rotation @ position + camera.translation
    across = np.asarray(offsets, float) @ np.linalg.inv(camera.intrinsics[:2, :2]).T * origin[2]
    return np.column_stack([across, np.zeros(len(across))]) @ camera.rotation @ rotation


def camera_demonstration(setting: ArmSetting, robot: Robot, theta: Array, displacements: Array) -> Demonstration:
    """The person's demonstration for an arm at rest at theta (n_joints,) [rad].

    displacements: (T+1, K, 2) of the keypoints from their first place [pixels of the arm's camera].

    Raises ProblemError if the arm has another number of keypoints.
    """
    if displacements.shape[1:] != (robot.n_keypoints, 2):
        raise ProblemError(f"the arm has {robot.n_keypoints} keypoints, the demonstration {displacements.shape[1]}.")
    s0 = setting.state(robot, theta)
    wanted = s0[: 2 * robot.n_keypoints] + displacements.reshape(len(displacements), -1) / setting.unit
    return Demonstration(s0, wanted[-1], wanted)


def path_distance(observations: Array, demonstrated: Array) -> float:
    """Mean distance of two paths (T+1, 2 K), relative to the extent of the demonstrated one."""
    return float(_mean_norms(observations - demonstrated).mean() / path_extent(demonstrated))


def path_extent(demonstrated: Array) -> float:
    """The farthest that the keypoints of a path (T+1, 2 K) go from their start, in the mean over them."""
    return float(_mean_norms(demonstrated - demonstrated[0]).max())


def _mean_norms(values: Array) -> Array:
    """(T+1,) mean length over K of vectors (T+1, 2 K)."""
    return np.asarray(np.linalg.norm(values.reshape(len(values), -1, 2), axis=-1).mean(axis=1))


@dataclass(frozen=True, eq=False)
class CameraLearning:
    """A learned cost, the history of learning, and how far its plan from the first start stays (`path_distance`)."""

    cost: LearnedCost
    history: LearningResult
    distance: float


def learn_in_image(
    setting: ArmSetting, robot: Robot, demonstrations: Sequence[Demonstration], rate: float, iterations: int = 200
) -> CameraLearning:
    """Learn weights of keypoints and effort at each step by the implicit gradient of the converged plan, with L-BFGS.

    It ends when the plans are off the demonstrations by at most 1.5 % of their extent, root mean square: tracks tell no
    more.

    Args:
        setting, robot: the arm.
        demonstrations: the same motion from one start or several; weights that fit one start may suit others less.
            The cost takes its start and goals from the first.
        rate: [Hz] of the demonstrations' steps.
        iterations: of L-BFGS, at most.

    Raises:
        CertificateError: a gradient cannot be certified.
    """
    demonstration = demonstrations[0]
    horizon, n_z = demonstration.horizon, demonstration.observations.shape[1]
    cost = KeypointCost(TimeDependent(), effort=(1.0,) * horizon, learn_effort=True, positivity="softplus")
    psi0 = cost.initial(horizon, n_z, FIRST_WEIGHTS)
    observations = demonstration.observations
    goals = goals_of_parts(observations, _TURN * path_extent(observations)) - observations[-1]
    problem = setting.problem(robot, cost, horizon, goals)
    least = replace(cost, effort=(_LEAST_EFFORT,) * horizon).initial(horizon, n_z)
    least[:-horizon] = -np.inf
    enough = observations[1:].size / 2 * (_ENOUGH * path_extent(observations)) ** 2
    result = learn_on(problem, demonstrations, psi0, iterations, least, enough)
    start = demonstration.s0[n_z : n_z + robot.n_joints]
    displacement = observations[-1] - observations[0]
    learned = LearnedCost(cost, result.psi, horizon, _SOLVER, setting, start, displacement, rate, goals)
    plan = plan_from(learned, robot, start)
    return CameraLearning(learned, result, path_distance(plan.states[:, :n_z], observations))


def learn_on(
    problem: OCP,
    demonstrations: Sequence[Demonstration],
    psi0: Array,
    iterations: int,
    least: Array | float = -np.inf,
    enough: float = -np.inf,
) -> LearningResult:
    """Learn with the implicit gradient, and begin again with a new memory where L-BFGS gets stuck, if that helps.

    Every plan starts cold, as that of the learned cost from its start will: a plan that is continued from one psi to
    the next may stay in a local minimum that no later plan finds.

    psi0: (n_psi,). iterations: in all. least: lower bounds of psi. enough: loss at which it ends.

    Raises CertificateError if a gradient cannot be certified.
    """
    run = partial(
        learn,
        problem,
        demonstrations,
        hypergradient=Implicit(_SOLVER),
        optimiser=_OPTIMISER,
        warm_start=False,
        bounds=(least, np.inf),
        callback=lambda state: state.best.loss <= enough,
    )
    result = run(psi0, steps=iterations).raise_if_interrupted()
    while (left := iterations + 1 - len(result.losses)) > 0 and result.loss > enough:
        more = run(result.psi, steps=left).raise_if_interrupted()
        stuck = more.loss > (1 - _PROGRESS) * result.loss
        result = replace(
            more,
            losses=np.concatenate([result.losses, more.losses[1:]]),
            psis=np.concatenate([result.psis, more.psis[1:]]),
            seconds=np.concatenate([result.seconds, result.seconds[-1] + more.seconds[1:]]),
            uncertified=np.concatenate([result.uncertified, more.uncertified[1:]]),
        )
        if stuck:
            break
    return result


def plan_from(learned: LearnedCost, robot: Robot, theta: Array) -> Solution:
    """Plan with a learned cost from a start theta (n_joints,) [rad], towards the learned displacement from there.

    Two solves, a cold one and one that starts at the moved plan for the learned start, may end at different minima; the
    cheaper one is returned.

    Raises SolveError if no plan is found.
    """
    problem, solver, s0 = learned.problem(robot), learned.solver, learned.setting.state(robot, theta)
    learned_s0 = learned.setting.state(robot, learned.start)
    context = learned.goal(s0)
    plan = solver.solve(problem, s0, learned.psi, context)
    first = solver.solve(problem, learned_s0, learned.psi, learned.goal(learned_s0))
    if not first.status.ok:
        return plan.raise_if_failed()
    moved = Trajectory(first.states + (s0 - learned_s0), first.actions)
    warm = solver.solve(problem, s0, learned.psi, context, moved)
    return cheapest([plan, warm]).raise_if_failed()


def cheapest(plans: Sequence[Solution]) -> Solution:
    """The plan of least cost of those that were found, or the first one if none was."""
    found = [plan for plan in plans if plan.status.ok]
    return min(found or plans[:1], key=lambda plan: plan.objective)
