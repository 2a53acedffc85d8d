"""Wrong statements and arguments of a problem are refused in one sentence that names what is wrong."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from statements import CASES, NUMBERS, PLAIN, C, P, Q, S, U, state

from kpirl_ocp import (
    LBFGS,
    OCP,
    SQP,
    Adam,
    Demonstration,
    Descent,
    Fatrop,
    GradientDescent,
    Ipopt,
    Riccati,
    Soft,
    Status,
    Trajectory,
    discretise,
)
from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.hypergradients import demonstrated_observations

X = ca.MX.sym("x")
SX = ca.SX.sym("v", 2)
STATEMENTS = {
    "state of numbers": ({"state": np.zeros(2)}, "state must be a symbol, casadi.SX.sym or casadi.MX.sym, got array"),
    "state of words": ({"state": "s"}, "state must be a symbol"),
    "action of an expression": ({"action": 2 * U}, "action must be a column of symbols"),
    "context of a matrix": (
        {"context": ca.MX.sym("c", 3, 2)},
        r"context must be a column of symbols, got MX\(c\) of shape \(3, 2\): use ca.reshape\(column, 3, 2\) of one",
    ),
    "action of numbers": ({"action": 3.0}, "action must be of the kind of the state, casadi.MX, got 3.0"),
    "context of another kind": ({"context": SX}, "context must be of the kind of the state, casadi.MX"),
    "dynamics of words": ({"dynamics": "s + u"}, "dynamics must be a casadi.MX like the state, got 's \\+ u'"),
    "dynamics of another kind": ({"dynamics": SX}, "dynamics must be a casadi.MX like the state"),
    "unknown symbol": ({"dynamics": S + X}, "dynamics depends on x: its symbols are not among"),
    "unknown symbol in an equality": ({"terminal_equality": S[0] - X}, "terminal_equality depends on x: "),
    "action at the end": ({"terminal_constraint": U}, "terminal_constraint depends on u: "),
    "action in the observation": ({"observation": U}, "observation depends on u: "),
    "one symbol twice": ({"parameters": U}, "u is among both action and parameters: a symbol has one place"),
    "one symbol twice in a column": (
        {"state": ca.vertcat(SX[0], SX[1], SX[0]), "action": None, "dynamics": ca.vertcat(SX, 0)},
        "state holds v_0 more than once: a symbol has one place",
    ),
    "masked schedule": (
        {"stage": P, "schedule": np.ma.masked_equal(np.arange(13.0)[:, None], 3.0)},
        "schedule must be an array of numbers; 1 of them masked",
    ),
    "masked bound": (
        {"state_bounds": (np.ma.masked_less(np.array([-1.0, 1.0]), 0), 3)},
        "state_bounds must be an array of numbers; 1 of them masked",
    ),
    "bounds of three pairs": (
        {"state_bounds": [(-1, 1), (-2, 2), (-3, 3)]},
        r"state_bounds must be \(lower, upper\), not a pair for every entry, got \[\(-1, 1\), ",
    ),
    "bounds of digits": ({"action_bounds": ("-1", "1")}, "action_bounds must be an array of numbers, got '-1'"),
    "soft as a row": ({"soft": Soft(S.T, 1.0)}, r"soft.constraint must be a column, got the shape \(1, 2\)"),
    "soft at any price": ({"soft": Soft(S[0], np.inf)}, "soft.linear must not be negative, nor infinity or NaN"),
    "static that is a parameter": (
        {"parameters": Q, "static": Q, "terminal_cost": Q},
        "q is among both parameters and static",
    ),
    "stage without a schedule": ({"stage": P}, r"a column for every number of the stage, \(13, 1\), got none"),
    "schedule without a stage": ({"schedule": np.zeros((13, 2))}, r"of the stage, \(13, 0\), got \(13, 2\)"),
    "no cost": ({"stage_cost": None}, "stage_cost must be a casadi.Function, got None"),
    "horizon of words": ({"horizon": "ten"}, "horizon must be a whole number of at least 1 step .*, got 'ten'"),
    "huge horizon": ({"horizon": 10**18}, "horizon must be a whole number .* at most 1000000"),
    "horizon that is true": ({"horizon": True}, "horizon must be a whole number"),
    "schedule of words": ({"schedule": "late"}, "schedule must be an array of numbers, got 'late'"),
    "ragged schedule": ({"schedule": [[1], [1, 2]]}, "schedule must be an array of numbers"),
    "path equality as a matrix": ({"path_equality": S @ S.T}, "path_equality must take column vectors"),
    "terminal equality as a row": ({"terminal_equality": S.T}, "terminal_equality must take column vectors"),
    "bounds of a step too many": ({"action_bounds": (-1, np.arange(13.0)[:, None])}, r"action_bounds must be \(lower"),
    "bounds of words": ({"action_bounds": ("low", 1)}, "action_bounds must be an array of numbers, got 'low'"),
    "a pair of bounds for every entry": (
        {"state_bounds": [(-1, 1), (-1, 1)]},
        r"state_bounds must be \(lower, upper\), each \(2,\) or \(13, 2\), not a pair for every entry",
    ),
    "one bound": ({"state_bounds": 1.0}, r"state_bounds must be \(lower, upper\), not a pair for every entry, got 1.0"),
    "ragged bounds": ({"state_bounds": ([[1], [1, 2]], 3)}, "state_bounds must be an array of numbers"),
    "bound of an unknown symbol": ({"action_bounds": (-1, X)}, "action_bounds depends on x: bounds may depend on"),
    "bound of the state": ({"action_bounds": (-1, S[0])}, "action_bounds depends on s: bounds may depend on"),
    "bound of another length": (
        {"parameters": P, "state_bounds": (-1, ca.vertcat(P, P, P))},
        "must have length 2 or 1",
    ),
    "start that no value is left for": (
        {"initial_bounds": (0, 1), "state_bounds": (2, 3)},
        "initial_bounds and row 0 of state_bounds must leave s_0 some value",
    ),
    "start bounded the wrong way round": ({"initial_bounds": (1, 0)}, "initial_bounds must be numbers: no lower"),
    "start bounded stage by stage": ({"initial_bounds": (np.zeros((13, 2)), 1)}, None),
    "bounds without actions": ({"action": None, "dynamics": S, "stage_cost": 0, "action_bounds": (-1, 1)}, None),
    "static that nothing uses": ({"static": Q}, r"static\[0\] is used nowhere"),
    "static of an expression": ({"static": 2 * Q, "terminal_cost": Q}, "static must be a column of symbols"),
    "bounds of no static": ({"static_bounds": (0, 1)}, "static_bounds must be left out"),
    "static bounds of another length": (
        {"static": Q, "terminal_cost": Q, "static_bounds": ([0, 1], 2)},
        "static_bounds",
    ),
    "soft without a price": ({"soft": Soft(S[0])}, "soft needs a linear or quadratic price above zero"),
    "soft with a negative price": ({"soft": Soft(S[0], -1.0)}, "soft.linear must not be negative"),
    "soft with prices for others": ({"soft": Soft(S[0], [1.0, 2.0])}, "soft.linear must have length 1"),
    "soft with a price of the state": ({"soft": Soft(S[0], S[1] ** 2)}, "soft.linear depends on s"),
    "soft as an expression": ({"soft": S[0]}, r"soft must be a Soft\(constraint"),
    "rows in a list": (
        {"path_constraint": [S[0], U]},
        "a casadi.MX like the state, .*: put its entries into one column",
    ),
    "an inequality with its sign": (
        {"path_constraint": S[0] <= 1},
        "holds a relation, .* at most zero, a - b for a <= b",
    ),
    "one of several rows with its sign": (
        {"terminal_constraint": ca.vertcat(S[0], ca.vertcat(S[1] - 1, S[0] > 1))},
        "terminal_constraint holds a relation",
    ),
    "an equality with its sign": ({"terminal_equality": S == 1}, "holds a relation, .* to be zero, a - b for a == b"),
    "a soft inequality with its sign": ({"soft": Soft(S[0] <= 1, 1.0)}, "soft.constraint holds a relation"),
    "soft of words": ({"soft": Soft("s", 1.0)}, "soft.constraint must be a casadi.MX"),
}
SENTENCES = {
    "start bounded stage by stage": "initial_bounds must be (lower, upper), each a number or (2,).",
    "bounds without actions": "action_bounds must be left out: there is nothing to bound, the shape is (12, 0).",
}


@pytest.mark.parametrize("name", STATEMENTS)
def test_a_wrong_statement_is_refused_in_one_sentence(name):
    changes, message = STATEMENTS[name]
    with pytest.raises(ProblemError, match=message) as caught:
        state(**changes)
    text = str(caught.value)
    assert "\n" not in text
    assert text.endswith(".") or "CasADi says" in text
    assert text == SENTENCES.get(name, text)


FUNCTIONS = {
    "dynamics of words": ({"dynamics": "f"}, "dynamics must be a casadi.Function, got 'f'"),
    "dynamics of two inputs": (
        {"dynamics": ca.Function("f", [S, U], [S])},
        r"dynamics must be f\(s, u, psi, c, d\) or",
    ),
    "terminal equality of the action": (
        {"terminal_equality": ca.Function("e", [S, U, P, C], [S])},
        "terminal_equality must take column vectors",
    ),
    "path constraint of words": ({"path_constraint": 3}, "path_constraint must be a casadi.Function, got 3"),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_that_does_not_fit_is_refused(name):
    changes, message = FUNCTIONS[name]
    with pytest.raises(ProblemError, match=message):
        replace(state(), **changes)


BAD = {
    "words": "abc",
    "ragged": [[1.0], [1.0, 2.0]],
    "a matrix": np.zeros((2, 2)),
    "too long": np.zeros(7),
    "nothing": None,
    "complex": [1j, 0],
}


@pytest.mark.parametrize("value", BAD)
@pytest.mark.parametrize("name", ["s0", "psi", "context"])
def test_a_wrong_argument_of_a_solve_is_refused_by_name(name, value):
    problem = CASES["context and schedule in the dynamics"]().problem
    arguments = {"s0": [0.0, 0.0], "psi": NUMBERS, "context": [1.7]} | {name: BAD[value]}
    with pytest.raises(ProblemError, match=f"^{name} must (be|have)"):
        Ipopt().solve(problem, **arguments)


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
def test_relations_inside_an_expression_are_no_relations_of_a_constraint(kind):
    s, u = kind.sym("s", 2), kind.sym("u")
    inside = ca.vertcat(ca.if_else(s[0] < 1, s[1], u), (s[0] > 1) * u - 1)
    assert OCP.from_expressions(state=s, action=u, dynamics=s, horizon=2, path_constraint=inside).n_path == 2
    with pytest.raises(ProblemError, match="path_constraint holds a relation"):
        OCP.from_expressions(state=s, action=u, dynamics=s, horizon=2, path_constraint=ca.vertcat(u, s[0] <= 1))


SETTINGS = {
    "a number in words": (lambda: Riccati("1e-8"), "tolerance of Riccati must be a number, got '1e-8'"),
    "CasADi's options": (lambda: Ipopt({"ipopt.max_iter": 3}), "tolerance of Ipopt must be a number, got {'ipopt"),
    "half a program": (lambda: SQP(max_iterations=2.5), "max_iterations of SQP must be a whole number, got 2.5"),
    "a limit in words": (lambda: Fatrop(time_limit="1 s"), "time_limit of Fatrop must be a number"),
    "half a step": (lambda: Riccati(steps=1.5), "steps of Riccati must be a whole number, got 1.5"),
    "a step size that is true": (lambda: GradientDescent(5, True), "step_size of GradientDescent must be a number"),
    "a way uphill": (lambda: Descent(-0.1), "learning_rate must be a number above 0, got -0.1"),
    "no learning": (lambda: Adam(0), "learning_rate must be a number above 0, got 0"),
    "a first step that is unknown": (lambda: LBFGS(first_step=np.nan), "first_step must be a number above 0, got nan"),
}


@pytest.mark.parametrize("name", SETTINGS)
def test_a_setting_that_is_none_is_refused_by_name(name):
    make, message = SETTINGS[name]
    with pytest.raises(ProblemError, match=message):
        make()


EVERY = [Riccati(), Ipopt(), Fatrop(), SQP(), GradientDescent()]


@pytest.mark.parametrize("guess", [np.zeros((12, 1)), "guess", 3])
@pytest.mark.parametrize("solver", EVERY, ids=lambda solver: type(solver).__name__)
def test_a_guess_that_is_no_trajectory_is_refused(solver, guess):
    with pytest.raises(ProblemError, match="guess must be a Solution or a Trajectory"):
        solver.solve(state(), [0.0, 0.0], guess=guess)


@pytest.mark.parametrize("solver", [Ipopt(), Fatrop()], ids=str)
def test_numbers_that_are_not_finite_or_huge_end_in_a_status(solver):
    problem, arguments, _ = CASES["bounds of parameters"]()
    known = [0.05, 0.3]
    for s0, psi in (([np.nan, 0], known), ([0, 0.3], [0.05, np.nan]), ([np.inf, 0], known), ([1e300, 0], known)):
        found = solver.solve(problem, s0, psi)
        assert found.status is Status.NOT_FINITE
    nowhere = Trajectory(np.full((13, 2), np.nan), np.zeros((12, 1)))
    assert solver.solve(problem, *arguments, guess=nowhere).status is Status.NOT_FINITE


def test_a_guess_of_another_problem_is_refused():
    small = Ipopt().solve(state(), [0.0, 0.0])
    bounded = state(terminal_equality=S)
    with pytest.raises(ProblemError, match=r"the guess's multipliers\.terminal_equality must be \(2,\), got \(0,\)"):
        Ipopt().solve(bounded, [0.0, 0.0], guess=small)
    with pytest.raises(ProblemError, match="states must be"):
        Ipopt().solve(state(horizon=11), [0.0, 0.0], guess=small)


@pytest.mark.parametrize("name", CASES)
def test_gradient_descent_refuses_what_it_would_ignore(name):
    problem, arguments, _ = CASES[name]()
    with pytest.raises(ProblemError, match=r"^gradient descent "):
        GradientDescent(project=True).solve(problem, *arguments)


def test_slacks_without_their_constraint_are_refused():
    with pytest.raises(ProblemError, match="state the problem without `soft`"):
        state(soft=Soft(S[0], 1.0)).unconstrained()


ODE = ca.vertcat(S[1], U - S[0])
V = ca.SX.sym("s", 2)
DISCRETE = {
    "unknown method": ({"method": "euler"}, "method must be one of rk4, midpoint"),
    "no intervals": ({"intervals": 0}, "intervals and degree must be at least 1"),
    "no step": ({"step": 0}, "step must not be 0: the state would never change"),
    "algebraic variables alone": ({"algebraic": X}, "algebraic and residual must be given together"),
    "algebraic variables in rk4": ({"algebraic": X, "residual": X}, "knows no algebraic variables"),
}


@pytest.mark.parametrize("name", DISCRETE)
def test_a_discretisation_that_does_not_fit_is_refused(name):
    changes, message = DISCRETE[name]
    with pytest.raises(ProblemError, match=message):
        discretise(ODE, S, **{"step": 0.1, **changes})
    with pytest.raises(ProblemError, match=r"ode must have the shape of the state, \(2, 1\), got \(1, 1\)"):
        discretise(ODE[0], S, step=0.1)
    with pytest.raises(ProblemError, match="method 'collocation' needs"):
        discretise(V, V, step=0.1, method="collocation")


def test_derivatives_by_hand_are_refused_where_the_dynamics_see_the_stage():
    problem = CASES["context and schedule in the dynamics"]().problem
    with pytest.raises(ProblemError, match="derivatives must be left out"):
        replace(problem, derivatives=problem.dynamics_derivatives)


def test_a_demonstration_may_leave_out_added_states():
    problem = CASES["free final time"]().problem
    seen = Demonstration([0.0, 0.0], [], np.zeros((13, 2)))
    np.testing.assert_array_equal(
        problem.inputs(seen.s0, NUMBERS, [])[0], [0, 0, 5.05]
    )  # the middle of the bounds of q
    assert problem.n_observations == 2
    assert OCP.from_expressions(**PLAIN).n_observations == 2


def test_trajectories_may_leave_out_added_states_and_actions():
    problem = CASES["soft constraints"]().problem
    plan = Trajectory(np.ones((13, 2)), np.ones((12, 1)))
    np.testing.assert_array_equal(problem.as_states(plan.states), np.tile([1, 1, 0], (13, 1)))
    np.testing.assert_array_equal(problem.as_actions(plan.actions), np.tile([1, 0, 0], (12, 1)))
    np.testing.assert_array_equal(problem.stated(Trajectory(problem.as_states(plan.states), plan.actions)).states, 1)


def test_a_demonstration_without_a_context_is_not_called_one_that_is_not_finite():
    with pytest.raises(ProblemError, match="the demonstration's context must be an array of numbers, got NoneType"):
        Demonstration([0.0], None, [[0.0], [1.0]])


def test_states_in_the_place_of_observations_are_recognised():
    problem = state(static=Q, static_bounds=(0, 1), terminal_cost=Q**2)
    plan = Riccati().solve(problem, [0.0, 0.0])
    with pytest.raises(ProblemError, match=r"\(13, 2\), got \(13, 3\): these may be states, whose observations are"):
        demonstrated_observations(problem, Demonstration([0.0, 0.0], [], plan.states))
    seen = Demonstration([0.0, 0.0], [], problem.observe(plan.states.T).full().T)
    np.testing.assert_array_equal(demonstrated_observations(problem, seen).T, problem.stated(plan).states)
