"""The statements of `statements.py` once more, in CasADi's Opti.

Each is a function (opti, X, U) of the variables X (n_s, T+1), U (n_u, T) of the user's states and actions, and returns
the objective.
"""

import casadi as ca
import numpy as np

T, DT = 12, 0.2
GRID = np.geomspace(0.1, 0.3, T + 1)[:, None]
FORCE = np.linspace(3.0, 1.0, T)[:, None]
SPEED = np.column_stack([np.full(T + 1, np.inf), np.linspace(0.2, 0.5, T + 1)])
PHASE = 2 * np.pi * np.arange(T + 1) / T
MEASURED = np.cos(1.2 * DT * np.arange(T + 1))[:, None] + 0.01 * np.sin(7.0 * np.arange(T + 1))[:, None]
CAP = np.linspace(1.0, 0.7, T + 1)[:, None]


def pendulum(s, u, dt=DT, mass=1.0):
    """Semi-implicit Euler."""
    speed = s[1] + dt * (u / mass - ca.sin(s[0]))
    return ca.vertcat(s[0] + dt * speed, speed)


def cost(s, u, effort=0.05):
    return (s[0] - 1) ** 2 + 0.1 * s[1] ** 2 + effort * u**2


def last_cost(s):
    return 3 * (s[0] - 1) ** 2


def follow(opti, X, U, step=pendulum):
    """Constrain X to the dynamics; the objective of `PLAIN`."""
    opti.subject_to(ca.vec(X[:, 1:]) == ca.vertcat(*(step(X[:, t], U[:, t]) for t in range(T))))
    return sum(cost(X[:, t], U[:, t]) for t in range(T)) + last_cost(X[:, T])


def given(opti, X, value=(0.0, 0.0)):
    opti.subject_to(X[:, 0] == value)


def terminal_equality(opti, X, U):
    given(opti, X)
    opti.subject_to(X[:, T] == [0.6, 0.0])
    return follow(opti, X, U)


def path_equality(opti, X, U):
    given(opti, X)
    opti.subject_to(ca.vec(U[0, :] + 0.8 * X[1, :T] - 0.3 * ca.cos(X[0, :T])) == 0)
    return follow(opti, X, U)


def terminal_inequality(opti, X, U):
    given(opti, X)
    opti.subject_to(X[0, T] ** 2 + X[1, T] ** 2 <= 0.4)
    return follow(opti, X, U)


def disc(opti, X, U):
    """The last state keeps within the disc, too."""
    given(opti, X)
    for t in range(T + 1):
        opti.subject_to(X[0, t] ** 2 + X[1, t] ** 2 <= 0.5)
    return follow(opti, X, U)


def context_and_schedule(opti, X, U):
    given(opti, X)
    opti.subject_to(ca.vec(X[:, 1:]) == ca.vertcat(*(pendulum(X[:, t], U[:, t], GRID[t, 0], 1.7) for t in range(T))))
    return sum(GRID[t, 0] * cost(X[:, t], U[:, t]) for t in range(T)) + last_cost(X[:, T])


def bounds_per_stage(opti, X, U):
    given(opti, X)
    opti.subject_to(opti.bounded(-1, U[0, :], FORCE.T))
    opti.subject_to(ca.vec(X[1, 1:]) <= SPEED[1:, 1])
    return follow(opti, X, U)


def bounds_of_parameters(opti, X, U):
    """The bound on the speed does not count at the given s_0, where it does not hold."""
    given(opti, X, [0.0, 0.35])
    opti.subject_to(opti.bounded(-2 * 0.3, U[0, :], 4 * 0.3))
    opti.subject_to(ca.vec(X[1, 1:]) <= 0.3)
    opti.subject_to(ca.vec(X[0, 1:]) <= 2.0)
    return follow(opti, X, U)


def free_start(opti, X, U):
    opti.subject_to(opti.bounded([-0.5, -0.2], X[:, 0], [-0.1, 0.3]))
    return follow(opti, X, U)


def partly_free_start(opti, X, U):
    """The position is given, and the bounds of the speed are those of all states."""
    opti.subject_to(X[0, 0] == 0.1)
    opti.subject_to(ca.vec(X[1, :]) <= 0.4)
    return follow(opti, X, U)


def final_time(opti, X, U):
    """A double integrator from rest to rest, weighing time against effort."""
    q = opti.variable()
    opti.set_initial(q, 3)
    given(opti, X)
    opti.subject_to(X[:, T] == [1, 0])
    opti.subject_to(opti.bounded(-1, U, 1))
    opti.subject_to(opti.bounded(0.1, q, 10))
    step = q / T
    for t in range(T):
        x, v, u = X[0, t], X[1, t], U[0, t]
        opti.subject_to(X[:, t + 1] == ca.vertcat(x + step * v + step**2 / 2 * u, v + step * u))
    return q + 0.05 * ca.sumsqr(U)


def soft(opti, X, U):
    """A row on states alone holds softly at s_T, too; one with the action does not."""
    given(opti, X)
    h = ca.horzcat(X[0, :] - 0.5, U[0, :] - 1.5)
    slack = opti.variable(h.numel())
    opti.subject_to(slack >= 0)
    opti.subject_to(ca.vec(h) <= slack)
    linear = np.repeat([0.4, 0.02], [T + 1, T])
    quadratic = np.repeat([0.7, 1.0], [T + 1, T])
    return follow(opti, X, U) + ca.dot(linear, slack) + ca.dot(quadratic, slack**2) / 2


def periodic(opti, X, U):
    opti.subject_to(X[:, 0] == X[:, T])
    opti.subject_to(ca.vec(X[:, 1:]) == ca.vertcat(*(pendulum(X[:, t], U[:, t]) for t in range(T))))
    return sum((X[0, t] - np.sin(PHASE[t])) ** 2 + 0.05 * U[0, t] ** 2 for t in range(T))


def identification(opti, X, U):
    """No actions: the stiffness, which has a prior, and the first speed are found from measured positions."""
    q = opti.variable()
    opti.set_initial(q, 1.0)
    opti.subject_to(X[0, 0] == 1)
    opti.subject_to(opti.bounded(-1, X[1, 0], 1))
    opti.subject_to(opti.bounded(0.1, q, 5))
    opti.subject_to(ca.vec(X[:, 1:]) == ca.vertcat(*(runge_kutta(X[:, t], q) for t in range(T))))
    return ca.sumsqr(X[0, :] - MEASURED.T) + 0.4 * (q - 1) ** 2


def no_state_cost(opti, X, U):
    given(opti, X)
    follow(opti, X, U)
    opti.subject_to(X[0, T] == 1)
    return ca.sumsqr(U)


def trim(opti, X, U):
    """A constant force is found, for which the other may be larger; context and stage are in the bounds."""
    q = opti.variable()
    opti.set_initial(q, 1.55)
    given(opti, X)
    opti.subject_to(opti.bounded(0.1, q, 3))
    opti.subject_to(-0.6 * q <= ca.vec(U))
    opti.subject_to(ca.vec(U) <= CAP[:T] * q)
    opti.subject_to(ca.vec(X[1, 1:]) <= 0.6 * CAP[1:])
    opti.subject_to(ca.vec(X[0, 1:]) <= 2)
    return follow(opti, X, U, lambda s, u: pendulum(s, u + q)) + 0.4 * (q - 1) ** 2


def runge_kutta(s, q, dt=DT):
    """The classical method for an oscillator of stiffness q."""

    def slope(s):
        return ca.vertcat(s[1], -q * s[0])

    a = slope(s)
    b = slope(s + dt / 2 * a)
    c = slope(s + dt / 2 * b)
    return s + dt / 6 * (a + 2 * b + 2 * c + slope(s + dt * c))


def optimum(case):
    """Objective, states (T+1, n_s) and actions (T, n_u) by Opti with Ipopt, from the same start."""
    problem, (start, *_), build = case
    opti = ca.Opti()
    X = opti.variable(problem.n_stated_states, T + 1)
    U = opti.variable(problem.n_stated_actions, T) if problem.n_stated_actions else ca.MX(0, T)
    objective = build(opti, X, U)
    opti.minimize(objective)
    opti.set_initial(X, np.tile(np.array(start)[:, None], (1, T + 1)))
    settings = {"tol": 1e-12, "print_level": 0, "sb": "yes", "bound_relax_factor": 0.0, "nlp_scaling_method": "none"}
    opti.solver("ipopt", {"print_time": False}, settings)
    found = opti.solve()
    actions = np.array(found.value(U)).reshape(U.shape) if U.numel() else np.zeros((0, T))
    return float(found.value(objective)), np.array(found.value(X)).T, actions.T
