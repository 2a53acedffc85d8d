"""The problems: a function of the number of steps gives the OCP, a start, and a guess; the source gives the optimum.

Actions are constant over a step, and one step of the classical Runge-Kutta method goes along it, unless said otherwise.
Times that are free are static decisions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from kpirl_ocp import OCP, Trajectory

Ode = Callable[[ca.SX, ca.SX], ca.SX]


@dataclass(frozen=True, eq=False)
class Instance:
    """A discretised problem, where it starts, a guess of its plan, the sign of its objective, and its parameters."""

    problem: OCP
    s0: np.ndarray
    guess: Trajectory | None = None
    sign: float = 1.0
    psi: np.ndarray = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class Reference:
    """A problem of the literature.

    optimum: published value, None if there is none. digits: relative error of the discretisation with `steps` steps.
    """

    name: str
    source: str
    optimum: float | None
    digits: float
    steps: int
    build: Callable[[int], Instance]


def rk4(ode: Ode, s: ca.SX, u: ca.SX, step: ca.SX | float) -> ca.SX:
    """One step of the classical Runge-Kutta method."""
    k1 = ode(s, u)
    k2 = ode(s + step / 2 * k1, u)
    k3 = ode(s + step / 2 * k2, u)
    k4 = ode(s + step * k3, u)
    return s + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def line(first: list[float], last: list[float], steps: int, n_u: int) -> Trajectory:
    """States on a line, and no action."""
    return Trajectory(np.linspace(first, last, steps + 1), np.zeros((steps, n_u)))


def until_the_end(lower: list[float], steps: int) -> np.ndarray:
    """Lower bounds (T+1, n_s) of all states but the last, which equalities give."""
    return np.vstack([np.tile(lower, (steps, 1)), np.full(len(lower), -np.inf)])


def bryson_denham(steps: int) -> Instance:
    """min 1/2 int u^2, from (0, 1) to (0, -1) in unit time, with x <= 1/9: 4 / (9 l) = 4."""
    s, u, h = ca.SX.sym("s", 2), ca.SX.sym("u"), 1 / steps
    problem = OCP.from_expressions(
        state=s,
        action=u,
        horizon=steps,
        dynamics=ca.vertcat(s[0] + h * s[1] + h**2 / 2 * u, s[1] + h * u),
        stage_cost=h / 2 * u**2,
        state_bounds=(-np.inf, [1 / 9, np.inf]),
        terminal_equality=s - ca.vertcat(0, -1),
    )
    return Instance(problem, np.array([0.0, 1.0]))


def minimum_time(steps: int) -> Instance:
    """A mass moves by 1 from rest to rest with |u| <= 1: the time is 2."""
    s, u, time = ca.SX.sym("s", 2), ca.SX.sym("u"), ca.SX.sym("time")
    h = time / steps
    problem = OCP.from_expressions(
        state=s,
        action=u,
        static=time,
        static_bounds=(0.1, 10),
        horizon=steps,
        dynamics=ca.vertcat(s[0] + h * s[1] + h**2 / 2 * u, s[1] + h * u),
        terminal_cost=time,
        action_bounds=(-1, 1),
        terminal_equality=s - ca.vertcat(1, 0),
    )
    return Instance(problem, np.zeros(2), line([0, 0, 3], [1, 0, 3], steps, 1))


def moon_lander(steps: int) -> Instance:
    """Soft landing from h = 10, v = -2 with 0 <= u <= 3 and g = 1.5, least int u: 8.2462."""
    s, u, time = ca.SX.sym("s", 2), ca.SX.sym("u"), ca.SX.sym("time")
    h = time / steps
    problem = OCP.from_expressions(
        state=s,
        action=u,
        static=time,
        static_bounds=(1, 20),
        horizon=steps,
        dynamics=ca.vertcat(s[0] + h * s[1] + h**2 / 2 * (u - 1.5), s[1] + h * (u - 1.5)),
        stage_cost=h * u,
        action_bounds=(0, 3),
        state_bounds=(until_the_end([0, -np.inf], steps), np.inf),
        terminal_equality=s,
    )
    return Instance(problem, np.array([10.0, -2.0]), line([10, -2, 5], [0, 0, 5], steps, 1))


def brachistochrone(steps: int) -> Instance:
    """The fastest slide from (0, 0) to (2, 2) under g = 9.81: 0.82434."""
    s, u, time = ca.SX.sym("s", 3), ca.SX.sym("u"), ca.SX.sym("time")
    ode = lambda s, u: ca.vertcat(s[2] * ca.sin(u), s[2] * ca.cos(u), 9.81 * ca.cos(u))  # noqa: E731
    problem = OCP.from_expressions(
        state=s,
        action=u,
        static=time,
        static_bounds=(0.1, 5),
        horizon=steps,
        dynamics=rk4(ode, s, u, time / steps),
        terminal_cost=time,
        action_bounds=(0, np.pi),
        terminal_equality=s[:2] - 2,
    )
    guess = Trajectory(np.linspace([0, 0, 0, 1], [2, 2, 6, 1], steps + 1), np.full((steps, 1), 0.8))
    return Instance(problem, np.zeros(3), guess)


def particle_steering(steps: int) -> Instance:
    """COPS: the direction of a constant thrust, to y = 5 with velocity (45, 0) in least time: 0.554577."""
    s, u, time = ca.SX.sym("s", 4), ca.SX.sym("u"), ca.SX.sym("time")
    ode = lambda s, u: ca.vertcat(s[2], s[3], 100 * ca.cos(u), 100 * ca.sin(u))  # noqa: E731
    problem = OCP.from_expressions(
        state=s,
        action=u,
        static=time,
        static_bounds=(0.1, 5),
        horizon=steps,
        dynamics=rk4(ode, s, u, time / steps),
        terminal_cost=time,
        action_bounds=(-np.pi / 2, np.pi / 2),
        terminal_equality=s[1:] - ca.vertcat(5, 45, 0),
    )
    return Instance(problem, np.zeros(4), line([0, 0, 0, 0, 1], [20, 5, 45, 0, 1], steps, 1))


def goddard(steps: int) -> Instance:
    """COPS: the greatest height of a rocket with drag: 1.01283."""
    s, u, time = ca.SX.sym("s", 3), ca.SX.sym("u"), ca.SX.sym("time")

    def ode(s: ca.SX, u: ca.SX) -> ca.SX:
        height, speed, mass = s[0], s[1], s[2]
        drag = 310 * speed**2 * ca.exp(-500 * (height - 1))
        return ca.vertcat(speed, (u - drag) / mass - 1 / height**2, -2 * u)

    problem = OCP.from_expressions(
        state=s,
        action=u,
        static=time,
        static_bounds=(0.02, 1),
        horizon=steps,
        dynamics=rk4(ode, s, u, time / steps),
        terminal_cost=-1000 * s[0],
        action_bounds=(0, 3.5),
        state_bounds=(until_the_end([1, 0, -np.inf], steps), np.inf),  # u >= 0 and the last mass bound the mass
        terminal_equality=s[2] - 0.6,
    )
    share = np.linspace(0, 1, steps + 1)
    states = np.stack([1 + 0 * share, share * (1 - share), 1 - 0.4 * share, 0.2 + 0 * share], axis=1)
    guess = Trajectory(states, np.full((steps, 1), 1.75))
    return Instance(problem, np.array([1.0, 0.0, 1.0]), guess, sign=-1e-3)


def robot_arm(steps: int) -> Instance:
    """COPS: an arm of length 5 turns by 120 degrees in least time: 9.14138."""
    s, u, time = ca.SX.sym("s", 6), ca.SX.sym("u", 3), ca.SX.sym("time")

    def ode(s: ca.SX, u: ca.SX) -> ca.SX:
        inertia = ((5 - s[0]) ** 3 + s[0] ** 3) / 3
        return ca.vertcat(s[3:], u[0] / 5, u[1] / (inertia * ca.sin(s[2]) ** 2), u[2] / inertia)

    problem = OCP.from_expressions(
        state=s,
        action=u,
        static=time,
        static_bounds=(1, 50),
        horizon=steps,
        dynamics=rk4(ode, s, u, time / steps),
        terminal_cost=time,
        action_bounds=(-1, 1),
        state_bounds=([0, -np.pi, 0, *[-np.inf] * 3], [5, np.pi, np.pi, *[np.inf] * 3]),
        terminal_equality=s - ca.vertcat(4.5, 2 * np.pi / 3, np.pi / 4, 0, 0, 0),
    )
    start = [4.5, 0, np.pi / 4, 0, 0, 0]
    guess = line([*start, 10], [4.5, 2 * np.pi / 3, np.pi / 4, 0, 0, 0, 10], steps, 3)
    return Instance(problem, np.array(start), guess)


def hanging_chain(steps: int) -> Instance:
    """COPS: the shape of a chain of length 4 between heights 1 and 3, unit distance apart: 5.06891."""
    s, u, h = ca.SX.sym("s", 3), ca.SX.sym("u"), 1 / steps
    ode = lambda s, u: ca.vertcat(u, s[0] * ca.sqrt(1 + u**2), ca.sqrt(1 + u**2))  # noqa: E731
    problem = OCP.from_expressions(
        state=s,
        action=u,
        horizon=steps,
        dynamics=rk4(ode, s, u, h),
        terminal_cost=s[1],
        terminal_equality=ca.vertcat(s[0] - 3, s[2] - 4),
    )
    share = np.linspace(0, 1, steps + 1)
    states = np.stack([4 * (share - 0.25) * (2 * share - 0.5) + 0.5 * (1 - share), 5 * share, 4 * share], axis=1)
    states[0] = [1, 0, 0]
    slopes = np.diff(states[:, 0])[:, None] * steps
    return Instance(problem, np.array([1.0, 0.0, 0.0]), Trajectory(states, slopes))


def linear_quadratic(steps: int) -> Instance:
    """min 1/2 int x^2 + u^2, x' = u, from 1, over T = 1: tanh(1) / 2."""
    s, u, h = ca.SX.sym("s"), ca.SX.sym("u"), 1 / steps
    problem = OCP.from_expressions(
        state=s,
        action=u,
        horizon=steps,
        dynamics=s + h * u,
        stage_cost=h / 2 * (s**2 + h * s * u + h**2 / 3 * u**2 + u**2),  # the integral, exactly
    )
    return Instance(problem, np.ones(1))


def free_flying_robot(steps: int) -> Instance:
    """Sakawa: a robot flies to the origin in 12 units of time with least use of its four jets: 7.91019."""
    s, u, h = ca.SX.sym("s", 6), ca.SX.sym("u", 4), 12 / steps

    def ode(s: ca.SX, u: ca.SX) -> ca.SX:
        push = u[0] - u[1] + u[2] - u[3]
        turn = 0.2 * (u[0] - u[1]) - 0.2 * (u[2] - u[3])
        return ca.vertcat(s[3:], push * ca.cos(s[2]), push * ca.sin(s[2]), turn)

    problem = OCP.from_expressions(
        state=s,
        action=u,
        horizon=steps,
        dynamics=rk4(ode, s, u, h),
        stage_cost=h * ca.sum1(u),
        action_bounds=(0, np.inf),
        path_constraint=ca.vertcat(u[0] + u[1] - 1, u[2] + u[3] - 1),
        terminal_equality=s,
    )
    start = [-10, -10, np.pi / 2, 0, 0, 0]
    return Instance(problem, np.array(start), line(start, [0] * 6, steps, 4))


def glider(steps: int) -> Instance:
    """COPS: the longest flight of a hang glider through a thermal: 1248.03 m."""
    s, u, time = ca.SX.sym("s", 4), ca.SX.sym("u"), ca.SX.sym("time")

    def ode(s: ca.SX, u: ca.SX) -> ca.SX:
        radius = (s[0] / 100 - 2.5) ** 2
        climb = s[3] - 2.5 * (1 - radius) * ca.exp(-radius)
        speed = ca.sqrt(s[2] ** 2 + climb**2)
        pressure = 1.13 * 14 * speed**2 / 2
        drag, lift = (0.034 + 0.069662 * u**2) * pressure, u * pressure
        sine, cosine = climb / speed, s[2] / speed
        across, up = -lift * sine - drag * cosine, lift * cosine - drag * sine
        return ca.vertcat(s[2:], across / 100, up / 100 - 9.81)

    problem = OCP.from_expressions(
        state=s,
        action=u,
        static=time,
        static_bounds=(10, 200),
        horizon=steps,
        dynamics=rk4(ode, s, u, time / steps),
        terminal_cost=-s[0],
        action_bounds=(0, 1.4),
        state_bounds=([0, -np.inf, 0, -np.inf], np.inf),
        terminal_equality=s[1:] - ca.vertcat(900, 13.23, -1.288),
    )
    start = [0, 1000, 13.23, -1.288]
    guess = Trajectory(np.linspace([*start, 100], [1250, 900, 13.23, -1.288, 100], steps + 1), np.full((steps, 1), 0.7))
    return Instance(problem, np.array(start), guess, sign=-1.0)


def least_energy(steps: int) -> Instance:
    """min 1/2 int u^2 of a mass that moves by 1 from rest to rest in unit time: 6."""
    s, u, h = ca.SX.sym("s", 2), ca.SX.sym("u"), 1 / steps
    problem = OCP.from_expressions(
        state=s,
        action=u,
        horizon=steps,
        dynamics=ca.vertcat(s[0] + h * s[1] + h**2 / 2 * u, s[1] + h * u),
        stage_cost=h / 2 * u**2,
        terminal_equality=s - ca.vertcat(1, 0),
    )
    return Instance(problem, np.zeros(2))


CLASSICS = [
    Reference("linear-quadratic", "closed form", np.tanh(1) / 2, 1e-4, 100, linear_quadratic),
    Reference("Bryson-Denham", "Bryson and Denham (1962)", 4.0, 2e-3, 120, bryson_denham),
    Reference("double integrator, minimum time", "closed form", 2.0, 1e-7, 40, minimum_time),
    Reference("moon lander", "Meditch (1964)", 8.2462, 2e-4, 200, moon_lander),
    Reference("brachistochrone", "Bernoulli (1696)", 0.82434, 1e-4, 100, brachistochrone),
    Reference("particle steering", "COPS 3", 0.554577, 1e-4, 100, particle_steering),
    Reference("Goddard rocket", "COPS 3", 1.01283, 1e-5, 200, goddard),
    Reference("robot arm", "COPS 3", 9.14138, 1e-3, 200, robot_arm),
    Reference("free-flying robot", "Betts, Practical Methods (2010)", 7.9101902, 2e-3, 200, free_flying_robot),
    Reference("glider", "COPS 3", 1248.03, 1e-4, 200, glider),
    Reference("least energy", "closed form", 6.0, 2e-4, 100, least_energy),
    Reference("hanging chain", "COPS 3", 5.06891, 1e-3, 200, hanging_chain),
]
