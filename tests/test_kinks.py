"""Kinks and jumps wherever they can be: in psi, the observation, the loss; and the same verdict in every unit."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from kpirl_ocp import OCP, Demonstration, GradientDescent, Implicit, Riccati, Unrolled
from kpirl_ocp.ocp.conditions.polynomials import is_quadratic
from kpirl_ocp.ocp.conditions.structure import own_derivatives_agree, quadratic_program
from kpirl_ocp.ocp.problem import DynamicsDerivatives

pytestmark = pytest.mark.usefixtures("virtual_machine")

S, U, P = ca.SX.sym("s"), ca.SX.sym("u"), ca.SX.sym("p")
PLAIN = {"state": S, "action": U, "parameters": P, "dynamics": S + U, "horizon": 2}


def certificate_of(problem, psi, observations=(0.0, 0.0, 0.0), **settings):
    seen = Demonstration(np.zeros(problem.n_states), np.zeros(0), np.reshape(observations, (problem.horizon + 1, -1)))
    return Implicit(policy="flag", **settings)(problem, seen, np.atleast_1d(psi))


def distance(problem):
    """L1."""
    states = ca.MX.sym("S", problem.n_states, problem.horizon + 1)
    actions = ca.MX.sym("U", problem.n_actions, problem.horizon)
    seen = ca.MX.sym("Z", problem.n_observations, problem.horizon + 1)
    return ca.Function("l1", [states, actions, seen], [ca.sum2(ca.fabs(states - seen))])


WEIGHTED = OCP.from_expressions(**PLAIN, stage_cost=(0.2 + ca.fabs(P)) * (U - 0.4) ** 2 + 0.1 * (S - 2) ** 2)
FOLLOWING = OCP.from_expressions(**PLAIN, stage_cost=(U - P) ** 2)
FOLDED = OCP.from_expressions(**PLAIN, stage_cost=(U - P) ** 2, observation=ca.fabs(S - 1))
STEPPED = OCP.from_expressions(**PLAIN, stage_cost=(U - ca.floor(P)) ** 2)
BENT = OCP.from_expressions(**PLAIN, stage_cost=(U - P) ** 2 + ca.fabs(U - 1) * (U - 1))
PRICED = OCP.from_expressions(**PLAIN, stage_cost=(U - P) ** 2 + ca.if_else(U > 1, 0.5, 0))
SHIFTED = OCP.from_expressions(**PLAIN | {"dynamics": S + U + ca.fabs(P)}, stage_cost=(U - 1) ** 2 + S**2)


def test_a_kink_that_only_psi_sees_is_flagged_and_its_sides_are_certified():
    """With w = 0.2 + |psi|: u_0 = (0.4 w + 0.2) / (w + 0.1), u_1 = 0.4; at psi = 0 the sides are -2.607 and +2.607."""
    seen = [0.0, 23 / 30, 23 / 30]
    assert "kink" in str(certificate_of(WEIGHTED, 0.0, seen).certificate)
    for psi in (1e-4, -1e-4):
        found, w = certificate_of(WEIGHTED, psi, seen), 0.2 + abs(psi)
        u = (0.4 * w + 0.2) / (w + 0.1)
        slope = -0.16 / (w + 0.1) ** 2 * 2 * (2 * u + 0.4 - 23 / 15)
        assert found.certificate.certified
        np.testing.assert_allclose(found.gradient, np.sign(psi) * slope, rtol=1e-8)
        assert abs(abs(found.gradient[0]) - 2.607) < 0.01


@pytest.mark.parametrize(
    ("problem", "kink", "beside"),
    [(STEPPED, 1.0, 1.5), (BENT, 1.0, 1.2), (SHIFTED, 0.0, 0.3), (PRICED, 1.0, 0.8)],
    ids=str,
)
def test_jumps_and_bends_of_the_plan_are_flagged_and_points_beside_them_certified(problem, kink, beside):
    assert not certificate_of(problem, kink).certificate.certified
    assert certificate_of(problem, beside).certificate.certified


def test_a_kink_of_the_observation_is_flagged():
    """The loss has the slopes -1 and +1 there."""
    assert "observation" in str(certificate_of(FOLDED, 1.0, [1, 0.5, 1]).certificate)
    beside = certificate_of(FOLDED, 1.1, [1, 0.5, 1])
    assert beside.certificate.certified


def test_a_loss_on_its_kink_is_flagged_and_a_smooth_one_at_its_minimum_is_certified():
    reached = [0.0, 1.0, 2.0]  # psi = 1
    assert "kink" in str(certificate_of(FOLLOWING, 1.0, reached, loss=distance).certificate)
    assert certificate_of(FOLLOWING, 1.0, reached).certificate.certified
    beside = certificate_of(FOLLOWING, 1.1, reached, loss=distance)
    assert beside.certificate.certified
    np.testing.assert_allclose(beside.gradient, 3.0, rtol=1e-10)


@pytest.mark.parametrize("cost", 10.0 ** np.arange(-6, 7, 2))
@pytest.mark.parametrize("unit", [0.1, 1.0, 1e4])
@pytest.mark.parametrize(
    ("gap", "certified"), [(1e-9, False), (1e-7, False), (-1e-7, False), (1e-4, True), (-1e-4, True)]
)
def test_units_of_cost_and_action_do_not_change_the_verdict_beside_a_kink(cost, unit, gap, certified):
    """u = min(p, 1/2), in other units."""
    problem = OCP.from_expressions(**PLAIN, stage_cost=cost * (U / unit - P) ** 2, action_bounds=(-np.inf, 0.5 * unit))
    found = certificate_of(problem, 0.5 + gap)
    assert found.certificate.certified is certified
    assert not certified or found.gradient[0] == pytest.approx(
        0.0 if gap > 0 else 10 * (0.5 + gap) * unit**2, rel=1e-6, abs=1e-6 * unit**2
    )


@pytest.mark.parametrize("unit", [1e-6, 1e-3, 1.0, 1e3, 1e6])
def test_a_flat_direction_is_flagged_and_an_action_in_other_units_is_not(unit):
    u = ca.SX.sym("u", 2)
    given = PLAIN | {"action": u, "dynamics": S + u[0] + u[1] / unit}
    round_ = OCP.from_expressions(**given, stage_cost=(u[0] - P) ** 2 + (u[1] / unit) ** 2 + S**2)
    flat = OCP.from_expressions(**given, stage_cost=(u[0] + u[1] / unit - P) ** 2 + S**2)
    assert certificate_of(round_, 1.0).certificate.certified
    assert "minimum" in str(certificate_of(flat, 1.0).certificate)


@pytest.mark.parametrize(
    ("problem", "psi", "observations", "loss", "certified"),
    [
        (WEIGHTED, 0.0, (0, 0.5, 1), None, False),
        (WEIGHTED, 0.1, (0, 0.5, 1), None, True),
        (STEPPED, 1.0, (0, 0.5, 1), None, False),
        (FOLDED, 1.0, (1, 0.5, 1), None, False),
        (FOLDED, 1.1, (1, 0.5, 1), None, True),
        (FOLLOWING, 1.0, (0, 1, 2), distance, False),
        (FOLLOWING, 1.1, (0, 1, 2), distance, True),
    ],
)
def test_the_unrolled_gradient_is_flagged_where_psi_the_observation_or_the_loss_has_a_kink(
    problem, psi, observations, loss, certified
):
    seen = Demonstration(np.zeros(1), np.zeros(0), np.reshape(observations, (3, 1)))
    method = Unrolled(GradientDescent(200, 0.2), policy="flag", **({} if loss is None else {"loss": loss}))
    assert method(problem, seen, [psi]).certificate.certified is certified


def two_steps(stage_cost, psi):
    """Of length 1/4 from u = 0, with the demonstrated s_1 = 1."""
    problem = OCP.from_expressions(**PLAIN | {"horizon": 1}, stage_cost=stage_cost)
    seen = Demonstration(np.zeros(1), np.zeros(0), np.array([[0.0], [1.0]]))
    return Unrolled(GradientDescent(2, 0.25), policy="flag")(problem, seen, [psi])


def test_a_kink_that_steps_meet_on_the_way_is_measured_by_the_slopes_to_both_sides():
    """u_2 = 7/16 psi below 0 and 6/16 psi above it, so that the slopes of (u_2 - 1)^2 at 0 are -14/16 and -12/16.

    No derivative is both: the certificate's kink is at least half their difference, relative to the larger.
    """
    cost = (U - P) ** 2 / 2 + ca.fmax(U, 0) ** 2 / 2
    found = two_steps(cost, 0.0)
    assert not found.certificate.certified
    assert 1 / 14 - 1e-6 < found.certificate.kink < 2 / 14 + 1e-6
    assert "end on a kink or cross one" in str(found.certificate)
    for psi, share in ((-0.1, 7 / 16), (-1e-4, 7 / 16), (1e-4, 6 / 16), (0.1, 6 / 16)):
        beside = two_steps(cost, psi)
        assert beside.certificate.certified
        np.testing.assert_allclose(beside.gradient, 2 * share * (share * psi - 1), rtol=1e-12)


def test_steps_that_jump_at_psi_are_not_certified_and_those_beside_are():
    """With the cost |u - psi| / 2 steps are 1/8 long whatever psi is, but stop on 1/8 for no other psi than this."""
    cost = ca.fabs(U - P) / 2
    assert not two_steps(cost, 0.125).certificate.certified
    for psi, end in ((0.12, 0.0), (0.13, 0.25)):
        found = two_steps(cost, psi)
        assert found.certificate.certified
        assert (found.gradient == 0).all()
        np.testing.assert_allclose(found.loss, (end - 1) ** 2)


def test_curvature_is_no_kink_to_gradients_of_steps():
    """At a demonstration that is met exactly the gradient is 0, and slopes to both sides are all curvature."""
    far = ca.fmax(U - 100, 0)  # a kink that no step meets
    seen = two_steps((U - P) ** 2 / 2 + far, 16 / 7)
    np.testing.assert_allclose(seen.gradient, 0, atol=1e-15)
    assert seen.certificate.certified
    steep = two_steps((U - ca.exp(1e3 * (P - 1))) ** 2 / 2 + far, 1.0)
    np.testing.assert_allclose(steep.gradient, 2 * (7 / 16 - 1) * 7 / 16 * 1e3, rtol=1e-12)
    assert steep.certificate.certified


@pytest.mark.parametrize(
    ("expression", "quadratic"),
    [
        (P * U**2 - 3 * U + P**2, True),
        (P**2 * U**2, True),
        (U**3, False),
        (ca.sin(U), False),
        (ca.tanh(1e6 * U), False),  # has no kink, but is as steep as one
        (1 / U, False),
        (ca.sqrt(U**2), False),
        (ca.fabs(U), False),
        (ca.if_else(U > 0, U, 2 * U), False),
    ],
)
def test_a_function_is_quadratic_where_it_is_so_in_each_of_its_arguments(expression, quadratic):
    scalar = ca.Function("scalar", [U, P], [expression])
    u, p = ca.MX.sym("u"), ca.MX.sym("p")
    called = ca.Function("called", [u, p], [2 * scalar(u, p)])
    assert is_quadratic(scalar) is is_quadratic(called) is quadratic


def test_tables_are_not_taken_for_polynomials():
    table = ca.interpolant("table", "linear", [[0.0, 1.0, 2.0]], [0.0, 1.0, 0.0])
    u = ca.MX.sym("u")
    assert not is_quadratic(ca.Function("f", [u], [table(u)]))


def test_gradients_of_quadratic_steps_need_no_steps_beside_and_are_those_that_steps_beside_confirm():
    cost, far = 0.5 * (U - P) ** 2, ca.fmax(U - 100, 0)
    at_once, beside = two_steps(cost, 0.3), two_steps(cost + far, 0.3)
    assert at_once.certificate.kink == 0 < beside.certificate.kink < 1e-5
    assert at_once.certificate.certified
    assert beside.certificate.certified
    np.testing.assert_allclose(at_once.gradient, beside.gradient, rtol=1e-14)


@pytest.mark.parametrize(
    "method",
    [Implicit(policy="flag"), Unrolled(GradientDescent(50, 0.1), policy="flag")],
    ids=lambda method: type(method).__name__,
)
@pytest.mark.parametrize(("steepness", "certified"), [(1e2, True), (1e5, False), (1e7, False), (1e9, False)])
def test_a_sigmoid_that_is_as_steep_as_a_step_is_none_that_a_gradient_may_be_trusted_on(method, steepness, certified):
    """It has no kink; but the exact derivative holds within 1 / steepness of psi alone."""
    cost = (U - 0.4) ** 2 + 0.3 * ca.tanh(steepness * (P - 0.3)) * U + 0.1 * (S - 2) ** 2
    problem = OCP.from_expressions(**PLAIN | {"dynamics": S + U}, stage_cost=cost, terminal_cost=(S - 1) ** 2)
    seen = Demonstration(np.ones(1), np.zeros(0), np.array([[1.0], [0.5], [1.0]]))
    found = replace(method, policy="flag")(problem, seen, [0.3 + 0.5 / steepness])
    assert found.certificate.certified is certified


@pytest.mark.parametrize(("steepness", "certified"), [(3.0, True), (3e3, False)])
def test_a_loss_is_smooth_where_psi_moves_the_plan_and_not_only_within_a_millionth_of_it(steepness, certified):
    """Within a millionth of psi, u = 1000 (psi - 0.7) moves by 0.0007, and the observation from end to end."""
    observation = ca.tanh(steepness * (S - 1))
    stated = PLAIN | {"stage_cost": (U - 1e3 * (P - 0.7)) ** 2, "observation": observation}
    seen = Demonstration(np.ones(1), np.zeros(0), np.zeros((3, 1)))
    psi = 0.7 + 0.5e-3 / steepness
    found = Implicit(policy="flag")(OCP.from_expressions(**stated), seen, [psi])
    slopes = [2 * t * 1e3 * steepness * np.tanh(0.5 * t) / np.cosh(0.5 * t) ** 2 for t in (1, 2)]
    np.testing.assert_allclose(found.gradient, sum(slopes), rtol=1e-8)
    assert found.certificate.certified is certified


@pytest.mark.parametrize("count", [1, 3])
def test_every_one_of_several_demonstrations_has_its_own_kink(count):
    """The start of one of them lies on the kink of the cost in s; the others stay beside it."""
    problem = OCP.from_expressions(**PLAIN | {"horizon": 1}, stage_cost=(U - P) ** 2, terminal_cost=ca.fabs(S) * S / 4)
    starts = [0.0, 1.0, -1.0][:count]
    seen = [Demonstration(np.array([start]), np.zeros(0), np.array([[start], [1.0]])) for start in starts]
    results = Unrolled(GradientDescent(5, 0.1), policy="flag").batch(problem, seen, [0.0])
    assert [result.certificate.certified for result in results] == [False, True, True][:count]


@pytest.mark.parametrize(("factor", "certified"), [(1.0, True), (1.001, False)])
def test_derivatives_of_other_dynamics_are_not_certified(factor, certified):
    problem, other = (
        OCP.from_expressions(**PLAIN | {"dynamics": S + share * ca.sin(U)}, stage_cost=(U - P) ** 2)
        for share in (1.0, factor)
    )
    problem = replace(problem, derivatives=DynamicsDerivatives.by_ad(other.transition))
    seen = Demonstration(np.zeros(1), np.zeros(0), np.array([[0.0], [1.0], [1.0]]))
    certificate = Unrolled(GradientDescent(5, 0.1), policy="flag")(problem, seen, [0.5]).certificate
    assert certificate.certified is certified
    assert certified or "own derivatives are not those of its dynamics" in str(certificate)


def other_derivatives(factor):
    """A problem that brings derivatives of its dynamics with the curvature of others."""
    problem, other = (
        OCP.from_expressions(**PLAIN | {"dynamics": S + share * ca.sin(U)}, stage_cost=(U - P) ** 2 + S**2)
        for share in (1.0, factor)
    )
    return replace(problem, derivatives=DynamicsDerivatives.by_ad(other.transition))


@pytest.mark.parametrize("factor", [1.01, 1.0 + 1e-8])
def test_derivatives_of_other_dynamics_are_told_from_a_problems_own(factor):
    assert own_derivatives_agree(other_derivatives(1.0))
    assert not own_derivatives_agree(other_derivatives(factor))


@pytest.mark.parametrize(("factor", "certified"), [(1.0, True), (1.001, False)])
def test_implicit_gradients_with_derivatives_of_other_dynamics_are_not_certified(factor, certified):
    found = certificate_of(other_derivatives(factor), 0.5, (0.0, 0.3, 0.4))
    assert found.certificate.certified is certified
    assert certified or "own derivatives are not those of its dynamics" in str(found.certificate)


def test_implicit_gradients_of_quadratic_programs_are_those_that_tests_for_kinks_confirm():
    quadratic = PLAIN | {"dynamics": S + U, "stage_cost": (U - P) ** 2 + S**2, "action_bounds": (-0.1, np.inf)}
    far = ca.fmax(U - 1e3, 0)  # a kink that is never met
    problems = [OCP.from_expressions(**quadratic | {"stage_cost": quadratic["stage_cost"] + more}) for more in (0, far)]
    at_once, confirmed = (certificate_of(each, 0.7, (0.0, 0.3, 0.4)) for each in problems)
    assert at_once.certificate.certified
    assert confirmed.certificate.certified
    assert at_once.certificate.kink <= confirmed.certificate.kink < 1e-5
    np.testing.assert_allclose(at_once.gradient, confirmed.gradient, rtol=1e-12)


@pytest.mark.parametrize(
    ("changed", "quadratic"),
    [
        ({}, True),
        ({"dynamics": P * S + U}, True),
        ({"path_constraint": S - P * U}, True),
        ({"state_bounds": (-P, P)}, True),
        ({"initial_bounds": (-P, P)}, True),
        ({"action_bounds": (-P, P)}, True),
        ({"terminal_cost": ca.exp(P) * S**2}, False),  # in doubt: no polynomial
        ({"stage_cost": S**2 * U}, False),
        ({"dynamics": S + U * S}, False),
        ({"path_constraint": S * S - 1}, False),
        ({"terminal_equality": S * S - 1}, False),
    ],
    ids=str,
)
def test_a_problem_is_a_quadratic_program_where_costs_are_quadratic_and_all_else_is_affine(changed, quadratic):
    problem = OCP.from_expressions(**PLAIN | {"stage_cost": (U - P) ** 2 + P * S * U, "terminal_cost": S**2} | changed)
    assert quadratic_program(problem) is quadratic


def test_the_adjoint_of_a_quadratic_program_is_the_same_beside_its_solution():
    problem = OCP.from_expressions(**PLAIN, stage_cost=(U - P) ** 2 + S**2, action_bounds=(-0.1, np.inf))
    found = certificate_of(problem, 0.7, (0.0, 0.3, 0.4))
    assert found.certificate.change == 0
    smoothed = certificate_of(problem, 0.7, (0.0, 0.3, 0.4), solver=Riccati().with_barrier(1e-3))
    assert 0 < smoothed.certificate.change < 1e-4


@pytest.mark.parametrize("option", ["is_diff_in", "is_diff_out"])
def test_a_function_that_is_told_to_have_no_derivative_is_not_taken_for_a_polynomial(option):
    """CasADi takes zero for its derivative: the gradient would be zero, and the slopes of the loss are not."""
    p = ca.MX.sym("p")
    square = ca.Function("square", [p], [p**2], {option: [False], "never_inline": True})
    assert not is_quadratic(ca.Function("f", [p], [2 * square(p)]))
    s, u = ca.MX.sym("s"), ca.MX.sym("u")
    stated = {"state": s, "action": u, "parameters": p, "dynamics": s + u, "stage_cost": (u - square(p)) ** 2}
    problem = OCP.from_expressions(horizon=2, **stated)
    seen = Demonstration(np.ones(1), np.zeros(0), np.array([[1.0], [0.5], [1.0]]))
    for method in (Implicit(policy="flag"), Unrolled(GradientDescent(50, 0.1), policy="flag")):
        assert not method(problem, seen, [0.7]).certificate.certified


@pytest.mark.parametrize(
    ("problem", "p"),
    [
        ({"dynamics": S + 1e8 * (P - 0.7) * U, "stage_cost": (U - 1) ** 2}, 0.7 + 1e-8),
        ({"dynamics": S + U, "stage_cost": (1 + 1e16 * (P - 0.7) ** 2) * (U - 1) ** 2}, 0.7 + 1e-8),
        ({"dynamics": S + U + 1e10 * (P - 0.7) ** 2 * S, "stage_cost": (U - P) ** 2}, 0.7),
    ],
    ids=["product", "weight", "growth"],
)
def test_polynomials_that_are_as_steep_in_psi_as_a_sigmoid_are_not_taken_for_harmless(problem, p):
    """Within a millionth of psi the steps diverge, or the slopes are others."""
    stated = PLAIN | problem | {"terminal_cost": (S - 1) ** 2}
    seen = Demonstration(np.ones(1), np.zeros(0), np.array([[1.0], [0.5], [1.0]]))
    for method in (Implicit(policy="flag"), Unrolled(GradientDescent(100, 0.1), policy="flag")):
        assert not method(OCP.from_expressions(**stated), seen, [p]).certificate.certified


@pytest.mark.parametrize(("steepness", "certified"), [(1e2, True), (1e8, False)])
def test_a_plan_that_turns_within_a_millionth_of_psi_has_no_certified_derivative_though_its_adjoint_sees_none(
    steepness, certified
):
    """At psi = 0.7 actions move nothing, and no condition with a weight; beside it they move all."""
    stated = PLAIN | {"dynamics": S + steepness * (P - 0.7) * U, "stage_cost": (U - 0.2) ** 2 + (S - 1) ** 2}
    problem = OCP.from_expressions(**stated, terminal_cost=(S - 0.3) ** 2)
    seen = Demonstration(np.ones(1), np.zeros(0), np.array([[1.0], [0.5], [1.0]]))
    found = Implicit(policy="flag")(problem, seen, [0.7])
    assert found.gradient[0] == pytest.approx(0.2 * steepness, rel=1e-8)
    assert found.certificate.certified is certified


@pytest.mark.parametrize(("beside", "certified"), [(1e-7, False), (1e-3, True)])
def test_a_minimum_that_ends_within_a_millionth_of_psi_has_no_certified_derivative(beside, certified):
    """(p - q) u^2 / 2 - u has its minimum at 1 / (p - q), and none below q; at fixed u all of it is linear in p."""
    stated = PLAIN | {"dynamics": S + U, "stage_cost": (P - 0.7 + beside) * U**2 / 2 - beside * U}
    seen = Demonstration(np.ones(1), np.zeros(0), np.array([[1.0], [0.5], [1.0]]))
    found = Implicit(policy="flag")(OCP.from_expressions(**stated | {"terminal_cost": 0 * S}), seen, [0.7])
    assert found.certificate.certified is certified
    assert found.gradient[0] == pytest.approx(-11 / beside, rel=1e-6)
