"""Hypergradients of healthy problems: closed forms, finite differences, and agreement of independent methods."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import casadi as ca
import numpy as np
import pytest
from conftest import forget_gradient_steps
from problems import (
    CASES,
    Case,
    ScalarLQR,
    converging_descent,
    derivatives,
    integrator,
    lqr,
    lqr_gradient,
    nothing_to_learn,
    pendulum,
    quadratic,
    unconstrained,
)

from kpirl_ocp import (
    OCP,
    Demonstration,
    FiniteDifference,
    GradientDescent,
    Implicit,
    Ipopt,
    Riccati,
    Truncated,
    Unrolled,
)
from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.hypergradients.certificate import HypergradientResult
from kpirl_ocp.ocp.codegen.compiler import compiled

pytestmark = pytest.mark.usefixtures("virtual_machine")

TIGHT = Ipopt(tolerance=1e-12)
METHODS = {
    "implicit": lambda case: Implicit(),
    "implicit_riccati": lambda case: Implicit(Riccati(tolerance=1e-12)),
    "implicit_tight": lambda case: Implicit(TIGHT),
    "implicit_descent": lambda case: Implicit(converging_descent(case)),
    "unrolled": lambda case: Unrolled(converging_descent(case)),
    "finite_difference": lambda case: FiniteDifference(),
}


def evaluate(method: Callable[..., HypergradientResult], case: Case, guess: object = None) -> HypergradientResult:
    return method(case.problem, case.demonstration, case.psi, guess)


def error(gradient: np.ndarray, reference: np.ndarray) -> float:
    """Largest error, relative to the largest entry of the reference."""
    return float(np.abs(gradient - reference).max() / np.abs(reference).max())


# Closed forms

every_method = pytest.mark.parametrize(
    ("method", "tolerance"),
    [
        ("implicit", 1e-13),
        ("implicit_descent", 1e-13),
        ("implicit_riccati", 1e-13),
        ("unrolled", 1e-13),
        ("finite_difference", 1e-11),
    ],
)


@every_method
@pytest.mark.parametrize("data", [ScalarLQR(), ScalarLQR(a=1.1, b=-0.4, psi=(0.3, 1.5, 0.8))], ids=str)
def test_gradient_is_the_closed_form_of_a_scalar_lqr(data: ScalarLQR, method: str, tolerance: float) -> None:
    H, g, dH, dg = quadratic(data)
    u = -np.linalg.solve(H, g)
    du = -np.linalg.solve(H, (dH @ u + dg).T).T
    result = evaluate(METHODS[method](lqr(data)), lqr(data))
    np.testing.assert_allclose(result.certificate.solution.actions[:, 0], u, rtol=1e-12)
    assert error(result.gradient, lqr_gradient(data, u, du)) <= tolerance


@pytest.mark.parametrize("steps", [1, 5, 20])
def test_unrolled_gradient_is_the_closed_form_of_the_lqr_iteration(steps: int) -> None:
    data, case = ScalarLQR(), lqr()
    H, g, dH, dg = quadratic(data)
    u, du = np.zeros(data.horizon), np.zeros((3, data.horizon))
    for _ in range(steps):  # forward mode, where the package uses reverse
        u, du = u - case.step_size * (H @ u + g), du - case.step_size * (du @ H + dH @ u + dg)
    result = evaluate(Unrolled(converging_descent(case, steps)), case)
    assert error(result.gradient, lqr_gradient(data, u, du)) <= 1e-13


@every_method
def test_gradient_of_one_step_is_the_formula_derived_by_hand(method: str, tolerance: float) -> None:
    """min_u q s0^2 + r u^2 + w (a s0 + b u)^2 has u = -w a b s0 / (r + w b^2)."""
    data = ScalarLQR(horizon=1)
    (_, r, w), a, b, s0 = data.psi, data.a, data.b, data.s0
    size = r + w * b**2
    s1 = a * s0 * r / size
    du = np.array([0.0, w, -r]) * a * b * s0 / size**2
    result = evaluate(METHODS[method](lqr(data)), lqr(data))
    assert error(result.gradient, 2 * (s1 - data.observed[1, 0]) * b * du) <= tolerance


@every_method
def test_gradient_of_a_parameter_of_the_dynamics_alone_is_the_formula(method: str, tolerance: float) -> None:
    """s_1 = p u, min r u^2 + (s_1 - 1)^2 has s_1 = p^2 / (r + p^2)."""
    s, u, gain = ca.SX.sym("s"), ca.SX.sym("u"), ca.SX.sym("gain")
    problem = OCP.from_expressions(
        state=s,
        action=u,
        parameters=gain,
        dynamics=gain * u,
        stage_cost=0.3 * u**2,
        terminal_cost=(s - 1) ** 2,
        horizon=1,
    )
    p, r = 1.2, 0.3
    case = Case(problem, Demonstration([0.0], [], [[0.0], [0.1]]), np.array([p]), 0.3, 200)
    expected = 2 * (p**2 / (r + p**2) - 0.1) * 2 * p * r / (r + p**2) ** 2
    assert error(evaluate(METHODS[method](case), case).gradient, np.array([expected])) <= tolerance


# Agreement of independent methods


def named(name: str) -> Case:
    return unconstrained(CASES[name.removeprefix("free_")]()) if name.startswith("free_") else CASES[name]()


@lru_cache
def reference(case: Case) -> HypergradientResult:
    """Finite differences of re-solved problems: no derivative of ours in them.

    Where it applies the solver is gradient descent, because Ipopt ends at a barrier parameter of about its tolerance,
    and its finite differences are those of the problem so smoothed: on the iiwa 1.5e-8 off at the default 1e-10.
    """
    solver = TIGHT if case.problem.has_state_constraints else converging_descent(case)
    with pytest.MonkeyPatch.context() as patch:  # a hundred descents of 2500 steps are worth a compiler
        patch.setattr("kpirl_ocp.ocp.solvers.gradient_descent.compiled", compiled)
        forget_gradient_steps()
        found = evaluate(FiniteDifference(solver), case)
    forget_gradient_steps()
    return found


# Interior points keep active constraints at a slack of about their tolerance over the multiplier; the tolerance of
# Riccati is relative to the largest multiplier. The rest is rounding, but for "implicit" on the free iiwa: Ipopt ends
# within its tolerance of 1e-10 there, 1.8e-11 from the minimiser, where the gradient is 5.0e-11 off; the condition
# number of the Hessian is only 132, and the same method at tighter tolerances is 4.8e-12 off.
@pytest.mark.parametrize(
    ("name", "method", "tolerance"),
    [
        ("integrator", "implicit", 1e-9),
        ("integrator", "implicit_tight", 5e-11),
        ("integrator", "implicit_riccati", 5e-11),
        ("pendulum", "implicit", 1e-9),
        ("pendulum", "implicit_tight", 1e-12),
        ("pendulum", "implicit_descent", 1e-12),
        ("pendulum", "implicit_riccati", 1e-9),
        ("pendulum", "unrolled", 1e-12),
        ("iiwa", "implicit", 1e-8),
        ("iiwa", "implicit_tight", 5e-10),
        ("iiwa", "implicit_riccati", 5e-10),
        ("iiwa", "implicit_descent", 5e-11),
        ("iiwa", "unrolled", 5e-11),
        ("free_integrator", "implicit", 5e-12),
        ("free_integrator", "implicit_descent", 5e-12),
        ("free_integrator", "unrolled", 5e-12),
        ("free_iiwa", "implicit", 6e-11),
        ("free_iiwa", "implicit_riccati", 1e-11),
        ("free_iiwa", "implicit_tight", 1e-11),
        ("free_iiwa", "implicit_descent", 5e-11),
        ("free_iiwa", "unrolled", 5e-11),
    ],
)
def test_method_agrees_with_finite_differences_of_the_solution(name: str, method: str, tolerance: float) -> None:
    case = named(name)
    result = evaluate(METHODS[method](case), case)
    assert result.loss == pytest.approx(reference(case).loss, rel=tolerance)
    assert error(result.gradient, reference(case).gradient) <= tolerance
    assert result.certificate.certified


@pytest.mark.parametrize("steps", [1, 5])
@pytest.mark.parametrize(
    ("name", "tolerance"),
    [("lqr", 5e-12), ("free_integrator", 5e-12), ("pendulum", 5e-12), ("iiwa", 2e-10)],
)
def test_unrolled_differentiates_a_descent_that_stops_early(name: str, steps: int, tolerance: float) -> None:
    case = named(name)
    result = evaluate(Unrolled(converging_descent(case, steps)), case)
    expected = evaluate(FiniteDifference(converging_descent(case, steps)), case)
    assert error(result.gradient, expected.gradient) <= tolerance
    assert result.loss == pytest.approx(expected.loss, rel=1e-13)


@pytest.mark.parametrize(("name", "steps"), [("lqr", (20, 40, 60)), ("pendulum", (10, 15, 20))])
def test_unrolled_tends_to_implicit_at_the_rate_of_the_descent(name: str, steps: tuple[int, ...]) -> None:
    """u_N - u* shrinks by rho = |1 - alpha eig(H)| a step, its derivative like N rho^N."""
    case = named(name)
    exact = evaluate(Implicit(), case)
    H = derivatives(case, exact.certificate.solution.actions)[0]
    rho = np.abs(1 - case.step_size * np.linalg.eigvalsh(H)).max()
    errors = [error(evaluate(Unrolled(converging_descent(case, N)), case).gradient, exact.gradient) for N in steps]
    for before, after, N, M in zip(errors, errors[1:], steps, steps[1:], strict=False):
        assert after <= 1.2 * rho ** (M - N) * M / N * before


@pytest.mark.parametrize("last", [1, 10])
@pytest.mark.parametrize(("name", "tolerance"), [("lqr", 1e-14), ("pendulum", 1e-14), ("iiwa", 1e-13)])
def test_truncated_is_the_neumann_series_at_a_converged_point(name: str, last: int, tolerance: float) -> None:
    case = named(name)
    solution = converging_descent(case).solve(case.problem, case.demonstration.s0, case.psi, case.demonstration.context)
    H, C, v, expected = derivatives(case, solution.actions)
    inside = (solution.multipliers.action == 0).ravel()  # actions on a bound do not move
    for _ in range(last):
        expected = expected - case.step_size * C.T @ (inside * v)
        v = inside * v - case.step_size * H @ (inside * v)
    result = evaluate(Truncated(converging_descent(case, 30), last), case, guess=solution)
    assert error(result.gradient, expected) <= tolerance
    assert "steps are left out" in " ".join(result.certificate.failures)
    assert result.certificate.differentiated == last


@pytest.mark.parametrize("name", ["lqr", "pendulum", "iiwa"])
def test_truncated_after_all_steps_is_unrolled_exactly(name: str) -> None:
    case = named(name)
    unrolled, truncated = (
        evaluate(m, case) for m in (Unrolled(converging_descent(case, 5)), Truncated(converging_descent(case, 5), 5))
    )
    np.testing.assert_array_equal(truncated.gradient, unrolled.gradient)
    assert truncated.loss == unrolled.loss
    assert truncated.certificate.certified


@pytest.mark.parametrize("barrier", [1e-3, 1e-4])
@pytest.mark.parametrize(("name", "tolerance"), [("integrator", 1e-11), ("iiwa", 5e-10)])
def test_smoothed_gradient_is_that_of_the_smoothed_loss(name: str, tolerance: float, barrier: float) -> None:
    case = named(name)
    smooth = evaluate(Implicit(TIGHT, policy="smooth", barrier=barrier), case)
    expected = evaluate(FiniteDifference(TIGHT.with_barrier(barrier), step=2e-3), case)
    assert smooth.loss == pytest.approx(expected.loss, rel=1e-10)
    assert error(smooth.gradient, expected.gradient) <= tolerance
    assert smooth.certificate.barrier == barrier


@pytest.mark.parametrize("name", ["integrator", "iiwa"])
def test_smoothed_gradient_tends_to_the_exact_one_like_the_barrier(name: str) -> None:
    case = named(name)
    exact = evaluate(Implicit(TIGHT), case).gradient
    barriers = (1e-5, 1e-6, 1e-7)
    errors = [error(evaluate(Implicit(TIGHT, policy="smooth", barrier=tau), case).gradient, exact) for tau in barriers]
    assert errors[1] < 0.2 * errors[0]
    assert errors[2] / errors[1] == pytest.approx(0.1, rel=0.05)


def test_certificate_of_a_healthy_problem_holds_what_was_measured() -> None:
    certificate = evaluate(Implicit(), integrator()).certificate
    solution = certificate.solution
    velocity, force = solution.states[1:, 1], solution.actions[:, 0]
    power = force * solution.states[:-1, 1]
    sides = [velocity + 0.6, force + 1.0, 0.6 - velocity, 1.0 - force, integrator().psi[2] - power]
    np.testing.assert_array_equal(certificate.active, np.concatenate(sides) < 1e-7)
    assert [side.min() < 1e-7 for side in sides] == [False, False, True, True, True]
    assert certificate.certified
    assert certificate.failures == ()
    assert certificate.kkt_residual == solution.residuals.worst < 1e-10
    assert 1e-3 < certificate.curvature < 1
    assert 0.1 < certificate.qualification < 1
    assert certificate.margin > 1e-3
    assert certificate.linear_residual < 1e-12
    assert certificate.barrier == 0


def test_certificate_without_inequalities_has_no_margin_and_no_active_set() -> None:
    certificate = evaluate(Implicit(), pendulum()).certificate
    assert (certificate.margin, certificate.qualification, certificate.active.size) == (np.inf, np.inf, 0)


@pytest.mark.parametrize(
    ("build", "reason"),
    [
        (lambda: Unrolled(Ipopt()), r"only GradientDescent can be unrolled, not Ipopt: use Implicit\(Ipopt\(\)\)"),
        (lambda: Truncated(Ipopt(), 1), "only GradientDescent can be unrolled"),
        (lambda: Truncated(GradientDescent(5), 6), "last must be between 1 and the solver's 5 steps, got 6"),
        (lambda: Truncated(GradientDescent(5), 0), "last must be between"),
        (lambda: Implicit(policy="rais"), "policy must be one of raise, flag, smooth; got 'rais'"),
        (lambda: Unrolled(GradientDescent(), policy="smooth"), "policy must be one of raise, flag;"),
        (lambda: FiniteDifference(policy="smooth"), "policy must be one of raise, flag;"),
        (lambda: Implicit(GradientDescent(), policy="smooth"), "a solver for the smoothed problem"),
        (lambda: Implicit(policy="smooth", barrier=0.0), "needs barrier > 0"),
        (lambda: FiniteDifference(step=0.0), "step must be positive"),
    ],
)
def test_impossible_pairing_cannot_be_constructed(build: Callable[[], object], reason: str) -> None:
    with pytest.raises(ProblemError, match=reason):
        build()


@pytest.mark.parametrize("method", METHODS)
def test_observations_of_another_length_are_refused(method: str) -> None:
    case = pendulum()
    shorter = Demonstration(case.demonstration.s0, [], case.demonstration.observations[:-1])
    with pytest.raises(ProblemError, match=r"\(T\+1, n_z\) = \(21, 2\), got \(20, 2\)"):
        METHODS[method](case)(case.problem, shorter, case.psi)


@pytest.mark.parametrize("method", ["implicit_descent", "unrolled"])
def test_gradient_descent_refuses_state_constraints(method: str) -> None:
    with pytest.raises(ProblemError, match="unconstrained"):
        evaluate(METHODS[method](integrator()), integrator())


@pytest.mark.parametrize("method", [*METHODS, "smooth"])
def test_nothing_to_learn_gives_an_empty_gradient(method: str) -> None:
    case = nothing_to_learn()
    result = evaluate((METHODS | {"smooth": lambda _: Implicit(policy="smooth")})[method](case), case)
    assert (result.gradient.shape, result.loss > 0) == ((0,), True)
    assert result.certificate.certified


@pytest.mark.parametrize("horizon", [10, 20, 35])
@pytest.mark.parametrize("steps", [50, 150, 400])
def test_steps_that_diverge_on_a_smooth_problem_say_to_take_smaller_ones_and_find_no_kink(horizon, steps):
    """Up to losses of 1e171, then infinite ones of plans up to 1e255, then NaN."""
    s, u, weight = ca.SX.sym("s"), ca.SX.sym("u"), ca.SX.sym("psi")
    cost = weight * s**2
    problem = OCP.from_expressions(
        state=s,
        action=u,
        parameters=weight,
        dynamics=s + u,
        stage_cost=cost + u**2,
        terminal_cost=cost,
        horizon=horizon,
    )
    seen = Demonstration([1.0], [], np.zeros((horizon + 1, 1)))
    found = Unrolled(GradientDescent(steps, 0.05), policy="flag")(problem, seen, [1.0]).certificate
    assert any("smaller steps (`step_size`)" in sentence for sentence in found.failures)
    assert not any("kink" in sentence for sentence in found.failures)
