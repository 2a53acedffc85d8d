"""The systems of the board, and their noisy starts: each can be drawn again from its seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import casadi as ca
import numpy as np
from bench import control_problems
from bench.control_problems import ControlProblem
from reference import REFERENCES, Instance

from kpirl_ocp import OCP, Ipopt, Trajectory
from kpirl_ocp.types import Array

LEVELS = (0.0, 0.1, 0.3, 1.0)  # noise of a guess, relative to the sizes that states and actions have in the plan
ELSEWHERE = 0.1  # the same of s_0
_REFERENCES = ("cart-pole swing-up", "quadrotor, two obstacles", "unicycle, parking", "chain of masses")
_REFERENCES += ("rocket landing in a cone", "2R arm, reaching")


class Start(NamedTuple):
    """Arguments of a solve."""

    problem: OCP
    s0: Array
    psi: Array
    context: Array
    guess: Trajectory | None


class System:
    """A problem, where it starts, a guess of its plan, and the sizes (n_s,) and (n_u,) of its states and actions."""

    def __init__(self, problem: OCP, s0: Array, psi: Array, context: Array, guess: Trajectory | None) -> None:
        self.problem, self.s0, self.numbers, self.guess = problem, s0, (psi, context), guess
        plan = Ipopt().solve(problem, s0, psi, context, guess).raise_if_failed()
        self.sizes = [np.abs(part).max(axis=0) for part in (plan.states, plan.actions)]

    def start(self, seed: int) -> Start:
        """s_0 and a guess of the plan are off by noise; no guess where there is none and this seed has no noise."""
        rng, level = np.random.default_rng(seed), LEVELS[seed % len(LEVELS)]
        s0 = self.s0 + ELSEWHERE * self.sizes[0] * rng.normal(size=len(self.s0))
        if self.guess is None and level == 0:
            return Start(self.problem, s0, *self.numbers, None)
        horizon, m = self.problem.horizon, self.problem.n_actions
        guess = self.guess or Trajectory(np.tile(self.s0, (horizon + 1, 1)), np.zeros((horizon, m)))
        parts = zip((guess.states, guess.actions), self.sizes, strict=True)
        noisy = Trajectory(*(part + level * size * rng.normal(size=part.shape) for part, size in parts))
        return Start(self.problem, s0, *self.numbers, noisy)


def _of_bench(build: Callable[[], ControlProblem]) -> System:
    case = build()
    return System(case.problem, case.s0, case.psi, case.context, None)


def _of_reference(name: str) -> System:
    (found,) = (reference for reference in REFERENCES if reference.name == name)
    case: Instance = found.build(found.steps)
    return System(case.problem, case.s0, case.psi, np.zeros(0), case.guess)


def _tilting() -> ControlProblem:
    """The quadrotor, tilted by at most 0.3 rad."""
    case, limit = control_problems.quadrotor(), np.full(12, np.inf)
    limit[6:8] = 0.3
    return replace(case, problem=replace(case.problem, state_bounds=(-limit, limit)))


def _rocket() -> ControlProblem:
    """Powered landing with quaternions (Jin et al., Pontryagin differentiable programming, 2020), bounded thrust."""
    s, u = ca.SX.sym("s", 13), ca.SX.sym("u", 3)
    inertia, arm = ca.diag([0.5, 1, 1]), ca.vertcat(-0.5, 0, 0)

    def ode(s: ca.SX, u: ca.SX) -> ca.SX:
        q, w = s[6:10], s[10:]
        lift = u + 2 * ca.cross(q[1:], ca.cross(q[1:], u) + q[0] * u)  # by the attitude, from the rocket to the world
        turn = ca.vertcat(-ca.dot(q[1:], w), q[0] * w + ca.cross(q[1:], w)) / 2
        spin = ca.solve(inertia, ca.cross(arm, u) - ca.cross(w, inertia @ w))
        return ca.vertcat(s[3:6], lift - ca.vertcat(10, 0, 0), turn, spin)

    tilt = 2 * (s[8] ** 2 + s[9] ** 2)  # one minus the cosine
    cost = 10 * ca.sumsqr(s[:3]) + ca.sumsqr(s[3:6]) + 50 * tilt**2 + ca.sumsqr(s[10:])
    problem = OCP.from_expressions(
        state=s,
        action=u,
        horizon=40,
        action_bounds=([0, -5, -5], [20, 5, 5]),
        dynamics=s + 0.1 * ode(s, u),
        stage_cost=cost + ca.sumsqr(u[1:]) + 0.4 * u[0] ** 2,
        terminal_cost=cost,
    )
    turned = np.sin(0.75) / np.sqrt(2)
    s0 = np.array([10, -8, 5, -0.1, 0, 0, np.cos(0.75), 0, turned, -turned, 0, 0, 0])
    return ControlProblem("rocket with quaternions", problem, s0)


SYSTEMS: dict[str, Callable[[], System]] = {
    "pendulum swing-up": lambda: _of_bench(control_problems.pendulum),
    "cart-pole swing-up, soft": lambda: _of_bench(control_problems.cart_pole),
    "quadrotor": lambda: _of_bench(control_problems.quadrotor),
    "quadrotor, little tilt": lambda: _of_bench(_tilting),
    "chain of 3 masses": lambda: _of_bench(lambda: control_problems.chain(3)),
    "LQR, bounds on actions": lambda: _of_bench(lambda: control_problems.bounded_lqr(False)),
    "LQR, bounds on states too": lambda: _of_bench(lambda: control_problems.bounded_lqr(True)),
    "iiwa, placing": lambda: _of_bench(control_problems.iiwa),
    "placing network": lambda: _of_bench(control_problems.network),
    "rocket with quaternions": lambda: _of_bench(_rocket),
    **{name: lambda name=name: _of_reference(name) for name in _REFERENCES},
}
