"""Discrete dynamics of differential equations: against scipy, orders, implicit equations, derivatives."""

import pickle

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from kpirl_ocp import OCP, Ipopt, Riccati, Status, discretise

S, U, P = ca.MX.sym("s", 2), ca.MX.sym("u"), ca.MX.sym("p")
PENDULUM = ca.vertcat(S[1], U - P * ca.sin(S[0]) - 0.1 * S[1])
START, FORCE, GRAVITY, STEP = np.array([1.0, 0.2]), 0.3, 2.0, 0.5
ORDERS = {"rk4": 4, "midpoint": 2, "collocation": 5}


def exact(step=STEP):
    def slope(_, s):
        return [s[1], FORCE - GRAVITY * np.sin(s[0]) - 0.1 * s[1]]

    return solve_ivp(slope, (0, step), START, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]


def stepped(method, **options):
    f = ca.Function("f", [S, U, P], [discretise(PENDULUM, S, step=STEP, method=method, **options)])
    return np.array(f(START, FORCE, GRAVITY)).ravel()


@pytest.mark.parametrize("method", ORDERS)
def test_halving_the_intervals_divides_the_error_by_two_to_the_order(method):
    errors = [np.abs(stepped(method, intervals=n) - exact()).max() for n in (2, 4, 8)]
    rates = np.log2(np.divide(errors[:-1], errors[1:]))
    np.testing.assert_allclose(rates, ORDERS[method], rtol=0.15)


@pytest.mark.parametrize("method", ["cvodes", "idas"])
def test_adaptive_methods_are_exact_to_their_tolerance(method):
    np.testing.assert_allclose(stepped(method), exact(), rtol=0, atol=2e-9)


def test_midpoint_keeps_the_energy_of_an_oscillator():
    s = ca.MX.sym("s", 2)
    step = ca.Function("f", [s], [discretise(ca.vertcat(s[1], -s[0]), s, step=0.5, method="midpoint")])
    found = step.mapaccum(200)(np.array([1.0, 0.0]))
    np.testing.assert_allclose(np.sum(np.array(found) ** 2, axis=0), 1.0, rtol=1e-11)


@pytest.mark.parametrize("method", ["midpoint", "collocation", "idas"])
def test_an_implicit_equation_takes_the_steps_of_the_explicit_one(method):
    rate = ca.MX.sym("z", 2)
    mass = ca.vertcat(ca.horzcat(2.0, 0.5), ca.horzcat(0.5, 1.0 + S[0] ** 2))
    implicit = discretise(rate, S, step=STEP, method=method, algebraic=rate, residual=mass @ (rate - PENDULUM))
    found = np.array(ca.Function("f", [S, U, P], [implicit])(START, FORCE, GRAVITY)).ravel()
    np.testing.assert_allclose(found, stepped(method), rtol=0, atol=1e-9)


@pytest.mark.parametrize("method", ["midpoint", "collocation", "cvodes", "idas"])
def test_equations_that_cannot_be_written_in_scalars_take_the_same_steps(method):
    mass = ca.vertcat(ca.horzcat(2.0, 0.5), ca.horzcat(0.5, 1.0 + S[0] ** 2))
    ode = ca.solve(mass, mass @ PENDULUM)  # a node that CasADi factorises at run time
    with pytest.raises(RuntimeError):
        ca.Function("ode", [S, U, P], [ode]).expand()
    f = ca.Function("f", [S, U, P], [discretise(ode, S, step=STEP, method=method)])
    np.testing.assert_allclose(np.array(f(START, FORCE, GRAVITY)).ravel(), stepped(method), rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
def test_runge_kutta_is_the_textbook_formula_and_takes_an_expression_as_step(kind):
    s, q = kind.sym("s"), kind.sym("q")
    growth = ca.Function("f", [s, q], [discretise(q * s, s, step=2 * q)])
    h = 2 * 0.3 * 0.3
    assert float(growth(1.0, 0.3)) == pytest.approx(1 + h + h**2 / 2 + h**3 / 6 + h**4 / 24, rel=1e-15)


@pytest.mark.parametrize("method", ["rk4", "midpoint", "collocation", "cvodes", "idas"])
def test_first_and_second_derivatives_are_those_of_differences(method):
    after = discretise(PENDULUM, S, step=STEP, method=method, **({"intervals": 2} if method in ORDERS else {}))
    outputs = [after[0], ca.jacobian(after[0], P), ca.hessian(after[0], P)[0]]
    f = ca.Function("f", [S, U, P], outputs)
    (_, slope, curvature), h = (map(float, f(START, FORCE, GRAVITY))), 1e-3
    right, left = (list(map(float, f(START, FORCE, GRAVITY + sign * h))) for sign in (1, -1))
    np.testing.assert_allclose(slope, (right[0] - left[0]) / (2 * h), rtol=0, atol=1e-7)
    np.testing.assert_allclose(curvature, (right[1] - left[1]) / (2 * h), rtol=0, atol=1e-6)


@pytest.mark.parametrize("method", ["rk4", "midpoint", "collocation", "cvodes", "idas"])
def test_problems_with_any_integrator_are_solved_differentiated_and_pickled(method):
    problem = OCP.from_expressions(
        state=S,
        action=U,
        parameters=P,
        dynamics=discretise(PENDULUM, S, step=0.2, method=method),
        stage_cost=0.1 * U**2 + ca.sumsqr(S),
        terminal_cost=10 * ca.sumsqr(S),
        horizon=8,
    )
    found, expected = (solver.solve(problem, [1.0, 0.0], [2.0]) for solver in (Riccati(1e-8), Ipopt(1e-8)))
    assert found.status is expected.status is Status.CONVERGED
    np.testing.assert_allclose(found.actions, expected.actions, rtol=0, atol=1e-6)
    copy = pickle.loads(pickle.dumps(problem))
    np.testing.assert_allclose(Ipopt(1e-8).solve(copy, [1.0, 0.0], [2.0]).actions, expected.actions, rtol=0, atol=1e-9)
