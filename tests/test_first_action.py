"""State-action values: the cost of the best plan that begins with a given action."""

import casadi as ca
import numpy as np
import pytest
from problems import iiwa, swing_up

from kpirl_ocp import OCP, Riccati
from kpirl_ocp.bridges.first_action import with_first_action
from kpirl_ocp.ocp.problem.statement.soft import Soft


def racer(horizon=6):
    """Everything at once: a schedule, a context, path and terminal equalities, a path constraint, soft constraints."""
    s, u, psi, c, d = (ca.SX.sym(name, n) for name, n in (("s", 2), ("u", 2), ("psi", 1), ("c", 1), ("d", 1)))
    return OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        context=c,
        stage=d,
        schedule=np.linspace(0, 1, horizon + 1)[:, None],
        horizon=horizon,
        dynamics=ca.vertcat(s[0] + 0.2 * s[1] + 0.02 * u[0], s[1] + 0.2 * u[0] * psi),
        stage_cost=(s[0] - c * d) ** 2 + 0.1 * ca.sumsqr(u),
        path_equality=u[1] - 0.1 * s[1],
        path_constraint=u[0] + s[1] - 4,
        terminal_equality=s[1] - 0.5,
        action_bounds=(-6.0, 6.0),
        soft=Soft(s[1] - 1.0, quadratic=10.0),
    )


def racing():
    return racer(), np.array([0.2, 0.1]), np.array([1.5]), np.array([1.0])


def case(name):
    """A problem, and an s_0, psi and context."""
    if name == "all":
        return racing()
    found = {"swing-up": swing_up, "iiwa": iiwa}[name]()
    return found.problem, found.demonstration.s0, found.psi, found.demonstration.context


@pytest.mark.parametrize("name", ["swing-up", "iiwa", "all"])
def test_a_plan_that_begins_with_the_best_action_is_the_best_plan(name):
    problem, s0, psi, context = case(name)
    best = Riccati().solve(problem, s0, psi, context).raise_if_failed()
    given = np.concatenate([context, best.actions[0, : problem.n_stated_actions]])
    again = Riccati().solve(with_first_action(problem), s0, psi, given, best.trajectory).raise_if_failed()
    assert again.objective == pytest.approx(best.objective, rel=1e-8)
    np.testing.assert_allclose(again.states, best.states, atol=1e-5)


@pytest.mark.parametrize("name", ["swing-up", "iiwa", "all"])
def test_another_first_action_is_taken_and_costs_more(name):
    problem, s0, psi, context = case(name)
    best = Riccati().solve(problem, s0, psi, context).raise_if_failed()
    first = best.actions[0, : problem.n_stated_actions].copy()
    first[0] -= 0.05 * (1 + abs(first[0]))
    other = Riccati().solve(with_first_action(problem), s0, psi, np.concatenate([context, first]), best.trajectory)
    assert other.raise_if_failed().objective > best.objective
    np.testing.assert_allclose(other.actions[0, : len(first)], first, atol=1e-9)


def test_the_value_of_a_first_action_is_its_cost_and_what_follows_by_the_principle_of_optimality():
    a, s0, psi = 7.0, np.array([0.4, 0.2]), np.array([1.3])  # outside the bounds, which do not count for it

    def problem(horizon):
        s, u, p = ca.SX.sym("s", 2), ca.SX.sym("u"), ca.SX.sym("p")
        return OCP.from_expressions(
            state=s, action=u, parameters=p, horizon=horizon, action_bounds=(-1, 1),
            dynamics=s + 0.1 * ca.vertcat(s[1], u - p * ca.sin(s[0])), stage_cost=ca.sumsqr(s) + p * u**2,
            terminal_cost=3 * ca.sumsqr(s),
        )  # fmt: skip

    found = Riccati().solve(with_first_action(problem(12)), s0, psi, [a]).raise_if_failed()
    following = s0 + 0.1 * np.array([s0[1], a - psi[0] * np.sin(s0[0])])
    rest = Riccati().solve(problem(11), following, psi).raise_if_failed()
    assert found.objective == pytest.approx(s0 @ s0 + psi[0] * a**2 + rest.objective, rel=1e-9)
