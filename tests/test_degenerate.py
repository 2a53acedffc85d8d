"""Where the gradient does not exist or was not reached: flagged, never answered wrongly.

Most problems have one step, s_1 = u from s_0 = 0, so that the solution u(p) is known by hand; the loss is |s_1 - z|^2.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import pytest
from problems import iiwa, unconstrained

from kpirl_ocp import (
    OCP,
    Demonstration,
    FiniteDifference,
    GradientDescent,
    Implicit,
    Ipopt,
    Riccati,
    Trajectory,
    Unrolled,
)
from kpirl_ocp.errors import CertificateError
from kpirl_ocp.irl.hypergradients.certificate import HypergradientResult

pytestmark = pytest.mark.usefixtures("virtual_machine")

FOLD = 2 / (3 * np.sqrt(3))  # tilt at which the right well of (u^2 - 1)^2 / 4 + p u disappears, at u = 1 / sqrt(3)

Expression = Callable[[ca.SX, ca.SX], ca.SX]


@dataclass(frozen=True, eq=False)
class Point:
    """Where to differentiate: a problem, p, where to start, and the state z that the demonstration shows."""

    problem: OCP
    psi: float | np.ndarray
    start: tuple[float, ...] | None = None
    seen: float = 0.0

    def differentiate(self, method: Callable[..., HypergradientResult]) -> HypergradientResult:
        n = self.problem.n_states
        guess = None
        if self.start is not None:
            guess = Trajectory(np.array([np.zeros(n), self.start]), np.array([self.start]))
        demonstration = Demonstration(np.zeros(n), [], np.array([np.zeros(n), np.full(n, self.seen)]))
        return method(self.problem, demonstration, np.atleast_1d(self.psi), guess)


def one_step(
    cost: Expression,
    *,
    n: int = 1,
    bounds: tuple[object, object] = (-np.inf, np.inf),
    path: Expression | None = None,
    gain: Callable[[ca.SX], ca.SX] = lambda p: ca.SX(1.0),
    terminal: Callable[[ca.SX], ca.SX] = lambda s: ca.SX(0.0),
) -> OCP:
    """min cost(u, p) + terminal(s_1) with s_1 = gain(p) u and path(u, p) <= 0."""
    s, u, p = ca.SX.sym("s", n), ca.SX.sym("u", n), ca.SX.sym("p")
    return OCP.from_expressions(
        state=s,
        action=u,
        parameters=p,
        dynamics=gain(p) * u,
        stage_cost=cost(u, p),
        terminal_cost=terminal(s),
        path_constraint=None if path is None else path(u, p),
        action_bounds=bounds,
        horizon=1,
    )


def title(method: Implicit | Unrolled | FiniteDifference) -> str:
    return f"{type(method).__name__}({type(method.solver).__name__})"


def ridge(u: ca.SX, p: ca.SX) -> ca.SX:
    return (u - p) ** 2


CAPPED = one_step(ridge, bounds=(-np.inf, 0.5))  # u = min(p, 1/2)
WELLS = one_step(lambda u, p: (u**2 - 1) ** 2 / 4 + p * u)
QUARTIC = one_step(lambda u, p: u**4 / 4 - p * u)  # u = p^(1/3)
DESCENT = GradientDescent(2000, 0.1, project=True)
POINTS = {
    "weak_bound": Point(CAPPED, 0.5),
    "weak_path": Point(one_step(ridge, path=lambda u, p: u - 0.5), 0.5),
    "weak_stiff": Point(one_step(lambda u, p: 1e3 * ridge(u, p), bounds=(-np.inf, 0.5)), 0.5),
    "dependent": Point(one_step(ridge, bounds=(-np.inf, 0.5), path=lambda u, p: u - 0.5), 1.0),
    "dependent_scaled": Point(one_step(ridge, bounds=(-np.inf, 0.5), path=lambda u, p: 1e3 * u - 500), 1.0),
    "redundant": Point(one_step(lambda u, p: (u[0] + u[1] - p) ** 2, n=2), 1.0),
    "maximum": Point(one_step(lambda u, p: u**4 - (u - p) ** 2), 0.0),
    "saddle": Point(one_step(lambda u, p: (u[0] - p) ** 2 + u[1] ** 4 - u[1] ** 2, n=2), 0.5),
    "fold": Point(WELLS, FOLD, (0.8,)),
    "fold_exactly": Point(WELLS, FOLD, (1 / np.sqrt(3),)),
    "quartic": Point(QUARTIC, 0.0, (0.8,)),
    "tie": Point(WELLS, 0.0, seen=0.3),
    "plain": Point(one_step(lambda u, p: (u - p) ** 2 + u**4), 1.0),
    "small_cost": Point(one_step(lambda u, p: 1e-7 * ridge(u, p)), 1.0),
    "infeasible": Point(one_step(ridge, bounds=(-np.inf, 0.5), path=lambda u, p: 1 - u), 1.0),
    "kink": Point(one_step(lambda u, p: ca.fmax(u, 0) + ridge(u, p) / 2), 0.5, seen=1.0),  # u = 0 for 0 < p < 1
    "nan_dynamics": Point(
        one_step(lambda u, p: u**2, terminal=lambda s: (s - 1) ** 2, gain=lambda p: ca.sqrt(p - 2)), 0.5
    ),
    "nan_cost": Point(one_step(lambda u, p: ridge(u, p) - ca.log(u - 0.2), bounds=(-1, 1)), 0.5),
    "edge": Point(
        one_step(lambda u, p: ca.sqrt(u - 1) * (u - 1) + ridge(u, p)), 1 + 3e-7 + 0.75 * np.sqrt(3e-7), (1 + 3e-7,)
    ),  # u = 1 + 3e-7
    "nan_slope": Point(one_step(lambda u, p: ca.norm_2(u) + ca.sumsqr(u - p), n=2, bounds=(-1, 1)), 0.5),
}
NEEDS_MORE = "did not converge"
NO_MINIMUM = "add effort weight, or start elsewhere"
FLAGGED = [
    ("weak_bound", Implicit(), "use policy='smooth'"),
    ("weak_bound", Implicit(DESCENT), "use policy='smooth'"),
    ("weak_bound", FiniteDifference(), "Right and left derivatives differ"),
    ("weak_bound", Unrolled(DESCENT), "the projection has no derivative there"),
    ("weak_path", Implicit(), "use policy='smooth'"),
    ("weak_stiff", Implicit(), "use policy='smooth'"),
    ("dependent", Implicit(), "Active constraints depend on each other"),
    ("dependent_scaled", Implicit(), "Active constraints depend on each other"),
    ("redundant", Implicit(), NO_MINIMUM),
    ("maximum", Implicit(Ipopt()), NO_MINIMUM),
    ("maximum", Implicit(DESCENT), NO_MINIMUM),
    ("maximum", FiniteDifference(), "Right and left derivatives differ"),
    ("saddle", Implicit(Ipopt()), NO_MINIMUM),
    ("fold", Implicit(), ""),
    ("fold", FiniteDifference(), "Step sizes disagree"),
    ("fold_exactly", Implicit(), ""),
    ("quartic", Implicit(), ""),
    ("quartic", FiniteDifference(), "Right and left derivatives differ"),
    ("tie", Implicit(Ipopt()), NO_MINIMUM),
    ("tie", FiniteDifference(), "Step sizes disagree"),
    ("plain", Implicit(Ipopt(max_iterations=1)), NEEDS_MORE),
    ("plain", Implicit(GradientDescent(1, 0.1)), NEEDS_MORE),
    ("plain", FiniteDifference(Ipopt(max_iterations=1)), "solves failed, the first with ITERATION_LIMIT"),
    ("small_cost", Implicit(GradientDescent(1, 0.1)), ""),
    ("infeasible", Implicit(), "no feasible point was found"),
    ("infeasible", FiniteDifference(), "solves failed, the first with INFEASIBLE"),
    ("kink", Implicit(), ""),
    ("edge", Implicit(Ipopt()), "sits on a kink"),  # NaN beside it
    ("nan_dynamics", Unrolled(DESCENT), "NaN"),
    ("nan_dynamics", Implicit(), "NaN"),
    ("nan_dynamics", Implicit(DESCENT), "NaN"),
    ("nan_dynamics", FiniteDifference(), "NaN"),
    ("nan_cost", Unrolled(DESCENT), "NaN"),
    ("nan_cost", Implicit(), "NaN"),
    ("nan_cost", FiniteDifference(), "NOT_FINITE"),
    ("nan_slope", Unrolled(GradientDescent(20, 0.1, project=True)), "NaN"),
    ("nan_slope", Implicit(), "NaN"),
    ("nan_slope", FiniteDifference(GradientDescent(20, 0.1, project=True)), "NaN"),
]


@pytest.mark.parametrize(
    ("name", "method", "remedy"), FLAGGED, ids=[f"{name}-{title(method)}" for name, method, _ in FLAGGED]
)
def test_gradient_that_cannot_be_trusted_is_flagged_with_its_remedy(
    name: str, method: Implicit | Unrolled | FiniteDifference, remedy: str
) -> None:
    certificate = POINTS[name].differentiate(replace(method, policy="flag")).certificate
    assert not certificate.certified
    assert remedy in " ".join(certificate.failures)
    with pytest.raises(CertificateError, match="policy='flag'") as caught:
        POINTS[name].differentiate(replace(method, policy="raise"))
    assert caught.value.certificate.failures == certificate.failures


STATIONARY = ["maximum", "saddle", "tie"]  # points at which Ipopt stays


@pytest.mark.parametrize(("name", "minimum"), [("maximum", 0.5**0.5), ("saddle", 0.5**0.5), ("tie", 1.0)])
def test_solver_leaves_stationary_points_that_are_no_minima(name: str, minimum: float) -> None:
    result = POINTS[name].differentiate(Implicit(Riccati()))
    assert result.certificate.certified
    assert abs(result.certificate.solution.actions[0, -1]) == pytest.approx(minimum, rel=1e-6)


@pytest.mark.parametrize("name", [name for name in POINTS if name not in STATIONARY])
def test_certificate_does_not_depend_on_which_solver_found_the_solution(name: str) -> None:
    results = [POINTS[name].differentiate(Implicit(s, policy="flag")) for s in (Ipopt(), Riccati())]
    assert results[0].certificate.certified == results[1].certificate.certified == (name in ("plain", "small_cost"))
    if results[0].certificate.certified:
        np.testing.assert_allclose(results[0].gradient, results[1].gradient, rtol=1e-8)


@pytest.mark.parametrize("method", [Unrolled(DESCENT), Implicit(), Implicit(DESCENT), FiniteDifference()], ids=title)
def test_gradient_of_nan_dynamics_is_nan_and_not_zero(method: Implicit | Unrolled | FiniteDifference) -> None:
    result = POINTS["nan_dynamics"].differentiate(replace(method, policy="flag"))
    assert np.isnan(result.gradient).all()
    assert np.isnan(result.loss)


@pytest.mark.parametrize(
    "problem",
    [
        one_step(lambda u, p: (u[0] - ca.sin(p)) ** 2 + u[1] ** 2, n=2, bounds=([-np.inf] * 2, [0.5, np.inf])),
        one_step(lambda u, p: (u[0] - ca.sin(p)) ** 2 + u[1] ** 2, n=2, path=lambda u, p: u[0] - 0.5),
    ],
    ids=["bound", "path"],
)
def test_inactive_inequality_with_a_tiny_multiplier_stays_inactive(problem: OCP) -> None:
    """CasADi's own sensitivity of Ipopt gives dx/dp = 2e-16 here."""
    result = Point(problem, 0.3, seen=1.0).differentiate(Implicit())
    assert result.certificate.certified
    assert not result.certificate.active.any()
    assert result.gradient[0] / (2 * (np.sin(0.3) - 1)) == pytest.approx(np.cos(0.3), rel=1e-9)


@pytest.mark.parametrize(
    "method",
    [Implicit(), FiniteDifference(Ipopt(tolerance=1e-12)), Unrolled(DESCENT)],
    ids=title,
)
@pytest.mark.parametrize(("p", "slope"), [(0.45, 1.0), (0.55, 0.0)])
def test_derivative_of_min_is_one_on_the_left_and_zero_on_the_right(method: Implicit, p: float, slope: float) -> None:
    result = Point(CAPPED, p).differentiate(method)
    assert result.gradient[0] == pytest.approx(2 * min(p, 0.5) * slope, abs=1e-9)


@pytest.mark.parametrize("barrier", [1e-2, 1e-4, 1e-6])
def test_smoothed_derivative_lies_halfway_at_the_weakly_active_bound(barrier: float) -> None:
    """2 (u - p) + tau / (1/2 - u) = 0 has u = 1/2 - sqrt(tau / 2) and du/dp = 1/2 at p = 1/2."""
    method = Implicit(Ipopt(tolerance=1e-13), policy="smooth", barrier=barrier)
    result = POINTS["weak_bound"].differentiate(method)
    u = 0.5 - np.sqrt(barrier / 2)
    assert result.loss == pytest.approx(u**2, rel=1e-8)
    assert result.gradient[0] / (2 * u) == pytest.approx(0.5, abs=1e-7)
    assert result.certificate.certified


# Flagged or right: p on both sides of the degenerate point, the known gradient, and whether an answer is due.
GAPS = 10.0 ** np.arange(-8, -2)
NEAR_CAP = [(0.5 + gap, 0.0) for gap in GAPS] + [(0.5 - gap, 1 - 2 * gap) for gap in GAPS]


@pytest.mark.parametrize(("p", "exact"), NEAR_CAP)
@pytest.mark.parametrize("stiffness", [1.0, 1e3])
def test_gradient_beside_a_weakly_active_bound_is_flagged_or_right(stiffness: float, p: float, exact: float) -> None:
    point = Point(one_step(lambda u, p: stiffness * ridge(u, p), bounds=(-np.inf, 0.5)), p)
    result = point.differentiate(Implicit(policy="flag"))
    assert not result.certificate.certified or result.gradient[0] == pytest.approx(exact, abs=1e-3)
    assert result.certificate.certified or abs(p - 0.5) < 1e-3


@pytest.mark.parametrize("scale", [1e-8, 1e-7, 1e-6, 1e-4, 1.0, 1e6])
@pytest.mark.parametrize(
    "problem",
    [
        lambda scale: one_step(lambda u, p: scale * ridge(u, p), bounds=(-np.inf, 0.5)),
        lambda scale: one_step(ridge, path=lambda u, p: (u - 0.5) / scale),
    ],
    ids=["cost", "path"],
)
def test_units_do_not_turn_an_active_constraint_into_a_certified_inactive_one(
    problem: Callable[[float], OCP], scale: float
) -> None:
    """u = min(p, 1/2) at p = 1, in any units: the gradient is zero."""
    result = Point(problem(scale), 1.0).differentiate(Implicit(policy="flag"))
    assert not result.certificate.certified or abs(result.gradient[0]) < 1e-3
    assert result.certificate.certified


@pytest.mark.parametrize("gap", [1e-1, 1e-2, 1e-3, 1e-5, 1e-7, 1e-9])
def test_gradient_on_the_way_to_a_fold_is_flagged_or_right(gap: float) -> None:
    """u^3 - u + p = 0 gives du/dp = 1 / (1 - 3 u^2), which grows like 1 / sqrt(gap)."""
    result = Point(WELLS, FOLD - gap, (0.8,)).differentiate(Implicit(policy="flag"))
    u = max(np.roots([1.0, 0.0, -1.0, FOLD - gap]).real)
    assert not result.certificate.certified or result.gradient[0] == pytest.approx(2 * u / (1 - 3 * u**2), rel=1e-3)
    assert result.certificate.certified or gap < 1e-3


@pytest.mark.parametrize("p", [-0.01, 0.01, FOLD + 0.01])
def test_solution_that_jumped_has_the_gradient_of_the_well_it_is_in(p: float) -> None:
    result = Point(WELLS, p, (-0.8,) if p > 0 else (0.8,)).differentiate(Implicit())
    u = result.certificate.solution.actions[0, 0]
    assert u * p < 0
    assert result.gradient[0] == pytest.approx(2 * u / (1 - 3 * u**2), rel=1e-9)


def test_redundant_joint_without_effort_is_flagged_and_active_bounds_can_fix_it() -> None:
    case = iiwa(effort=0.0)
    unbounded, bounded = (
        Implicit(policy="flag")(c.problem, c.demonstration, c.psi).certificate for c in (unconstrained(case), case)
    )
    assert NO_MINIMUM in " ".join(unbounded.failures)
    assert abs(unbounded.curvature) < 1e-11
    assert bounded.certified


@pytest.mark.parametrize(
    "method",
    [Implicit(), FiniteDifference(), Unrolled(DESCENT), Implicit(policy="smooth")],
    ids=["implicit", "finite_difference", "unrolled", "smooth"],
)
def test_gradient_that_vanishes_at_the_demonstrated_parameters_is_certified(method: Implicit) -> None:
    problem = POINTS["plain"].problem
    solver = method.solver.with_barrier(1e-4) if getattr(method, "policy", "") == "smooth" else method.solver
    seen = solver.solve(problem, [0.0], [1.0]).states[1, 0]
    result = Point(problem, 1.0, seen=seen).differentiate(method)
    assert abs(result.gradient[0]) < 1e-9
    assert result.certificate.certified


@pytest.mark.parametrize("method", [Implicit(), Implicit(policy="smooth")], ids=["exact", "smooth"])
def test_action_fixed_by_its_bounds_is_a_constraint_without_a_margin(method: Implicit) -> None:
    problem = one_step(lambda u, p: (u[0] - p * u[1]) ** 2, n=2, bounds=([-1, 0.5], [1, 0.5]))
    result = Point(problem, 1.0).differentiate(method)
    assert result.gradient[0] == pytest.approx(0.5, abs=1e-3)  # u = (p / 2, 1 / 2)
    assert result.certificate.certified


@pytest.mark.parametrize("solver", [Riccati(), Ipopt()], ids=["Riccati", "Ipopt"])
@pytest.mark.parametrize("u", [3e-7, 0.3])
def test_the_edge_of_a_domain_is_near_in_units_of_the_action_alone(u: float, solver: Riccati | Ipopt) -> None:
    """sqrt(u) u ends at 0, and u is as far from it as it is large: p = u + 3/4 sqrt(u), dp/du = 1 + 3/8 / sqrt(u)."""
    problem = one_step(lambda u, p: ca.sqrt(u) * u + ridge(u, p))
    result = Point(problem, u + 0.75 * np.sqrt(u), (u,)).differentiate(Implicit(solver))
    assert result.gradient[0] == pytest.approx(2 * u / (1 + 0.375 / np.sqrt(u)), rel=1e-7)
