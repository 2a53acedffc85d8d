"""Coefficients that change fast with psi are found as the definition says, most of them without being evaluated."""

import casadi as ca
import numpy as np
import pytest

from kpirl_ocp import OCP, Ipopt
from kpirl_ocp.irl.hypergradients.unrolled_slopes import STEP, direction
from kpirl_ocp.ocp.conditions.steepness import _end_coefficients, _stage_coefficients, nearly_constant_in_psi
from kpirl_ocp.ocp.models import RBF, KeypointCost, TimeDependent

S, U, P, C, D = (ca.SX.sym(name, size) for name, size in zip("supcd", (2, 1, 4, 1, 3), strict=True))
SCHEDULE = np.array([[1.0, 0.3, 0], [0, 1, 0.2], [0.5, 0, 1], [0.1, 1, 1]])
EVEN = [1.3, -0.4, 2.0, 0.7]
MOVES = (P[0] - EVEN[0]) / (STEP * direction(np.array(EVEN))[0])  # of psi_0: 1 and -1 to both sides


def problem_of(weight=1.0, end=1.0, gain=1.0, other=P[3]):
    """A problem with weights of the state on the way and at the end, and with a gain of the action."""
    cost = weight * (S[0] - C) ** 2 + other * S[1] ** 2 + U**2
    return OCP.from_expressions(
        state=S,
        action=U,
        parameters=P,
        context=C,
        schedule=SCHEDULE,
        stage=D,
        dynamics=ca.vertcat(S[0] + 0.1 * S[1], S[1] + gain * U),
        stage_cost=cost,
        terminal_cost=end * ca.sumsqr(S),
        horizon=3,
    )


CASES = {  # problem; psi
    "weights as they are": (problem_of(P[0], P[1]), EVEN),
    "a weight of zero": (problem_of(P[0], P[1]), [0.0, -0.4, 2.0, 0.7]),
    "a light weight": (problem_of(P[0], P[1]), [1e-5, -0.4, 2.0, 0.7]),
    "a weight that vanishes beside the others": (problem_of(P[0], P[1]), [1e-8, -0.4, 2.0, 0.7]),
    "all weights zero": (problem_of(P[0], P[1]), [0.0] * 4),
    "weights by the schedule": (problem_of(ca.dot(P[:3], D)), EVEN),
    "sums that cancel": (problem_of(P[0] - P[1]), [1.3, 1.3 - 1e-9, 2.0, 0.7]),
    "sums that nearly cancel": (problem_of(P[0] - P[1]), [1.3, 1.31, 2.0, 0.7]),
    "a difference from a number": (problem_of(P[0] - 1.3), [1.3 + 1e-5, -0.4, 2.0, 0.7]),
    "a product of weights": (problem_of(P[0] * P[1]), EVEN),
    "a product with the context": (problem_of(P[0] * C), EVEN),
    "a steep polynomial": (problem_of((1e6 * (P[0] - 1.3) + 1) ** 2 + 1), EVEN),
    "steep at the end": (problem_of(1, 1e6 * (P[0] - 1.3)), [1.3 + 1e-7, -0.4, 2.0, 0.7]),
    "steep to the left alone": (problem_of(MOVES**2 - MOVES + 1), EVEN),
    "steep to the right alone": (problem_of(MOVES**2 + MOVES + 1), EVEN),
    "a steep gain": (problem_of(gain=1e6 * (P[0] - 1.3)), [1.3 + 1e-7, -0.4, 2.0, 0.7]),
    "weights that are no parameters": (problem_of(), [0.0, 0.0, 0.0, 1.0]),
    "no weights, and a parameter of zero": (problem_of(other=1), [0.0, -0.4, 2.0, 0.7]),
    "a square of a weight alone": (problem_of(other=1, end=P[0] ** 2), [0.0, -0.4, 2.0, 0.7]),
    "a gain": (problem_of(gain=P[0]), EVEN),
}


def changes_little(problem, plan, move):
    """By the definition, from derivatives of CasADi's at psi and to both sides."""
    stages = [(problem.stage_cost, problem.dynamics, t) for t in range(problem.horizon)]
    found = [_largest(problem, plan, move, stages), _largest(problem, plan, move, [(problem.terminal_cost, None, -1)])]
    return all((change <= 1e-3 * value).all() for change, value in found)


def _largest(problem, plan, move, stages):
    values, changes = [], []
    for cost, dynamics, t in stages:
        at, *beside = (_entries(problem, plan, plan.psi + sign * move, cost, dynamics, t) for sign in (0, 1, -1))
        values.append(np.abs(at))
        changes.append(np.abs(np.array(beside) - at).max(axis=0))
    return np.max(changes, axis=0), np.max(values, axis=0)


def _entries(problem, plan, psi, cost, dynamics, t):
    given = [ca.SX.sym("x", *cost.size_in(i)) for i in range(cost.n_in())]
    unknowns = ca.veccat(*given[:-2])
    listed = [ca.hessian(cost(*given), unknowns)[0]]
    listed += [] if dynamics is None else [ca.jacobian(dynamics(*given), unknowns)]
    values = ca.Function("values", given, [ca.veccat(*(ca.densify(matrix) for matrix in listed))])
    trajectory = [plan.states[t]] if dynamics is None else [plan.states[t], plan.actions[t]]
    return values(*trajectory, psi, plan.context, problem.schedule[t]).full().ravel()


@pytest.mark.parametrize("case", CASES)
def test_coefficients_hardly_change_where_they_do_not_by_the_definition(case, monkeypatch):
    problem, psi = CASES[case]
    monkeypatch.setattr("kpirl_ocp.ocp.conditions.steepness.compiled", lambda function: function)
    plan = Plan(problem, np.array(psi))
    move = STEP * direction(plan.psi)
    assert nearly_constant_in_psi(problem, plan, move) == changes_little(problem, plan, move)


class Plan:
    """A random one; what is asked for does not depend on its optimality."""

    def __init__(self, problem, psi):
        rng = np.random.default_rng(1)
        self.states, self.actions = (rng.normal(size=(n, m)) for n, m in ((4, 2), (3, 1)))
        self.psi, self.context, self.objective = psi, np.array([0.3]), 0.0


def test_a_plan_that_is_not_finite_shows_nothing():
    problem, psi = CASES["weights as they are"]
    plan = Plan(problem, np.array(psi))
    assert nearly_constant_in_psi(problem, plan, STEP * direction(plan.psi))
    plan.objective = np.nan
    assert not nearly_constant_in_psi(problem, plan, STEP * direction(plan.psi))


@pytest.mark.parametrize("case", ["weights as they are", "weights by the schedule", "a difference from a number"])
def test_weights_of_squares_are_not_evaluated_beside_psi(case):
    problem, _ = CASES[case]
    assert [listed(problem).rest for listed in (_stage_coefficients, _end_coefficients)] == [[], []]


@pytest.mark.parametrize("basis", [TimeDependent(), RBF(2)])
def test_the_paper_s_weights_are_not_evaluated_beside_psi(basis):
    cost, z, u, goal = KeypointCost(basis, effort=0.1, learn_effort=True), *(ca.SX.sym("x", 2) for _ in range(3))
    psi, stage = ca.SX.sym("psi", cost.n_parameters(4, 2)), ca.SX.sym("d", cost.schedule(4).shape[1])
    value = cost.stage_cost(z, u, psi, goal, stage)
    problem = OCP.from_expressions(
        state=z,
        action=u,
        parameters=psi,
        context=goal,
        stage=stage,
        schedule=cost.schedule(4),
        dynamics=z + u,
        stage_cost=value,
        terminal_cost=ca.substitute(value, u, 0 * u),
        horizon=4,
    )
    assert [listed(problem).rest for listed in (_stage_coefficients, _end_coefficients)] == [[], []]
    plan = Ipopt().solve(problem, [0.0, 1.0], cost.initial(4, 2), [1.0, 0.5])
    assert nearly_constant_in_psi(problem, plan, STEP * direction(plan.psi))
