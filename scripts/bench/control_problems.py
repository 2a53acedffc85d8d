"""Ordinary control problems, as users of the field have them: swing-ups, a quadrotor, chains, pendulums, LQR."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TypeVar

import casadi as ca
import numpy as np

from kpirl_ocp import OCP
from kpirl_ocp.irl.cases.network_cases import placing_case
from kpirl_ocp.irl.cases.tasks import HORIZON, as_demonstration, demonstrate
from kpirl_ocp.ocp.models import KeypointCost, Robot, Weighted, keypoint_ocp
from kpirl_ocp.types import Array

GRAVITY = 9.81  # [m/s^2]
Symbol = TypeVar("Symbol", ca.SX, ca.MX)


@dataclass(frozen=True, eq=False)
class ControlProblem:
    """A problem with a start."""

    name: str
    problem: OCP
    s0: Array
    psi: Array = field(default_factory=lambda: np.zeros(0))
    context: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def arguments(self) -> tuple[OCP, Array, Array, Array]:
        """Of a solver."""
        return self.problem, self.s0, self.psi, self.context


def rk4(ode: Callable[[Symbol, Symbol], Symbol], s: Symbol, u: Symbol, step: float) -> Symbol:
    """One step of the classical Runge-Kutta method."""
    k1 = ode(s, u)
    k2 = ode(s + step / 2 * k1, u)
    k3 = ode(s + step / 2 * k2, u)
    k4 = ode(s + step * k3, u)
    return s + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def pendulum(horizon: int = 50) -> ControlProblem:
    """Swing-up of a pendulum (1 m, 1 kg) with at most 3 Nm."""
    s, u = ca.SX.sym("s", 2), ca.SX.sym("u")
    dynamics = rk4(lambda s, u: ca.vertcat(s[1], u - GRAVITY * ca.sin(s[0])), s, u, 0.05)
    up = 1 + ca.cos(s[0])
    problem = OCP.from_expressions(
        state=s,
        action=u,
        horizon=horizon,
        action_bounds=(-3, 3),
        dynamics=dynamics,
        stage_cost=0.05 * (10 * up + 0.1 * s[1] ** 2 + 0.01 * u**2),
        terminal_cost=100 * up + s[1] ** 2,
    )
    return ControlProblem("pendulum swing-up", problem, np.array([0.5, 0.0]))


def cart_pole(horizon: int = 50) -> ControlProblem:
    """Swing-up of a pole (0.1 kg, 0.5 m) on a cart (1 kg) with at most 20 N."""
    s, u = ca.SX.sym("s", 4), ca.SX.sym("u")
    cart, pole, length = 1.0, 0.1, 0.5

    def ode(s: ca.SX, u: ca.SX) -> ca.SX:
        sine, cosine, rate = ca.sin(s[1]), ca.cos(s[1]), s[3]
        inertia = cart + pole * sine**2
        acceleration = (u + pole * sine * (length * rate**2 + GRAVITY * cosine)) / inertia
        torque = -u * cosine - pole * length * rate**2 * cosine * sine - (cart + pole) * GRAVITY * sine
        return ca.vertcat(s[2], rate, acceleration, torque / (length * inertia))

    cost = s[0] ** 2 + 5 * (1 + ca.cos(s[1])) + 0.1 * s[2] ** 2 + 0.1 * s[3] ** 2
    problem = OCP.from_expressions(
        state=s,
        action=u,
        horizon=horizon,
        action_bounds=(-20, 20),
        dynamics=rk4(ode, s, u, 0.04),
        stage_cost=0.04 * (cost + 0.01 * u**2),
        terminal_cost=50 * cost,
    )
    return ControlProblem("cart-pole swing-up", problem, np.array([0.0, 0.5, 0.0, 0.0]))


def quadrotor(horizon: int = 40) -> ControlProblem:
    """Flight of a quadrotor (1 kg, arms of 0.2 m) to a point 2.4 m away; position, velocity, Euler angles, rates."""
    s, u = ca.SX.sym("s", 12), ca.SX.sym("u", 4)
    inertia, arm, drag = np.array([0.01, 0.01, 0.02]), 0.2, 0.05

    def ode(s: ca.SX, u: ca.SX) -> ca.SX:
        (roll, pitch, yaw), rates, thrust = ca.vertsplit(s[6:9]), s[9:12], ca.sum1(u)
        cr, sr, cp, sp, cy, sy = ca.cos(roll), ca.sin(roll), ca.cos(pitch), ca.sin(pitch), ca.cos(yaw), ca.sin(yaw)
        push = ca.vertcat(cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr) * thrust
        torque = ca.vertcat(arm * (u[1] - u[3]), arm * (u[2] - u[0]), drag * (u[0] - u[1] + u[2] - u[3]))
        turn = sr * rates[1] + cr * rates[2]
        angles = ca.vertcat(rates[0] + turn * ca.tan(pitch), cr * rates[1] - sr * rates[2], turn / cp)
        return ca.vertcat(
            s[3:6], push - ca.vertcat(0, 0, GRAVITY), angles, (torque - ca.cross(rates, inertia * rates)) / inertia
        )

    cost = 5 * ca.sumsqr(s[:3]) + 0.5 * ca.sumsqr(s[3:6]) + ca.sumsqr(s[6:9]) + 0.1 * ca.sumsqr(s[9:])
    problem = OCP.from_expressions(
        state=s,
        action=u,
        horizon=horizon,
        action_bounds=(0, 6),
        dynamics=rk4(ode, s, u, 0.05),
        stage_cost=0.05 * (cost + 0.1 * ca.sumsqr(u - GRAVITY / 4)),
        terminal_cost=10 * cost,
    )
    return ControlProblem("quadrotor", problem, np.array([1.0, -2.0, 1.0, *np.zeros(9)]))


def chain(masses: int, horizon: int = 40) -> ControlProblem:
    """A chain of masses on springs, of which the last is moved (Wirsching, Bock and Diehl, 2006)."""
    free = masses - 1
    s, u = ca.SX.sym("s", 3 * masses + 3 * free), ca.SX.sym("u", 3)
    mass, stiffness, rest = 0.033, 1.0, 0.033

    def ode(s: ca.SX, u: ca.SX) -> ca.SX:
        places = [ca.SX.zeros(3), *ca.vertsplit(s[: 3 * masses], 3)]
        pulls = []
        for one, other in pairwise(places):
            pulls.append(stiffness / mass * (1 - rest / ca.norm_2(other - one)) * (other - one))
        weight = ca.vertcat(0, 0, -GRAVITY)
        accelerations = [after - before + weight for before, after in pairwise(pulls)]
        return ca.vertcat(s[3 * masses :], u, *accelerations)

    goal, speeds = ca.vertcat(0.5, 0, 0), ca.sumsqr(s[3 * masses :])
    away = ca.sumsqr(s[3 * masses - 3 : 3 * masses] - goal)
    problem = OCP.from_expressions(
        state=s,
        action=u,
        horizon=horizon,
        action_bounds=(-1, 1),
        dynamics=rk4(ode, s, u, 0.2),
        stage_cost=25 * away + speeds + 0.01 * ca.sumsqr(u),
        terminal_cost=10 * away + speeds,
    )
    share = np.arange(1, masses + 1) / masses
    places = np.stack([0.5 * share, 0.4 * share, -0.3 * np.sin(np.pi * share)], axis=1)
    return ControlProblem(f"chain of {masses} masses", problem, np.concatenate([places.ravel(), np.zeros(3 * free)]))


def pendulums(count: int = 10, horizon: int = 40) -> ControlProblem:
    """A row of pendulums between torsion springs, three of them driven, entry by entry in MX: 1200 operations."""
    s, u = ca.MX.sym("s", 2 * count), ca.MX.sym("u", 3)
    stiffness, friction, driven = 2.0, 0.1, {0: 0, count // 2: 1, count - 1: 2}

    def ode(s: ca.MX, u: ca.MX) -> ca.MX:
        angles, rates = ca.vertsplit(s[:count]), ca.vertsplit(s[count:])
        torques = [-GRAVITY * ca.sin(angle) - friction * rate for angle, rate in zip(angles, rates, strict=True)]
        for i, j in [*pairwise(range(count)), *pairwise(reversed(range(count)))]:
            torques[i] += stiffness * ca.sin(angles[j] - angles[i])
        for i, motor in driven.items():
            torques[i] += u[motor]
        return ca.vertcat(*rates, *torques)

    problem = OCP.from_expressions(
        state=s,
        action=u,
        horizon=horizon,
        action_bounds=(-5, 5),
        dynamics=rk4(ode, rk4(ode, s, u, 0.025), u, 0.025),
        stage_cost=0.05 * (ca.sumsqr(s[:count]) + 0.1 * ca.sumsqr(s[count:]) + 0.01 * ca.sumsqr(u)),
        terminal_cost=10 * ca.sumsqr(s),
    )
    return ControlProblem("row of pendulums", problem, np.concatenate([np.linspace(1, -1, count), np.zeros(count)]))


def bounded_lqr(state_bounds: bool, horizon: int = 50) -> ControlProblem:
    """A random linear system, marginally stable (12 states, 4 actions), with bounds on actions, and on states."""
    rng, n_s, n_u = np.random.default_rng(0), 12, 4
    A = np.eye(n_s) + 0.2 * rng.normal(size=(n_s, n_s)) / np.sqrt(n_s)
    A, B = A / max(1.0, np.abs(np.linalg.eigvals(A)).max()), 0.3 * rng.normal(size=(n_s, n_u))
    s, u = ca.SX.sym("s", n_s), ca.SX.sym("u", n_u)
    limit = 2.5 if state_bounds else np.inf
    problem = OCP.from_expressions(
        state=s,
        action=u,
        horizon=horizon,
        action_bounds=(-0.5, 0.5),
        state_bounds=(-limit, limit),
        dynamics=ca.DM(A) @ s + ca.DM(B) @ u,
        stage_cost=ca.sumsqr(s) + 0.1 * ca.sumsqr(u),
        terminal_cost=ca.sumsqr(s),
    )
    return ControlProblem(
        "LQR, bounds on " + ("states too" if state_bounds else "actions"), problem, rng.normal(size=n_s)
    )


def iiwa() -> ControlProblem:
    """Placing with an iiwa and ground-truth keypoints, as in the README."""
    robot, cost = Robot.iiwa(), KeypointCost(Weighted(), effort=10.0)
    seen = as_demonstration(robot, demonstrate(robot, "placing", 1, seed=0)[0])
    problem = keypoint_ocp(robot, cost, HORIZON)
    psi = cost.initial(HORIZON, problem.n_observations)
    return ControlProblem("iiwa, placing", problem, seen.s0, psi, seen.context)


def network(horizon: int = 10) -> ControlProblem:
    """Placing with the learned keypoint dynamics that come with the package."""
    data = placing_case(horizon, 1)
    return ControlProblem("placing network", data.bounded, data.s0[0], data.psi.ravel(), data.goal[0])


def problems(tiny: bool) -> list[ControlProblem]:
    """All of them, or two short ones."""
    if tiny:
        return [pendulum(8), bounded_lqr(True, 5)]
    return [
        pendulum(),
        cart_pole(),
        quadrotor(),
        chain(3),
        chain(5),
        pendulums(),
        iiwa(),
        network(),
        bounded_lqr(False),
        bounded_lqr(True),
    ]
