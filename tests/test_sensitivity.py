"""The derivative of a solution: closed forms, differences of solutions, a dense KKT matrix; and its certificate."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from functools import lru_cache

import casadi as ca
import numpy as np
import pytest
import statements
from dense_kkt import derivative, unknowns
from kkt_in_c import derivatives_of, linearise
from problems import TABLE, ScalarLQR, lqr, quadratic, response
from reference.problems import minimum_time

from kpirl_ocp import OCP, Implicit, Ipopt, Riccati, Status, Trajectory, sensitivity
from kpirl_ocp.errors import CertificateError, ProblemError
from kpirl_ocp.irl.hypergradients.implicit import differentiate
from kpirl_ocp.ocp.problem.layout import pack
from kpirl_ocp.ocp.sensitivity.kkt_system import at_solution

S, U = ca.SX.sym("s"), ca.SX.sym("u")
ROWS = [*((name, 0.0) for name in TABLE), ("integrator", 1e-3), ("tanh network", 1e-4)]


@lru_cache
def solved(name, barrier=0.0):
    case = TABLE[name]()
    solver, seen = Riccati(tolerance=1e-11), case.demonstration
    solver = solver.with_barrier(barrier) if barrier else solver
    return case, solver.solve(case.problem, seen.s0, case.psi, seen.context).raise_if_failed()


def slopes(solution, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=solution.states.shape), rng.normal(size=solution.actions.shape)


def directions(case, seed=1):
    rng, seen = np.random.default_rng(seed), case.demonstration
    return {
        name: rng.normal(size=len(x)) for name, x in (("psi", case.psi), ("s0", seen.s0), ("context", seen.context))
    }


@pytest.mark.parametrize("data", [ScalarLQR(), ScalarLQR(a=1.1, b=-0.4, psi=(0.3, 1.5, 0.8))], ids=str)
def test_both_products_are_the_closed_form_of_a_scalar_lqr(data):
    case, (F, G), (H, g, dH, dg) = lqr(data), response(data), quadratic(data)
    solution = Riccati(tolerance=1e-12).solve(case.problem, case.demonstration.s0, case.psi)
    u = -np.linalg.solve(H, g)
    by_psi, by_start = -np.linalg.solve(H, (dH @ u + dg).T), -np.linalg.solve(H, g) / data.s0  # (T, 3), (T,)
    at = sensitivity(case.problem, solution)
    for direction, expected in zip(np.eye(3), by_psi.T, strict=True):
        found = at.push(psi=direction)
        np.testing.assert_allclose(found.actions[:, 0], expected, rtol=1e-12, atol=1e-13)
        np.testing.assert_allclose(found.states[:, 0], [0.0, *(G @ expected)], rtol=1e-12, atol=1e-13)
    moved = at.push(s0=[1.0])
    np.testing.assert_allclose(moved.actions[:, 0], by_start, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(moved.states[:, 0], [1.0, *(F + G @ by_start)], rtol=1e-12, atol=1e-13)
    by_states, by_actions = (slope[:, 0] for slope in slopes(solution))
    pulled = at.pull(by_states[:, None], by_actions[:, None])
    total = by_actions + by_states[1:] @ G
    np.testing.assert_allclose(pulled.psi, total @ by_psi, rtol=1e-11)
    np.testing.assert_allclose(pulled.s0, [by_states[0] + by_states[1:] @ F + total @ by_start], rtol=1e-11)


@pytest.mark.parametrize(("name", "barrier"), ROWS)
def test_both_products_are_those_of_the_dense_kkt_matrix(name, barrier):
    case, solution = solved(name, barrier)
    dense = derivative(case.problem, solution)
    at = sensitivity(case.problem, solution)
    by_states, by_actions = slopes(solution)
    pulled, moves = at.pull(by_states, by_actions), directions(case)
    expected = np.concatenate([by_states[1:].ravel(), by_actions.ravel()]) @ dense
    gradients = np.concatenate([pulled.psi, pulled.s0 - by_states[0], pulled.context])
    np.testing.assert_allclose(gradients, expected, rtol=0, atol=1e-8 * np.abs(expected).max())
    pushed = at.push(**moves)
    expected = dense @ np.concatenate(list(moves.values()))
    np.testing.assert_allclose(
        unknowns(case.problem, pushed.states, pushed.actions), expected, rtol=0, atol=1e-8 * np.abs(expected).max()
    )
    np.testing.assert_array_equal(pushed.states[0], moves["s0"])
    assert pulled.certificate.certified
    assert pushed.certificate.certified
    assert pulled.certificate.barrier == pushed.certificate.barrier == barrier


@pytest.mark.parametrize("name", ["integrator", "iiwa at a limit", "swing-up", "tanh network"])
@pytest.mark.parametrize("part", ["psi", "s0", "context"])
def test_tangents_equal_differences_of_solutions_at_some_step(name, part):
    case, solution = solved(name)
    numbers = {"s0": case.demonstration.s0, "psi": case.psi, "context": case.demonstration.context}
    direction = directions(case)[part]
    found = pack(sensitivity(case.problem, solution).push(**{part: direction}))
    errors = []
    for h in (1e-3, 1e-4, 1e-5):
        ends = [
            Ipopt(tolerance=1e-12).solve(
                case.problem, **(numbers | {part: numbers[part] + sign * h * direction}), guess=solution
            )
            for sign in (1, -1)
        ]
        slope = (pack(ends[0].trajectory) - pack(ends[1].trajectory)) / (2 * h)
        errors.append(np.abs(slope - found).max() / max(np.abs(slope).max(), 1e-9))
    assert min(errors) < 1e-6


@pytest.mark.parametrize("name", TABLE)
def test_products_are_adjoint_to_each_other(name):
    case, solution = solved(name)
    at, moves, (by_states, by_actions) = sensitivity(case.problem, solution), directions(case), slopes(solution)
    pushed, pulled = at.push(**moves), at.pull(by_states, by_actions)
    one = np.sum(by_states * pushed.states) + np.sum(by_actions * pushed.actions)
    other = sum(getattr(pulled, name) @ move for name, move in moves.items())
    np.testing.assert_allclose(one, other, rtol=1e-8)


def beside(solution, length):
    """The solution with a plan that is off by a relative length."""
    rng, size = np.random.default_rng(5), length * max(np.abs(solution.states).max(), np.abs(solution.actions).max())
    states, actions = (x + size * rng.normal(size=x.shape) for x in (solution.states, solution.actions))
    return replace(solution, trajectory=Trajectory(np.array([solution.states[0], *states[1:]]), actions))


@pytest.mark.parametrize("length", [1e-7, 1e-6, 1e-5])
@pytest.mark.parametrize("name", TABLE)
def test_gradients_beside_a_solution_are_those_at_it(name, length):
    case, solution = solved(name)
    near, by = beside(solution, length), slopes(solution)
    expected, found = (sensitivity(case.problem, at).pull(*by) for at in (solution, near))
    assert 1e-8 < found.certificate.distance < 100 * length
    for part in ("psi", "s0", "context"):
        scale = np.abs(getattr(expected, part)).max(initial=0)
        np.testing.assert_allclose(getattr(found, part), getattr(expected, part), rtol=0, atol=3e-8 * scale)


@pytest.mark.parametrize("name", TABLE)
def test_the_kkt_system_beside_a_solution_has_the_derivatives_of_the_point_to_which_a_newton_step_leads(name):
    case, solution = solved(name)
    system = at_solution(case.problem, beside(solution, 1e-7))
    found, expected = derivatives_of(system), derivatives_of(linearise(system.instance, system.point))
    for part in ("gradient", "F", "G", "E", "H"):
        np.testing.assert_array_equal(getattr(found, part), getattr(expected, part))


@pytest.mark.parametrize("name", ["lqr", "integrator", "tanh network"])
def test_the_implicit_gradient_is_the_pull_of_the_slope_of_its_loss(name):
    case, solution = solved(name)
    problem, seen = case.problem, case.demonstration
    states = ca.MX.sym("S", problem.n_states, problem.horizon + 1)
    loss = ca.sumsqr(problem.observe(states) - seen.observations.T)
    by_states = np.array(ca.Function("slope", [states], [ca.densify(ca.gradient(loss, states))])(solution.states.T)).T
    found = sensitivity(problem, solution).pull(by_states, np.zeros(solution.actions.shape))
    expected = differentiate(problem, seen, solution)
    np.testing.assert_allclose(found.psi, expected.gradient, rtol=1e-12)
    for field in fields(found.certificate):
        one, other = (getattr(c, field.name) for c in (found.certificate, expected.certificate))
        if isinstance(one, float):
            np.testing.assert_allclose(one, other, rtol=1e-2, atol=1e-9)
    np.testing.assert_allclose(
        Implicit(Riccati(tolerance=1e-11))(problem, seen, case.psi).gradient, found.psi, rtol=1e-8
    )


STATED = list(statements.CASES)


@lru_cache
def stated(name):
    case = statements.CASES[name]()
    return case.problem, case.arguments, Ipopt(tolerance=1e-11).solve(case.problem, *case.arguments).raise_if_failed()


@pytest.mark.parametrize("name", STATED)
def test_every_statement_has_both_products_of_the_dense_kkt_matrix_and_their_certificates(name):
    problem, _, solution = stated(name)
    dense, at = derivative(problem, solution), sensitivity(problem, solution)
    (by_states, by_actions), free, rng = slopes(solution), problem.free_start, np.random.default_rng(2)
    expected = unknowns(problem, by_states, by_actions) @ dense
    pulled = at.pull(by_states, by_actions)
    found = np.concatenate([pulled.psi, np.where(free, 0, pulled.s0 - by_states[0]), pulled.context])
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max(initial=0.0))
    assert not pulled.s0[free].any()
    sizes = problem.n_parameters, problem.n_states, problem.n_context
    moves = [rng.normal(size=size) for size in sizes]
    moves[1][free] = 0.0
    pushed = at.push(*moves)
    expected = dense @ np.concatenate(moves)
    found = unknowns(problem, pushed.states, pushed.actions)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max(initial=0.0))
    assert pulled.certificate.certified
    assert pushed.certificate.certified


@pytest.mark.parametrize("name", ["terminal equality", "path equality", "bounds of parameters", "partly free start"])
def test_the_tangent_of_a_statement_equals_differences_of_its_solutions(name):
    problem, (s0, *numbers), solution = stated(name)
    direction = np.where(problem.free_start, 0.0, np.random.default_rng(4).normal(size=problem.n_states))
    found = pack(sensitivity(problem, solution).push(s0=direction))
    errors = []
    for h in (1e-3, 1e-4, 1e-5):
        ends = [
            Ipopt(tolerance=1e-12).solve(problem, s0 + k * h * direction, *numbers, guess=solution) for k in (1, -1)
        ]
        slope = (pack(ends[0].trajectory) - pack(ends[1].trajectory)) / (2 * h)
        errors.append(np.abs(slope - found).max() / np.abs(slope).max())
    assert min(errors) < 1e-6


def test_more_active_constraints_than_decisions_are_refused():
    """Minimum time from rest to rest: every action is at its bound, and two equalities hold besides."""
    case = minimum_time(6)
    solution = Riccati().solve(case.problem, case.s0, guess=case.guess).raise_if_failed()
    with pytest.raises(CertificateError, match="depend on each other"):
        sensitivity(case.problem, solution).push(s0=np.ones(case.problem.n_states))


def test_a_direction_of_length_zero_changes_nothing_and_is_certified():
    case, solution = solved("integrator")
    at = sensitivity(case.problem, solution)
    pushed = at.push()
    assert not pushed.states.any()
    assert not pushed.actions.any()
    assert pushed.certificate.certified
    pulled = at.pull(np.zeros(solution.states.shape), np.zeros(solution.actions.shape))
    assert not pulled.psi.any()
    assert pulled.certificate.certified


def test_the_slope_by_the_initial_state_itself_is_added():
    case, solution = solved("integrator")
    at, (by_states, by_actions) = sensitivity(case.problem, solution), slopes(solution)
    more = by_states + np.eye(len(by_states))[0][:, None]
    np.testing.assert_allclose(at.pull(more, by_actions).s0, at.pull(by_states, by_actions).s0 + 1, rtol=1e-12)


def capped():
    """min (u - p)^2 with u <= 1/2: its solution min(p, 1/2) has a kink at p = 1/2."""
    s, u, psi = ca.SX.sym("s"), ca.SX.sym("u"), ca.SX.sym("psi")
    return OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        dynamics=s + u,
        stage_cost=(u - psi) ** 2,
        horizon=1,
        action_bounds=(-np.inf, 0.5),
    )


@pytest.mark.parametrize("product", ["pull", "push"])
def test_derivative_that_does_not_exist_is_refused_or_flagged(product):
    problem = capped()
    solution = Riccati().solve(problem, [0.0], [0.5])
    arguments = ([[0.0], [0.0]], [[1.0]]) if product == "pull" else ([1.0],)
    with pytest.raises(CertificateError, match="weakly active") as caught:
        getattr(sensitivity(problem, solution), product)(*arguments)
    flagged = getattr(sensitivity(problem, solution, policy="flag"), product)(*arguments).certificate
    assert not flagged.certified
    assert caught.value.certificate.failures == flagged.failures


@pytest.mark.parametrize("product", ["pull", "push"])
def test_what_is_no_solution_for_its_parameters_has_no_certified_derivative(product):
    case, solution = solved("integrator")
    at = sensitivity(case.problem, replace(solution, psi=1.1 * solution.psi), policy="flag")
    found = at.pull(*slopes(solution)) if product == "pull" else at.push(**directions(case))
    assert "A Newton step still moves the solution" in str(found.certificate)


def test_solution_that_did_not_converge_has_no_certified_derivative():
    case = TABLE["integrator"]()
    seen = case.demonstration
    solution = Riccati(max_iterations=2).solve(case.problem, seen.s0, case.psi, seen.context)
    assert solution.status is Status.ITERATION_LIMIT
    with pytest.raises(CertificateError, match="did not converge"):
        sensitivity(case.problem, solution).push(psi=np.ones(case.problem.n_parameters))


def test_slopes_that_are_nan_give_nan_and_say_so():
    case, solution = solved("integrator")
    by_states, by_actions = slopes(solution)
    by_states[3, 0] = np.nan
    found = sensitivity(case.problem, solution, policy="flag").pull(by_states, by_actions)
    assert all(np.isnan(part).all() for part in (found.psi, found.s0, found.context))
    assert "NaN" in str(found.certificate)


def from_start(cost, start, least):
    """Gradients by s_0 of the sum of all states and actions, of a problem without psi and context."""
    problem = OCP.from_expressions(
        state=S,
        action=U,
        dynamics=0.9 * S + U,
        stage_cost=cost,
        terminal_cost=S**2,
        action_bounds=(least, 1),
        horizon=4,
    )
    solution = Riccati().solve(problem, [start])
    return solution, sensitivity(problem, solution, "flag").pull(np.ones((5, 1)), np.ones((4, 1)))


@pytest.mark.parametrize("step", [1e-3, 1e-2, 1e-1])
def test_a_quadratic_program_without_parameters_has_no_kink_and_the_slope_of_its_differences(step):
    cost = (S - 0.2) ** 2 + S * U + 3 * U**2
    (at, found), (beside, _) = (from_start(cost, start, -0.3) for start in (1.0, 1.0 + step))
    assert found.certificate.certified
    assert found.certificate.kink == 0.0
    assert 0 < found.certificate.active.sum() < 4
    change = beside.states.sum() + beside.actions.sum() - at.states.sum() - at.actions.sum()
    np.testing.assert_allclose(found.s0, change / step, rtol=1e-8)


@pytest.mark.parametrize(("start", "certified"), [(1.0, False), (1.1, True)])
def test_a_kink_in_the_initial_state_of_a_problem_without_parameters_is_flagged(start, certified):
    _, found = from_start(S**2 + ca.fabs(S - 1) * U + U**2, start, -1)
    assert found.certificate.certified == certified
    assert ("kink" in str(found.certificate)) != certified


def test_arguments_of_another_shape_are_refused():
    case, solution = solved("integrator")
    at, (by_states, by_actions) = sensitivity(case.problem, solution), slopes(solution)
    with pytest.raises(ProblemError, match=r"\(T\+1, n_s\)"):
        at.pull(by_states[1:], by_actions)
    with pytest.raises(ProblemError, match="psi must have length"):
        at.push(psi=np.ones(99))
    with pytest.raises(ProblemError, match="policy must be one of raise, flag"):
        sensitivity(case.problem, solution, policy="smooth")
    with pytest.raises(ProblemError, match=r"states must be .* of another problem"):
        sensitivity(TABLE["pendulum"]().problem, solution)
    short = replace(solution.multipliers, action=solution.multipliers.action[1:])
    with pytest.raises(ProblemError, match=r"solution's multipliers\.action must be"):
        sensitivity(case.problem, replace(solution, multipliers=short))


def test_solutions_know_what_they_were_solved_for_even_if_the_caller_changes_its_arrays():
    case = TABLE["integrator"]()
    seen, psi = case.demonstration, case.psi.copy()
    solution = Riccati().solve(case.problem, seen.s0, psi, seen.context)
    psi[:] = np.nan
    np.testing.assert_array_equal(solution.psi, case.psi)
    np.testing.assert_array_equal(solution.context, seen.context)


def test_threads_and_more_problems_than_are_kept_get_the_numbers_of_one_thread():
    def of_one(number):
        case = ScalarLQR(psi=(0.3 + 0.01 * number, 1.5, 0.8))
        problem = lqr(case).problem
        solution = Riccati().solve(problem, [case.s0], case.psi)
        return lambda: sensitivity(problem, solution).pull(*slopes(solution)).psi

    products = [of_one(number) for number in range(70) for _ in range(4)]
    with ThreadPoolExecutor(8) as pool:
        together = list(pool.map(lambda product: product(), products))
    np.testing.assert_array_equal(together, [product() for product in products])


@pytest.mark.parametrize(("off", "certified"), [(1e-6, True), (1e-3, False)])
def test_an_acceptable_solution_is_certified_only_near_the_point_that_is_differentiated(off, certified):
    """Newton steps lead from both to the same point, but a solver that stops a thousandth away has promised more."""
    case, solution = solved("integrator")
    moved = Trajectory(solution.states, solution.actions * (1 + off))
    stopped = replace(solution, trajectory=moved, status=Status.ACCEPTABLE)
    found = sensitivity(case.problem, stopped, "flag").pull(np.ones_like(moved.states), np.ones_like(moved.actions))
    assert found.certificate.certified is certified
    assert certified or "acceptable" in str(found.certificate)


@pytest.mark.parametrize(("p", "certified"), [(1e-4, True), (1e-8, True), (1e-10, False), (1e-12, False)])
def test_no_solution_is_taken_to_be_known_better_than_to_a_billionth_of_its_decisions(p, certified):
    """u = sqrt(p) at the minimum of u^3 / 3 - p u, beside an action of one: 1e-9 of both change du/dp by 1e-9 / u."""
    weight, stage = ca.SX.sym("p"), ca.SX.sym("d")
    cost = (1 - stage) * (U - 1) ** 2 + stage * (U**3 / 3 - weight * U)
    given = {"state": S, "action": U, "parameters": weight, "stage": stage, "horizon": 2, "dynamics": S}
    problem, u = OCP.from_expressions(**given, stage_cost=cost, schedule=[[0], [1], [0]]), np.sqrt(p)
    plan = Riccati().solve(problem, [0], [p], guess=Trajectory(np.zeros((3, 1)), [[1.0], [u]]))
    found = sensitivity(problem, plan, "flag").pull(np.zeros((3, 1)), [[0.0], [1.0]])
    np.testing.assert_allclose(found.psi, 1 / (2 * u), rtol=1e-12)
    np.testing.assert_allclose(found.certificate.change, np.sqrt(2) * 1e-9 / u, rtol=1e-2)
    assert found.certificate.certified is certified


@pytest.mark.parametrize(("slack", "others_off"), [(1.0, 0.0), (1.0, 1e-3), (3.0, 0.0), (3.0, 1e-3)])
def test_newton_steps_do_not_cross_a_barrier(slack, others_off):
    """The minimum of p u - tau log u is at tau / p. From 3 tau / p a Newton step leads to -3 tau / p, where the second
    derivative is the same; beside a longer step of another action it is a short one."""
    u, p, tau = ca.SX.sym("u", 2), ca.SX.sym("p"), 1e-10
    bounds = [0, -np.inf], [np.inf, np.inf]
    given = {"state": S, "action": u, "parameters": p, "horizon": 1, "dynamics": S, "action_bounds": bounds}
    problem = OCP.from_expressions(**given, stage_cost=p * u[0] + (u[1] - 1) ** 2 / 2)
    plan = Riccati(barrier=tau).solve(problem, [0], [1], guess=Trajectory(np.zeros((2, 1)), [[tau, 1.0]]))
    moved = Trajectory(plan.states, np.array([[slack * tau, 1.0 + others_off]]))
    at = sensitivity(problem, replace(plan, trajectory=moved), "flag")
    found = at.pull(np.zeros((2, 1)), [[1.0, 0.0]])
    assert at.plan[1] == pytest.approx(slack * tau)
    assert found.certificate.certified is (slack == 1.0)
    assert not found.certificate.certified or found.psi[0] == pytest.approx(-tau)
