"""Iterations of `Riccati` and `Ipopt` on problems of a free final time, from cold starts that are drawn.

No guess is given: the final time starts in the middle of its bounds, and everything else at rest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import casadi as ca
import numpy as np
from bench.part import Part

from kpirl_ocp import OCP
from stress.settings import Profile
from stress.starts.board import REPORTED, part, race, reported
from stress.starts.systems import Start

T = 40
_FREE = np.inf
_NOTE = (
    f"Seeds from {REPORTED} on; no constant of the solver was chosen on these problems. {T} steps of Runge and Kutta's "
    "method from a drawn state to a fixed one in the shortest time (the lander: with the least fuel), without a guess. "
    "Lost, and won: what only one of them solves. Where neither does, there may be no way."
)


@dataclass(frozen=True, eq=False)
class Task:
    """From a drawn state to an end in a time that is free.

    rates: ds/dt of s (n_s,) and u (n_u,). end: zero at the end. near, far: s_0 is drawn between them. actions, times:
    bounds. more: further fields of the OCP by s and u. price: of the final time.
    """

    rates: Callable[[ca.SX, ca.SX], ca.SX]
    end: Callable[[ca.SX], ca.SX]
    near: list[float]
    far: list[float]
    actions: tuple[Any, Any]
    times: tuple[float, float] = (0.1, 50.0)
    more: Callable[[ca.SX, ca.SX], Mapping[str, Any]] = field(default=lambda s, u: {})
    price: float = 1.0


def measure(profile: Profile) -> Part:
    """Ratios of iterations by system, at seeds that are reported."""
    pairs = race({name: partial(start, name) for name in TASKS}, reported(profile.times))
    return part("Iterations to a free final time, Riccati / Ipopt", "system", pairs, _NOTE)


def start(name: str, seed: int) -> Start:
    """A cold start of this seed."""
    task = TASKS[name]
    s0 = np.random.default_rng(seed).uniform(task.near, task.far)
    return Start(problem_of(task), s0, np.zeros(0), np.zeros(0), None)


def problem_of(task: Task) -> OCP:
    """Its OCP; every stage pays its part of the final time."""
    s, u = ca.SX.sym("s", len(task.near)), ca.SX.sym("u", np.size(task.actions[0]))
    final, f = ca.SX.sym("final"), task.rates
    h = final / T
    k1 = f(s, u)
    k2 = f(s + h / 2 * k1, u)
    k3 = f(s + h / 2 * k2, u)
    return OCP.from_expressions(
        state=s,
        action=u,
        static=final,
        static_bounds=task.times,
        horizon=T,
        dynamics=s + h / 6 * (k1 + 2 * k2 + 2 * k3 + f(s + h * k3, u)),
        stage_cost=task.price * h,
        action_bounds=task.actions,
        terminal_equality=task.end(s),
        **task.more(s, u),
    )


def _itself(s: ca.SX) -> ca.SX:
    return s


def _cart_pole(s: ca.SX, u: ca.SX) -> ca.SX:
    sine, cosine = ca.sin(s[1]), ca.cos(s[1])
    heavy = 1 + 0.3 * sine**2
    along = (u + 0.3 * sine * (s[3] ** 2 - 9.81 * cosine)) / heavy
    return ca.vertcat(s[2:], along, (1.3 * 9.81 * sine - u * cosine - 0.3 * s[3] ** 2 * cosine * sine) / heavy)


def _quadrotor(s: ca.SX, u: ca.SX) -> ca.SX:
    lift = u[0] + u[1]
    return ca.vertcat(s[3:], -lift * ca.sin(s[2]), lift * ca.cos(s[2]) - 9.81, 5 * (u[0] - u[1]))


def _crane(s: ca.SX, u: ca.SX) -> ca.SX:
    """Place, rope, angle, and their rates."""
    swing = -(9.81 * ca.sin(s[2]) + u[0] * ca.cos(s[2]) + 2 * s[4] * s[5]) / s[1]
    return ca.vertcat(s[3:], u, swing)


def _car(s: ca.SX, u: ca.SX) -> ca.SX:
    """Offset and heading from the middle of a winding road, speed, steering angle, way along the road."""
    bend = 0.15 * ca.sin(0.3 * s[4])
    along = s[2] * ca.cos(s[1]) / (1 - s[0] * bend)
    return ca.vertcat(s[2] * ca.sin(s[1]), s[2] / 2.5 * ca.tan(s[3]) - bend * along, u, along)


def _grip(s: ca.SX, u: ca.SX) -> Mapping[str, Any]:
    sideways = s[2] ** 2 / 2.5 * ca.tan(s[3])
    limits = ([-1.5, -1, 1, -0.5, -_FREE], [1.5, 1, 20, 0.5, _FREE])
    return {"path_constraint": sideways**2 + u[0] ** 2 - 36, "state_bounds": limits}


def _lander(s: ca.SX, u: ca.SX) -> ca.SX:
    """Place and velocity in a plane above the moon, and mass, of which thrust takes its part."""
    return ca.vertcat(s[2:4], u[0] / s[4], u[1] / s[4] - 1.62, -0.02 * ca.sqrt(ca.sumsqr(u)))


def _thrust(s: ca.SX, u: ca.SX) -> Mapping[str, Any]:
    """Between a sixth of it and all; above a slope; and its fuel."""
    rows = ca.vertcat(ca.sumsqr(u) - 36, 1 - ca.sumsqr(u), s[0] - 2 * s[1] - 1, -s[0] - 2 * s[1] - 1)
    limits = ([-_FREE] * 4 + [0.3], [_FREE] * 5)
    return {"path_constraint": rows, "state_bounds": limits, "terminal_cost": -s[4]}


TASKS: dict[str, Task] = {
    "pendulum": Task(lambda s, u: ca.vertcat(s[1], ca.sin(s[0]) + u), _itself, [2.1, -0.5], [4.2, 0.5], (-0.6, 0.6)),
    "van der Pol": Task(
        lambda s, u: ca.vertcat(s[1], (1 - s[0] ** 2) * s[1] - s[0] + u), _itself, [-2, -1], [2, 2], (-1, 1)
    ),
    "Zermelo's boat": Task(lambda s, u: ca.vertcat(ca.cos(u) - s[1], ca.sin(u)), _itself, [-3, -2], [5, 2], (-7, 7)),
    "Dubins' car": Task(
        lambda s, u: ca.vertcat(ca.cos(s[2]), ca.sin(s[2]), u), _itself, [-4, -3, -2], [4, 3, 2], (-1, 1)
    ),
    "quadrotor in a plane": Task(
        _quadrotor, _itself, [-5, -3, -0.5, 0, 0, 0], [8, 4, 0.5, 0, 0, 0], ([0, 0], [10, 10])
    ),
    "cart-pole swing-up": Task(
        _cart_pole,
        _itself,
        [-1, 2.8, 0, 0],
        [1, 3.5, 0, 0],
        (-10, 10),
        more=lambda s, u: {"state_bounds": ([-2, *3 * [-_FREE]], [2, *3 * [_FREE]])},
    ),
    "crane": Task(
        _crane,
        lambda s: s - ca.DM([0, 5, 0, 0, 0, 0]),
        [-15, 2, 0, 0, 0, 0],
        [20, 12, 0, 0, 0, 0],
        ([-1, -0.5], [1, 0.5]),
        more=lambda s, u: {"state_bounds": ([-_FREE, 1, -0.3, -3, -1, -_FREE], [_FREE, 20, 0.3, 3, 1, _FREE])},
    ),
    "racing car": Task(
        _car, lambda s: s[4] - 40, [-1, -0.2, 3, 0, 0], [1, 0.2, 8, 0, 0], ([-4, -1], [3, 1]), more=_grip
    ),
    "moon lander, least fuel": Task(
        _lander,
        lambda s: s[:4],
        [-20, 40, -3, -4, 2],
        [30, 70, 3, 0, 2],
        ([-6, 0], [6, 6]),
        more=_thrust,
        price=0.0,
    ),
}
