"""Plans of differential equations by every method, against Opti with the equations of the method as constraints."""

from functools import lru_cache

import casadi as ca
import numpy as np
import pytest
from statements import OWN, REST, Case, S, U, learned
from statements_opti import DT, T, cost, given, last_cost, optimum

from kpirl_ocp import SQP, Demonstration, Fatrop, FiniteDifference, Implicit, Ipopt, Riccati, Status, discretise
from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.export import export_c

RADAU = np.array(  # IIA of order 5: Hairer and Wanner, Solving Ordinary Differential Equations II, table IV.5.6
    [
        [(88 - 7 * 6**0.5) / 360, (296 - 169 * 6**0.5) / 1800, (-2 + 3 * 6**0.5) / 225],
        [(296 + 169 * 6**0.5) / 1800, (88 + 7 * 6**0.5) / 360, (-2 - 3 * 6**0.5) / 225],
        [(16 - 6**0.5) / 36, (16 + 6**0.5) / 36, 1 / 9],
    ]
)
RATE = ca.MX.sym("a")
HEAVY = 1 + 0.3 * S[0] ** 2  # mass, which changes with the position
FORCES = U - ca.sin(S[0]) - OWN * S[1]


def slope(s, u):
    """A damped pendulum; psi[1] is the damping."""
    return ca.vertcat(s[1], u - ca.sin(s[0]) - 0.4 * s[1])


def heavy_slope(s, u):
    return ca.vertcat(s[1], slope(s, u)[1] / (1 + 0.3 * s[0] ** 2))


def collocated(opti, s, u, after, slope, table):
    """A step of the collocation method with the Butcher matrix `table`: midpoint (1, 1) or Radau (3, 3)."""
    stages = opti.variable(2, len(table))
    opti.set_initial(stages, ca.repmat(ca.DM([0.1, 0.0]), 1, len(table)))
    rates = ca.horzcat(*(slope(stages[:, i], u) for i in range(len(table))))
    opti.subject_to(ca.vec(stages - ca.repmat(s, 1, len(table)) - DT * rates @ table.T) == 0)
    weights = table[-1] if len(table) > 1 else np.ones(1)
    opti.subject_to(after == s + DT * rates @ weights)


def fine(opti, s, u, after, slope, parts):
    """So many steps of the classical Runge-Kutta method."""
    h = DT / parts
    for _ in range(parts):
        a = slope(s, u)
        b = slope(s + h / 2 * a, u)
        c = slope(s + h / 2 * b, u)
        s = s + h / 6 * (a + 2 * b + 2 * c + slope(s + h * c, u))
    opti.subject_to(after == s)


def stated(step, slope, how):
    def build(opti, X, U):
        given(opti, X)
        for t in range(T):
            step(opti, X[:, t], U[:, t], X[:, t + 1], slope, how)
        return sum(cost(X[:, t], U[:, t]) for t in range(T)) + last_cost(X[:, T])

    return build


EXPLICIT = {"ode": ca.vertcat(S[1], FORCES)}
IMPLICIT = {"ode": ca.vertcat(S[1], RATE), "algebraic": RATE, "residual": HEAVY * RATE - FORCES}
SOLVERS = [Riccati(1e-8), Ipopt(1e-8), Fatrop(), SQP()]
MIDPOINT = np.array([[0.5]])
CASES = {
    "rk4": (EXPLICIT, {"method": "rk4", "intervals": 2}, stated(fine, slope, 2)),
    "midpoint": (EXPLICIT, {"method": "midpoint"}, stated(collocated, slope, MIDPOINT)),
    "collocation": (EXPLICIT, {"method": "collocation"}, stated(collocated, slope, RADAU)),
    "cvodes": (EXPLICIT, {"method": "cvodes"}, stated(fine, slope, 20)),
    "implicit, midpoint": (IMPLICIT, {"method": "midpoint"}, stated(collocated, heavy_slope, MIDPOINT)),
    "implicit, collocation": (IMPLICIT, {"method": "collocation"}, stated(collocated, heavy_slope, RADAU)),
    "implicit, idas": (IMPLICIT, {"method": "idas"}, stated(fine, heavy_slope, 20)),
}


@lru_cache
def case_of(name):
    equations, method, opti = CASES[name]
    dynamics = discretise(state=S, step=DT, **equations, **method)
    return Case(learned(dynamics=dynamics, action_bounds=(-1.5, 1.5)), REST, bounded(opti))


@lru_cache
def optimum_of(name):
    return optimum(case_of(name))


def bounded(build):
    def more(opti, X, U):
        opti.subject_to(opti.bounded(-1.5, U, 1.5))
        return build(opti, X, U)

    return more


@pytest.mark.parametrize(
    "solver", [Riccati(1e-8), Ipopt(1e-8), Fatrop(), SQP()], ids=lambda solver: type(solver).__name__
)
@pytest.mark.parametrize("name", CASES)
def test_a_plan_in_continuous_time_is_that_of_an_independent_statement(name, solver):
    problem, arguments, _ = case_of(name)
    objective, states, actions = optimum_of(name)
    found = solver.solve(problem, *arguments)
    assert found.status is Status.CONVERGED
    atol = 1e-5 if isinstance(solver, Fatrop) else 1e-7
    np.testing.assert_allclose(found.objective, objective, rtol=0, atol=atol)
    np.testing.assert_allclose(found.states, states, rtol=0, atol=10 * atol)
    np.testing.assert_allclose(found.actions, actions, rtol=0, atol=10 * atol)


@pytest.mark.parametrize("name", CASES)
def test_its_certified_gradient_is_that_of_differences(name):
    problem, (s0, psi), _ = case_of(name)
    times = np.linspace(0, 1, T + 1)
    seen = Demonstration(s0, [], np.column_stack([0.7 * times, np.sin(np.pi * times)]))
    implicit = Implicit(Riccati(1e-9))(problem, seen, psi)
    assert implicit.certificate.certified
    near = implicit.certificate.solution
    reference = FiniteDifference(Ipopt(1e-9), step=1e-3, policy="flag")(problem, seen, psi, near)
    np.testing.assert_allclose(implicit.gradient, reference.gradient, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", [name for name in CASES if name != "rk4"])
def test_steps_that_iterate_have_no_c_and_are_refused_by_name(name, tmp_path):
    with pytest.raises(ProblemError, match="no C for 'step'"):
        export_c(case_of(name).problem, Riccati(), tmp_path)
