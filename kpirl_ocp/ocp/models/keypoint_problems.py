"""Keypoint problems: the general OCP with states s = (z, theta, theta_dot) and joint displacements as actions.

    theta_{t+1} = theta_t + u_t,    theta_dot_{t+1} = theta_dot_t

`network_ocp` has the learned keypoints of appendix A.1, z_{t+1} = z_t + network(s_t, u_t); `keypoint_ocp` has the
ground truth of the simulation study, z_{t+1} = keypoints(theta_{t+1}).
"""

from __future__ import annotations

from functools import partial

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.models.keypoint_costs import KeypointCost
from kpirl_ocp.ocp.models.keypoint_dynamics import LinearisedNetwork, NetworkDynamics
from kpirl_ocp.ocp.models.keypoint_passes import NetworkPasses
from kpirl_ocp.ocp.models.pinhole import Pinhole
from kpirl_ocp.ocp.models.robot import Robot
from kpirl_ocp.ocp.problem.dynamics import DynamicsDerivatives
from kpirl_ocp.ocp.problem.guards import dense
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.statement.checks import UNBOUNDED, Bounds, bounds_of
from kpirl_ocp.types import Array


def keypoint_ocp(
    robot: Robot,
    cost: KeypointCost,
    horizon: int,
    *,
    unit: float = 1.0,
    camera: Pinhole | None = None,
    joint_limits: bool = True,
    max_displacement: float = np.inf,
    goals: ArrayLike | None = None,
) -> OCP:
    """Plan keypoints of an arm to the goal z_goal with ground-truth kinematics, in space or in a camera's image.

    With `goals` the cost draws z_t to z_goal + goals[t-1] instead, a goal for each step.

    Args:
        robot: with K keypoints.
        cost: of keypoints and actions.
        horizon: T, steps.
        unit: length of one keypoint unit, in metres (0.01 gives keypoints in centimetres) or, with a camera, in pixels.
        camera: keypoints are its pixels, x and y of each, and n_z = 2 K; without one n_z = 3 K.
        joint_limits: bound theta by the limits of the URDF.
        max_displacement: largest |u| per step and joint [rad].
        goals: (T, n_z) of the steps t = 1..T, from z_goal [unit]; None for zeros.

    Returns:
        A problem with states (n_z + 2 n_joints,), actions (n_joints,) and the context z_goal (n_z,).

    Raises:
        ProblemError: a unit or displacement that is not positive, a cost that does not fit the horizon, or goals of
            another shape.
    """
    if not unit > 0 or not max_displacement > 0:
        raise ProblemError(f"unit and max_displacement must be positive, got {unit!r} and {max_displacement!r}.")
    n_z, n_q = (2 if camera else 3) * robot.n_keypoints, robot.n_joints
    basis = cost.schedule(horizon)
    schedule = basis if goals is None else np.hstack([basis, _goal_columns(goals, horizon, n_z)])
    state, action = ca.SX.sym("s", n_z + 2 * n_q), ca.SX.sym("u", n_q)
    psi = ca.SX.sym("psi", cost.n_parameters(horizon, n_z))
    goal, stage = ca.SX.sym("goal", n_z), ca.SX.sym("d", schedule.shape[1])
    row, aim = stage[: basis.shape[1]], goal if goals is None else goal + stage[basis.shape[1] :]
    z, theta, velocity = state[:n_z], state[n_z : n_z + n_q], state[n_z + n_q :]
    successor = theta + action
    limits = robot.joint_limits if joint_limits else UNBOUNDED
    return OCP.from_expressions(
        state=state,
        action=action,
        parameters=psi,
        context=goal,
        stage=stage,
        dynamics=ca.vertcat(visible_keypoints(robot, camera, successor) / unit, successor, velocity),
        stage_cost=cost.stage_cost(z, action, psi, aim, row),
        terminal_cost=cost.stage_cost(z, ca.SX.zeros(n_q), psi, aim, row),
        observation=z,
        horizon=horizon,
        action_bounds=(-max_displacement, max_displacement),
        state_bounds=_bounds_of_joints(limits, n_z, n_q),
        schedule=schedule,
    )


def _bounds_of_joints(limits: Bounds, n_z: int, n_q: int) -> tuple[Array, Array]:
    """Bounds of the state of which only theta is bounded."""
    lower, upper = bounds_of("joint_limits", limits, (n_q,))
    z, velocity = np.full(n_z, np.inf), np.full(n_q, np.inf)
    return np.hstack([-z, lower, -velocity]), np.hstack([z, upper, velocity])


def _goal_columns(goals: ArrayLike, horizon: int, n_z: int) -> Array:
    """The goals as columns of the schedule (T+1, n_z); s_0 has none, as it has no weight."""
    found = np.asarray(goals, float)
    if found.shape != (horizon, n_z) or not np.isfinite(found).all():
        raise ProblemError(f"goals must be {(horizon, n_z)} finite numbers, got shape {found.shape}.")
    return np.vstack([np.zeros((1, n_z)), found])


def network_ocp(
    dynamics: NetworkDynamics,
    cost: KeypointCost,
    horizon: int,
    *,
    joint_limits: Bounds = UNBOUNDED,
    max_displacement: float = np.inf,
) -> OCP:
    """Plan keypoints in the image to the goal z_goal with a learned model.

    Args:
        dynamics: the model, n_z image coordinates and n_joints joints.
        cost: of keypoints and actions.
        horizon: T, steps of the model (1 / rate [s] each).
        joint_limits: (lower, upper) bounds of theta, each a number or (n_joints,) [rad].
        max_displacement: largest |u| per step and joint [rad].

    Returns:
        A problem with states (n_z + 2 n_joints,), actions (n_joints,) and the context z_goal (n_z,).

    Raises:
        ProblemError: limits that make no interval, a displacement that is not positive, or a cost that does not fit
            the horizon.
    """
    if not max_displacement > 0:
        raise ProblemError(f"max_displacement must be positive, got {max_displacement!r}.")
    n_z, n_q, n_psi = dynamics.n_z, dynamics.n_joints, cost.n_parameters(horizon, dynamics.n_z)
    schedule = cost.schedule(horizon)
    state, action = ca.SX.sym("s", dynamics.n_states), ca.SX.sym("u", n_q)
    psi, goal, stage = ca.SX.sym("psi", n_psi), ca.SX.sym("goal", n_z), ca.SX.sym("d", schedule.shape[1])
    running = cost.stage_cost(state[:n_z], action, psi, goal, stage)
    final = cost.stage_cost(state[:n_z], ca.SX.zeros(n_q), psi, goal, stage)
    return OCP(
        dynamics=dynamics.function(n_psi),
        stage_cost=ca.Function("stage_cost", [state, action, psi, goal, stage], [running]),
        terminal_cost=ca.Function("terminal_cost", [state, psi, goal, stage], [final]),
        observation=ca.Function("observation", [state], [state[:n_z]]),
        horizon=horizon,
        action_bounds=(-max_displacement, max_displacement),
        state_bounds=_bounds_of_joints(joint_limits, n_z, n_q),
        schedule=schedule,
        derivatives=DynamicsDerivatives(partial(LinearisedNetwork, dynamics), partial(NetworkPasses, dynamics)),
    )


def keypoint_state(robot: Robot, theta: ArrayLike, unit: float = 1.0, camera: Pinhole | None = None) -> Array:
    """The state of an arm at rest.

    Args:
        robot: with K keypoints.
        theta: joint positions (n_joints,) [rad].
        unit, camera: as in `keypoint_ocp`.

    Returns:
        (n_z + 2 n_joints,): keypoints [unit], theta, and velocities of zero.

    Raises:
        ProblemError: joint positions of another number, or not finite.
    """
    theta = np.asarray(theta, float)
    if theta.shape != (robot.n_joints,) or not np.isfinite(theta).all():
        raise ProblemError(f"theta must be {robot.n_joints} finite joint positions, got {theta!r}.")
    keypoints = dense(visible_keypoints(robot, camera, ca.DM(theta))).ravel()
    return np.concatenate([keypoints / unit, theta, np.zeros(robot.n_joints)])


def visible_keypoints(robot: Robot, camera: Pinhole | None, theta: ca.SX | ca.DM) -> ca.SX | ca.DM:
    """Keypoints of an arm at theta (n_joints,) [rad]: in space (3 K,) [m], or in a camera's image (2 K,) [pixels]."""
    points = robot.keypoint_function(theta)
    return points if camera is None else camera.project(points)
