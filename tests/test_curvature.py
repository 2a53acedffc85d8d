"""The Hessian of SQP's quadratic programs is exact where it is positive along the constraints, else weighted."""

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import null_space

from kpirl_ocp import OCP, SQP, Status
from kpirl_ocp.ocp.conditions.curvature import hessian
from kpirl_ocp.ocp.conditions.program import transcribe

STEPS = 6


def problem(on_state: float, on_action: float, **others) -> OCP:
    """s' = s + u / 2 + s^2 / 10 with weights on s^2 and u^2."""
    s, u = ca.SX.sym("s"), ca.SX.sym("u")
    dynamics, cost, end = s + u / 2 + s**2 / 10, on_state * s**2 + on_action * u**2, on_state * s**2
    return OCP.from_expressions(
        state=s, action=u, horizon=STEPS, dynamics=dynamics, stage_cost=cost, terminal_cost=end, **others
    )


def matrices(case: OCP, multiplier: float = 0.3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The Hessian that the program gets, the exact one, and the Jacobian of the rows with s_0 held."""
    program = transcribe(case)
    w, psi, context = program.symbols
    at, known = np.linspace(-0.5, 0.5, w.numel()), np.full(program.rows.numel(), multiplier)
    multipliers = ca.MX.sym("multipliers", known.size)
    lagrangian = program.values(*program.symbols)[0] + ca.dot(multipliers, program.rows)
    outputs = [ca.hessian(lagrangian, w)[0], ca.jacobian(program.rows, w)]
    exact, rows = ca.Function("exact", [w, psi, context, multipliers], outputs)(at, [], [], known)
    got = hessian(case)(at, [], 1, known)
    held = np.eye(w.numel())[:1]
    return got.full(), exact.full(), np.vstack([rows.full(), held])


def smallest(matrix: np.ndarray, rows: np.ndarray) -> float:
    basis = null_space(rows)
    return float(np.linalg.eigvalsh(basis.T @ matrix @ basis).min())


@pytest.mark.parametrize(("on_state", "on_action"), [(1.0, 1.0), (-0.02, 1.0), (3.0, -0.1)])
def test_a_hessian_that_is_positive_along_the_dynamics_stays_as_it_is(on_state, on_action):
    got, exact, rows = matrices(problem(on_state, on_action))
    assert smallest(exact, rows) > 0
    np.testing.assert_array_equal(got, exact)


@pytest.mark.parametrize(("on_state", "on_action"), [(-1.0, 0.1), (1.0, -5.0), (0.0, -1e-3)])
def test_another_gets_the_least_power_of_ten_that_makes_it_positive(on_state, on_action):
    got, exact, rows = matrices(problem(on_state, on_action))
    weight = got[-1, -1] - exact[-1, -1]
    added = np.diag(np.repeat([0.0, weight], [STEPS + 1, STEPS]))
    np.testing.assert_allclose(got, exact + added, rtol=0, atol=1e-12 * weight)
    assert np.log10(weight / 2) == pytest.approx(round(np.log10(weight / 2)), abs=1e-9)
    assert smallest(got, rows) > 0
    assert smallest(exact + added / 2, rows) > 0
    assert smallest(exact + added / 20, rows) < 0


def test_curvature_is_asked_for_along_terminal_equalities_too():
    s = ca.SX.sym("s")
    case = OCP.from_expressions(
        state=s, action=(u := ca.SX.sym("u")), horizon=1, dynamics=s + u, stage_cost=-(u**2), terminal_equality=s
    )
    got, exact, _ = matrices(case)
    np.testing.assert_array_equal(got, exact)


def test_a_concave_cost_ends_at_a_bound():
    case = problem(0.0, -1.0, action_bounds=(-1, 2))
    plan = SQP().solve(case, [0.0], guess=case.simulate([0.0], np.full((STEPS, 1), 0.1)))
    assert plan.status is Status.CONVERGED
    assert np.isin(plan.actions.round(9), (-1, 2)).all()
