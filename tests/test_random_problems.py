"""Random nonlinear problems with random constraints and units: what is certified agrees with finite differences."""

import casadi as ca
import numpy as np
import pytest

from kpirl_ocp import OCP, Demonstration, FiniteDifference, Implicit, Ipopt, Riccati


def random_case(seed):
    """Up to three states, two actions and five steps; psi in cost, dynamics and path constraint; cost in odd units."""
    rng = np.random.default_rng(seed)
    n, m, steps = int(rng.integers(1, 4)), int(rng.integers(1, 3)), int(rng.integers(1, 6))
    s, u, psi, goal = ca.SX.sym("s", n), ca.SX.sym("u", m), ca.SX.sym("psi", 3), ca.SX.sym("goal", n)
    drift, gain = 0.5 * rng.normal(size=(n, n)), rng.normal(size=(n, m))
    unit = 10 ** rng.uniform(-3, 3)
    effort = 0.1 * (psi[1] ** 2 + 0.1) * ca.sumsqr(u) + 0.1 * ca.sum1(ca.cos(2 * u))
    constraints = {}
    if rng.random() < 0.7:
        bound = 10 ** rng.uniform(-2, 0.3)
        constraints["action_bounds"] = (-bound, bound)
    if rng.random() < 0.4:
        bound = 10 ** rng.uniform(-1, 0.5)
        constraints["state_bounds"] = (-bound, bound)
    if rng.random() < 0.4:
        constraints["path_constraint"] = ca.sumsqr(u) + psi[1] * s[0] - 10 ** rng.uniform(-1, 0.5)
    problem = OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        context=goal,
        horizon=steps,
        dynamics=drift @ s + gain @ u * (1 + 0.3 * psi[2]) + 0.3 * psi[0] * ca.sin(s),
        stage_cost=unit * ((psi[0] ** 2 + 0.2) * ca.sumsqr(s - goal) + effort),
        terminal_cost=unit * ca.sumsqr(s - goal),
        **constraints,
    )
    demonstration = Demonstration(0.3 * rng.normal(size=n), rng.normal(size=n), rng.normal(size=(steps + 1, n)))
    return problem, demonstration, rng.normal(size=3)


@pytest.mark.parametrize("solver", [Ipopt(), Riccati()], ids=lambda solver: type(solver).__name__)
@pytest.mark.parametrize("first", range(0, 40, 10))
def test_a_certified_gradient_agrees_with_finite_differences(first, solver):
    compared = 0
    for seed in range(first, first + 10):
        problem, demonstration, psi = random_case(seed)
        implicit = Implicit(solver, policy="flag")(problem, demonstration, psi)
        if not implicit.certificate.certified:
            continue
        method = FiniteDifference(Ipopt(tolerance=1e-12), step=1e-3, policy="flag")
        reference = method(problem, demonstration, psi, guess=implicit.certificate.solution)
        if reference.certificate.certified:
            compared += 1
            np.testing.assert_allclose(implicit.gradient, reference.gradient, rtol=2e-5, atol=1e-8, err_msg=str(seed))
    assert compared >= 6  # some random constraints cannot be met; most can


def race(seed):
    """The solutions of `Riccati` and `Ipopt`."""
    problem, demonstration, psi = random_case(seed)
    return [
        solver.solve(problem, demonstration.s0, psi, demonstration.context).raise_if_failed()
        for solver in (Riccati(), Ipopt())
    ]


@pytest.mark.parametrize("seed", [211, 3305])
def test_a_hessian_that_lacks_little_is_regularised_little(seed):
    """These took 1.7 and 13 times as many as Ipopt, in short steps, when weights grew eightfold whatever lacked."""
    ours, theirs = race(seed)
    assert ours.iterations <= 1.5 * theirs.iterations


def test_near_feasible_points_less_violation_is_not_bought_at_any_price():
    """A step that gained 1e-8 of it went to where the objective is higher, and others back, 500 times."""
    ours, theirs = race(5367)
    assert ours.iterations <= 1.5 * theirs.iterations
