"""More problems: robots, vehicles, control on a moving horizon and estimation; psi are numbers to be learned again."""

from __future__ import annotations

from itertools import pairwise

import casadi as ca
import numpy as np

from kpirl_ocp import OCP, Trajectory

from .problems import Instance, Ode, Reference, line, rk4


def with_cost(ode: Ode, cost: Ode, s: ca.SX, u: ca.SX, step: ca.SX | float) -> tuple[ca.SX, ca.SX]:
    """The state after a step of Runge-Kutta, and the integral of the cost along it by the same method."""
    after = rk4(lambda x, u: ca.vertcat(ode(x[:-1], u), cost(x[:-1], u)), ca.vertcat(s, 0), u, step)
    return after[:-1], after[-1]


def van_der_pol(steps: int) -> Instance:
    """Bocop: min 1/2 int x^2 + v^2 + u^2 from (1, 0) over two units of time: 1.047921. psi is the damping."""
    s, u, psi, h = ca.SX.sym("s", 2), ca.SX.sym("u"), ca.SX.sym("psi"), 2 / steps
    ode = lambda s, u: ca.vertcat(s[1], psi * (1 - s[0] ** 2) * s[1] - s[0] + u)  # noqa: E731
    after, cost = with_cost(ode, lambda s, u: (ca.sumsqr(s) + u**2) / 2, s, u, h)
    problem = OCP.from_expressions(state=s, action=u, parameters=psi, horizon=steps, dynamics=after, stage_cost=cost)
    return Instance(problem, np.array([1.0, 0.0]), psi=np.ones(1))


def hypersensitive(steps: int) -> Instance:
    """Bocop: min 1/2 int x^2 + u^2 with x' = -x^3 + u, from 1 to 3/2 in 10: 3.36206. Steps are short at the end."""
    s, u, h = ca.SX.sym("s"), ca.SX.sym("u"), ca.SX.sym("h")
    after, cost = with_cost(lambda s, u: u - s**3, lambda s, u: (s**2 + u**2) / 2, s, u, h)
    times = 10 * np.tanh(3 * np.linspace(0, 1, steps + 1)) / np.tanh(3)
    problem = OCP.from_expressions(
        state=s,
        action=u,
        stage=h,
        schedule=np.append(np.diff(times), 0)[:, None],
        horizon=steps,
        dynamics=after,
        stage_cost=cost,
        terminal_equality=s - 1.5,
    )
    return Instance(problem, np.ones(1), line([1], [1.5], steps, 1))


def cart_pole(steps: int) -> Instance:
    """Kelly (2017): a pole swings up within 2 s, least int u^2. psi = (mass of the pole, its length)."""
    s, u, psi, h = ca.SX.sym("s", 4), ca.SX.sym("u"), ca.SX.sym("psi", 2), 2 / steps

    def ode(s: ca.SX, u: ca.SX) -> ca.SX:
        sine, cosine, mass, length = ca.sin(s[1]), ca.cos(s[1]), psi[0], psi[1]
        total = 1 + mass * sine**2
        cart = (length * mass * sine * s[3] ** 2 + u + mass * 9.81 * cosine * sine) / total
        pole = -(length * mass * cosine * sine * s[3] ** 2 + u * cosine + (1 + mass) * 9.81 * sine) / (length * total)
        return ca.vertcat(s[2:], cart, pole)

    problem = OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        horizon=steps,
        dynamics=rk4(ode, s, u, h),
        stage_cost=h * u**2,
        action_bounds=(-20, 20),
        state_bounds=([-2, *[-np.inf] * 3], [2, *[np.inf] * 3]),
        terminal_equality=s - ca.vertcat(1, np.pi, 0, 0),
    )
    return Instance(problem, np.zeros(4), line([0] * 4, [1, np.pi, 0, 0], steps, 1), psi=np.array([0.3, 0.5]))


def quadrotor(steps: int) -> Instance:
    """A planar quadrotor flies between two discs, at rest to rest. psi = (weight of the turn, radius of the discs)."""
    s, u, psi, h = ca.SX.sym("s", 6), ca.SX.sym("u", 2), ca.SX.sym("psi", 2), 2.5 / steps

    def ode(s: ca.SX, u: ca.SX) -> ca.SX:
        lift = u[0] + u[1]
        return ca.vertcat(s[3:], -lift * ca.sin(s[2]), lift * ca.cos(s[2]) - 9.81, 4 * (u[0] - u[1]))

    discs = [psi[1] ** 2 - ca.sumsqr(s[:2] - ca.vertcat(*centre)) for centre in ([0.8, 0.3], [1.8, -0.05])]
    problem = OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        horizon=steps,
        dynamics=rk4(ode, s, u, h),
        stage_cost=h * (ca.sumsqr(u - 9.81 / 2) + psi[0] * s[5] ** 2),
        action_bounds=(0, 10),
        path_constraint=ca.vertcat(*discs),
        terminal_equality=s - ca.vertcat(2.6, 0.2, 0, 0, 0, 0),
    )
    guess = line([0] * 6, [2.6, 0.2, 0, 0, 0, 0], steps, 2)
    guess.states[:, 1] -= 0.3 * np.sin(np.linspace(0, 2 * np.pi, steps + 1))  # below the first, above the second
    return Instance(problem, np.zeros(6), Trajectory(guess.states, guess.actions + 9.81 / 2), psi=np.array([0.2, 0.25]))


def unicycle(steps: int) -> Instance:
    """A car that turns on the spot parks one to the side. psi = (weight of the speed, weight of the turning)."""
    s, u, psi, h = ca.SX.sym("s", 3), ca.SX.sym("u", 2), ca.SX.sym("psi", 2), 3 / steps
    ode = lambda s, u: ca.vertcat(u[0] * ca.cos(s[2]), u[0] * ca.sin(s[2]), u[1])  # noqa: E731
    problem = OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        horizon=steps,
        dynamics=rk4(ode, s, u, h),
        stage_cost=h * (psi[0] * u[0] ** 2 + psi[1] * u[1] ** 2 + ca.sumsqr(s[:2])),
        action_bounds=(-1.5, 1.5),
        terminal_equality=s,
    )
    guess = Trajectory(np.linspace([0.5, 1.0, 0.8], [0, 0, 0], steps + 1), np.full((steps, 2), -0.3))
    return Instance(problem, np.array([0.5, 1.0, 0.0]), guess, psi=np.array([1.0, 0.5]))


def chain_of_masses(steps: int) -> Instance:
    """Two masses hang on springs between a wall and an end that is steered to rest. psi = (stiffness, effort)."""
    s, u, psi, h = ca.SX.sym("s", 10), ca.SX.sym("u", 2), ca.SX.sym("psi", 2), 2 / steps  # masses, their speeds, end

    def ode(s: ca.SX, u: ca.SX) -> ca.SX:
        springs = [other - one for one, other in pairwise([ca.SX.zeros(2), s[:2], s[2:4], s[8:]])]
        pulls = [psi[0] * (1 - 0.3 / ca.sqrt(ca.sumsqr(x) + 1e-4)) * x for x in springs]
        falls = [(after - before) / 0.1 - ca.vertcat(0, 9.81) for before, after in pairwise(pulls)]
        return ca.vertcat(s[4:8], *falls, u)

    problem = OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        horizon=steps,
        dynamics=rk4(ode, s, u, h),
        stage_cost=h * (25 * ca.sumsqr(s[8:] - ca.vertcat(1, 0)) + ca.sumsqr(s[4:8]) + psi[1] * ca.sumsqr(u)),
        terminal_cost=10 * ca.sumsqr(s[4:8]),
        action_bounds=(-1, 1),
        state_bounds=([*[-np.inf] * 8, -np.inf, -0.2], np.inf),
    )
    start = np.array([0.3, -0.2, 0.6, -0.1, 0, 0, 0, 0, 0.8, 0.4])
    return Instance(problem, start, psi=np.array([10.0, 0.5]))


def rocket_landing(steps: int) -> Instance:
    """A rocket that burns its mass lands within a cone, with bounded thrust and angle. psi = (burn rate, cone)."""
    s, u, psi, h = ca.SX.sym("s", 5), ca.SX.sym("u", 2), ca.SX.sym("psi", 2), 8 / steps
    thrust = lambda u: ca.sqrt(ca.sumsqr(u) + 1e-6)  # noqa: E731
    ode = lambda s, u: ca.vertcat(s[2:4], u[0] / s[4], u[1] / s[4] - 1.0, -psi[0] * thrust(u))  # noqa: E731
    cone = ca.vertcat(psi[1] * s[0], -psi[1] * s[0]) - s[1] - 0.01
    problem = OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        horizon=steps,
        dynamics=rk4(ode, s, u, h),
        stage_cost=h * ca.sumsqr(u),
        path_constraint=ca.vertcat(ca.sumsqr(u) - 9, u[0] - u[1], -u[0] - u[1], cone),
        state_bounds=([*[-np.inf] * 4, 1], np.inf),
        terminal_equality=s[:4],
    )
    start = np.array([5.0, 8.0, 0.5, -1.5, 2.0])
    guess = Trajectory(np.linspace(start, [0, 0, 0, 0, 1.6], steps + 1), np.tile([0.0, 1.5], (steps, 1)))
    return Instance(problem, start, guess, psi=np.array([0.03, 1.0]))


def reaching(steps: int) -> Instance:
    """A planar arm of two links reaches a point, at rest, with least effort and change. psi = (mass, goal's height)."""
    s, u, psi, h = ca.SX.sym("s", 4), ca.SX.sym("u", 2), ca.SX.sym("psi", 2), 1 / steps

    def ode(s: ca.SX, u: ca.SX) -> ca.SX:
        third, c, sine = psi[0] / 3, psi[0] * ca.cos(s[1]) / 2, psi[0] * ca.sin(s[1]) / 2
        mass = ca.vertcat(ca.horzcat(5 * third + 2 * c, third + c), ca.horzcat(third + c, third))
        return ca.vertcat(s[2:], ca.solve(mass, u + sine * ca.vertcat(s[3] * (2 * s[2] + s[3]), -(s[2] ** 2))))

    hand = ca.vertcat(ca.cos(s[0]) + ca.cos(s[0] + s[1]), ca.sin(s[0]) + ca.sin(s[0] + s[1]))
    problem = OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        horizon=steps,
        dynamics=rk4(ode, s, u, h),
        stage_cost=h * (ca.sumsqr(u) + ca.sumsqr(s[2:])),
        action_bounds=(-12, 12),
        terminal_equality=ca.vertcat(hand - ca.vertcat(0.6, psi[1]), s[2:]),
    )
    return Instance(problem, np.array([0.2, 0.5, 0.0, 0.0]), psi=np.array([1.0, 1.2]))


def rate_limited(steps: int) -> Instance:
    """Linear-quadratic control of an unstable plant with a bounded action and rate. psi = (weight of x, rate)."""
    s, u, psi = ca.SX.sym("s", 3), ca.SX.sym("u"), ca.SX.sym("psi", 2)  # the last state is the action before
    problem = OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        horizon=steps,
        dynamics=ca.vertcat(1.1 * s[0] + 0.2 * s[1], 0.95 * s[1] + 0.5 * u, u),
        stage_cost=psi[0] * s[0] ** 2 + 0.1 * u**2,
        terminal_cost=10 * ca.sumsqr(s[:2]),
        action_bounds=(-1, 1),
        path_constraint=ca.vertcat(u - s[2] - psi[1], s[2] - u - psi[1]),
    )
    return Instance(problem, np.array([1.0, 0.2, 0.3]), psi=np.array([1.0, 0.3]))


def moving_horizon(steps: int) -> Instance:
    """The states of a pendulum and what pushed it, from noisy angles. psi = (weight of the push, of the arrival)."""
    s, w, y, psi = ca.SX.sym("s", 2), ca.SX.sym("w"), ca.SX.sym("y"), ca.SX.sym("psi", 2)
    times = 0.1 * np.arange(steps + 1)
    seen = np.column_stack([0.8 * np.cos(3 * times) + 0.05 * np.sin(40 * times), np.arange(steps + 1) == 0])
    first = ca.SX.sym("first")
    arrival = first * ca.sumsqr(s - ca.vertcat(0.7, 0.1))
    ode = lambda s, w: ca.vertcat(s[1], w - 9.81 * ca.sin(s[0]))  # noqa: E731
    problem = OCP.from_expressions(
        state=s,
        action=w,
        parameters=psi,
        stage=ca.vertcat(y, first),
        schedule=seen,
        horizon=steps,
        dynamics=rk4(ode, s, w, 0.1),
        stage_cost=(s[0] - y) ** 2 + psi[0] * w**2 + psi[1] * arrival,
        terminal_cost=(s[0] - y) ** 2,
        initial_bounds=(-3, 3),
        action_bounds=(-1, 1),
    )
    return Instance(problem, np.zeros(2), psi=np.array([0.01, 0.5]))


def limit_cycle(steps: int) -> Instance:
    """The period of van der Pol's oscillator, from a crossing of v = 0 to the next but one: 6.663287. No actions."""
    s, q, d = ca.SX.sym("s", 2), ca.SX.sym("q", 2), ca.SX.sym("d")  # q = (period, amplitude)
    ode = lambda s, _: ca.vertcat(s[1], (1 - s[0] ** 2) * s[1] - s[0])  # noqa: E731
    problem = OCP.from_expressions(
        state=s,
        static=q,
        static_bounds=([5, 1.5], [8, 3]),
        stage=d,
        schedule=np.arange(steps + 1)[:, None] == 0,
        horizon=steps,
        dynamics=rk4(ode, s, q, q[0] / steps),
        terminal_cost=q[0],
        initial_bounds=([0, 0], [4, 0]),
        path_equality=d * (s[0] - q[1]),
        terminal_equality=s - ca.vertcat(q[1], 0),
    )
    angle = np.linspace(0, 2 * np.pi, steps + 1)
    circle = np.column_stack([2 * np.cos(angle), -2 * np.sin(angle), *np.tile([[6.5], [2.0]], steps + 1)])
    return Instance(problem, np.array([2.0, 0.0]), Trajectory(circle, np.zeros((steps, 0))))


def mass_identified(steps: int) -> Instance:
    """1/m of a mass pushed by known forces, least squares of positions with their ripple: 0.2 is 1/m of the data."""
    s, q, d, psi = ca.SX.sym("s", 2), ca.SX.sym("q"), ca.SX.sym("d", 2), ca.SX.sym("psi")
    times, h = np.arange(steps + 1) * 0.1, 0.1
    force, place = np.sin(2 * times), [np.zeros(2)]
    for t in range(steps):
        x, v = place[-1]
        place.append(np.array([x + h * v + h**2 / 2 * 0.2 * force[t], v + h * 0.2 * force[t]]))
    off = (s[0] - d[1]) ** 2 + 0.1 * psi * (q - 1) ** 2 / (steps + 1)
    problem = OCP.from_expressions(
        state=s,
        parameters=psi,
        static=q,
        static_bounds=(0.01, 10),
        stage=d,
        schedule=np.column_stack([force, np.array(place)[:, 0] + 0.01 * np.cos(9 * times)]),
        horizon=steps,
        dynamics=ca.vertcat(s[0] + h * s[1] + h**2 / 2 * q * d[0], s[1] + h * q * d[0]),
        stage_cost=off,
        terminal_cost=off,
        initial_bounds=(-1, 1),
    )
    return Instance(problem, np.zeros(2), psi=np.ones(1))


MORE = [
    Reference("van der Pol", "Bocop", 1.047921, 2e-4, 100, van_der_pol),
    Reference("hypersensitive", "Bocop", 3.36206, 1e-4, 200, hypersensitive),
    Reference("cart-pole swing-up", "Kelly (2017); Dymos", 58.83925, 1e-3, 100, cart_pole),
    Reference("limit cycle", "van der Pol's oscillator", 6.6632868593, 1e-5, 100, limit_cycle),
    Reference("quadrotor, two obstacles", "-", None, 0.0, 40, quadrotor),
    Reference("unicycle, parking", "-", None, 0.0, 40, unicycle),
    Reference("chain of masses", "after Wirsching et al. (2006)", None, 0.0, 40, chain_of_masses),
    Reference("rocket landing in a cone", "after Acikmese and Ploen (2007)", None, 0.0, 40, rocket_landing),
    Reference("2R arm, reaching", "-", None, 0.0, 30, reaching),
    Reference("rate-limited MPC", "-", None, 0.0, 30, rate_limited),
    Reference("moving-horizon estimate", "-", None, 0.0, 40, moving_horizon),
    Reference("mass identified", "-", None, 0.0, 40, mass_identified),
]
