"""Whatever can be stated, against an independent statement of the same problem in CasADi's Opti."""

import pickle
from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np
import pytest
from problems import TABLE
from statements import CASES, GRID, NUMBERS, TWO, D, S, T, U, state
from statements_opti import optimum

from kpirl_ocp import OCP, SQP, Fatrop, Ipopt, Riccati, Soft, Status, discretise
from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.conditions.audit import audit

case_of = lru_cache(lambda name: CASES[name]())
# Solver, tolerance on the objective and, ten times that, on the plan. Fatrop moves bounds outwards by 1e-8, and gives
# up on soft constraints at a residual of 1e-7. SQP needs a rough plan to find the final time.
ROWS = [(name, solver, 1e-8) for name in CASES for solver in (Riccati(), Ipopt(), SQP())]
ROWS += [(name, Fatrop(1e-6 if name == "soft constraints" else 1e-8), 1e-5) for name in CASES]


@pytest.mark.parametrize(("name", "solver", "atol"), ROWS, ids=str)
def test_solution_is_that_of_an_independent_statement(name, solver, atol):
    problem, arguments, _ = case_of(name)
    objective, states, actions = optimum(case_of(name))
    rough = isinstance(solver, SQP) and name == "free final time"
    guess = Ipopt(1e-2).solve(problem, *arguments).trajectory if rough else None
    found = solver.solve(problem, *arguments, guess=guess)
    assert found.status is Status.CONVERGED
    np.testing.assert_allclose(found.objective, objective, rtol=0, atol=atol)
    np.testing.assert_allclose(problem.stated(found).states, states, rtol=0, atol=10 * atol)
    np.testing.assert_allclose(problem.stated(found).actions, actions, rtol=0, atol=10 * atol)


@pytest.mark.parametrize("name", CASES)
def test_a_problem_is_pickled_before_and_after_use(name):
    problem, arguments, _ = CASES[name]()
    before = pickle.loads(pickle.dumps(problem))
    found = Ipopt().solve(problem, *arguments)
    for copy in (before, pickle.loads(pickle.dumps(problem))):
        np.testing.assert_array_equal(Ipopt().solve(copy, *arguments).states, found.states)


@pytest.mark.parametrize("name", CASES)
def test_a_solution_is_a_guess_from_which_nothing_moves(name):
    problem, arguments, _ = case_of(name)
    found = Ipopt().solve(problem, *arguments)
    again = Ipopt().solve(problem, *arguments, guess=found)
    assert again.status is Status.CONVERGED
    assert again.iterations <= 5
    np.testing.assert_allclose(again.states, found.states, rtol=0, atol=1e-8)
    psi, context = problem.inputs(*arguments, *[()] * (3 - len(arguments)))[1:]
    assert audit(problem, psi, context, found.trajectory, found.multipliers).worst <= 1e-10


# Rules of a statement that the table does not show


def test_with_a_price_above_the_multiplier_a_soft_constraint_is_the_hard_one():
    hard = Ipopt().solve(state(path_constraint=S[0] - 0.5), [0.0, 0.0])
    price = 1.1 * max(hard.multipliers.path.max(), hard.multipliers.terminal.max())
    problem = state(soft=Soft(S[0] - 0.5, linear=price))
    found = Ipopt().solve(problem, [0.0, 0.0])
    np.testing.assert_allclose(problem.stated(found).states, hard.states, rtol=0, atol=1e-8)
    cheap = state(soft=Soft(S[0] - 0.5, linear=0.1 * price))
    assert cheap.stated(Ipopt().solve(cheap, [0.0, 0.0])).states[:, 0].max() > 0.55


def test_bounds_are_the_same_as_numbers_and_as_expressions():
    numbers = state(action_bounds=(-0.5, 0.7), state_bounds=(-1.0, [0.5, 0.3]))
    expressions = state(parameters=TWO, action_bounds=(-0.5, TWO[0]), state_bounds=(-1.0, ca.vertcat(0.5, TWO[1])))
    one, other = Ipopt().solve(numbers, [0.0, 0.35]), Ipopt().solve(expressions, [0.0, 0.35], [0.7, 0.3])
    assert one.status is other.status is Status.CONVERGED  # s_0 is beyond its bound either way
    np.testing.assert_allclose(one.states, other.states, rtol=0, atol=1e-8)
    np.testing.assert_array_equal(np.array(expressions.state_bounds)[1, 1:, 0], 0.5)  # a number stays a bound
    assert (numbers.n_path, expressions.n_path) == (0, 2)


def test_rows_that_do_not_depend_on_the_action_hold_at_the_end():
    problem = state(
        path_constraint=ca.vertcat(U - 1, S[0] - 1, S[1] + U, S[1] - 2), terminal_constraint=S[0] - S[1] - 3
    )
    np.testing.assert_array_equal(problem.state_rows, [1, 3])
    values = problem.terminal_inequality([0.3, 0.7], [], [], [])
    np.testing.assert_allclose(np.array(values).ravel(), [0.3 - 1, 0.7 - 2, 0.3 - 0.7 - 3])


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
def test_rows_that_zeros_and_ones_of_the_schedule_switch_off_leave_an_interior(kind):
    s, u, d = kind.sym("s"), kind.sym("u"), kind.sym("d", 2)
    rows = ca.vertcat(d[0] * (s - 1), (1 - d[1]) * u, s - d[1], d[0] * s + u, d[0] * s + (d[1] - 1) * u)
    problem = OCP.from_expressions(
        state=s,
        action=u,
        stage=d,
        dynamics=s + u,
        path_constraint=rows,
        path_equality=d[0] * d[1] * u,
        schedule=[[0, 0], [2, 1], [0, 1], [3, 0.5]],
        horizon=3,
    )
    found = np.array(problem.path(np.full((1, 4), 0.3), np.full((1, 3), 0.7), [], [])).T
    expected = [[-1, 0.7, 0.3, 0.7, -0.7], [2 * -0.7, -1, -0.7, 1.3, 0.6], [-1, -1, -0.7, 0.7, -1]]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(problem.live.path_equality, [[0], [1], [0]])
    last = np.array(problem.terminal_inequality([0.3], [], [], [3, 0.5])).ravel()  # of the rows 0 and 2
    np.testing.assert_allclose(last, [3 * -0.7, 0.3 - 0.5])
    again = replace(problem, horizon=3)
    np.testing.assert_array_equal(np.array(again.path(np.full((1, 4), 0.3), np.full((1, 3), 0.7), [], [])).T, found)


@pytest.mark.parametrize("solver", [Riccati(), Ipopt(), Fatrop(), SQP()], ids=lambda solver: type(solver).__name__)
def test_a_row_that_is_switched_off_pushes_nowhere(solver):
    late = np.arange(T + 1)[:, None] >= 6
    found = solver.solve(state(stage=D, path_constraint=D * (S[0] - 0.4), schedule=late), [0.0, 0.0])
    assert found.status is Status.CONVERGED
    np.testing.assert_allclose(found.multipliers.path[:6], 0, rtol=0, atol=1e-7)
    bounds = np.where(late, [0.4, np.inf], np.inf)
    expected = Ipopt().solve(state(state_bounds=(-np.inf, bounds)), [0.0, 0.0])
    np.testing.assert_allclose(found.states, expected.states, rtol=0, atol=1e-6)


def test_bounds_survive_another_horizon_where_they_are_the_same_at_every_stage():
    problem = state(action_bounds=(-1, 2), state_bounds=(-3, [4, 5]))
    longer = replace(problem, horizon=20)
    np.testing.assert_array_equal(longer.action_bounds[1], np.full((20, 1), 2.0))
    np.testing.assert_array_equal(longer.state_bounds[1], np.tile([4.0, 5.0], (21, 1)))


@pytest.mark.parametrize(
    ("bounds", "start"),
    [
        ((1, 4), 2.5),
        ((-np.inf, 3), 0),
        ((0.1, 10), 5.05),
        ((-np.inf, np.inf), 0),
        ((-1, np.inf), 0),
        ((0, np.inf), 1),
        ((2, np.inf), 3),
        ((-np.inf, -2), -3),
    ],
    ids=str,
)
def test_a_static_decision_that_s0_omits_starts_between_its_bounds_and_on_none(bounds, start):
    q = ca.MX.sym("q")
    problem = state(static=q, static_bounds=bounds, terminal_cost=q**2)
    s0, *_ = problem.inputs([1, 2], (), ())
    np.testing.assert_array_equal(s0, [1, 2, start])
    s0, *_ = problem.inputs([1, 2, 4], (), ())
    np.testing.assert_array_equal(s0, [1, 2, 4])


@pytest.mark.parametrize("bounds", [(0, np.inf), (0, 10)], ids=str)
def test_a_lap_in_free_time_needs_no_guess(bounds):
    """CasADi's example of a race car, whose speed limit depends on the place; the shortest time as by Ipopt."""
    s, u, q = ca.SX.sym("s", 2), ca.SX.sym("u"), ca.SX.sym("q")
    lap = OCP.from_expressions(
        state=s,
        action=u,
        static=q,
        static_bounds=bounds,
        dynamics=discretise(ca.vertcat(s[1], u - s[1]), s, step=q / 100),
        terminal_cost=q,
        path_constraint=s[1] - 1 + ca.sin(2 * ca.pi * s[0]) / 2,
        action_bounds=(0, 1),
        terminal_equality=s[0] - 1,
        horizon=100,
    )
    assert lap.static_of(Riccati().solve(lap, [0, 0]).raise_if_failed()) == pytest.approx([1.9046340436], abs=1e-9)


def test_dynamics_that_see_the_context_are_simulated_with_it():
    problem = case_of("context and schedule in the dynamics").problem
    actions, expected = np.linspace(1, 2, T)[:, None], [np.zeros(2)]
    for t in range(T):
        speed = expected[-1][1] + GRID[t, 0] * (actions[t, 0] / 1.7 - np.sin(expected[-1][0]))
        expected.append(np.array([expected[-1][0] + GRID[t, 0] * speed, speed]))
    found = problem.simulate([0.0, 0.0], actions, NUMBERS, [1.7])
    np.testing.assert_allclose(found.states, expected, rtol=0, atol=1e-14)
    with pytest.raises(ProblemError, match="context must have length 1, got 0"):
        problem.simulate([0.0, 0.0], actions, NUMBERS)


@pytest.mark.parametrize("name", TABLE)
def test_the_problems_of_the_other_tests_are_pickled_before_and_after_use(name):
    case = TABLE[name]()
    arguments = case.demonstration.s0, case.psi, case.demonstration.context
    found = Riccati().solve(case.problem, *arguments)
    copy = pickle.loads(pickle.dumps(case.problem))
    np.testing.assert_array_equal(Riccati().solve(copy, *arguments).actions, found.actions)
