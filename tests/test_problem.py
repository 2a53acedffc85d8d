"""An OCP against loops in Python, and the errors of an inconsistent one and of meaningless arguments."""

import casadi as ca
import numpy as np
import pytest

from kpirl_ocp import OCP, GradientDescent, Ipopt, Trajectory
from kpirl_ocp.errors import ProblemError

T, N_S, N_U, N_PSI, N_C, N_D, N_H = 4, 3, 2, 2, 1, 2, 2
RNG = np.random.default_rng(0)
SCHEDULE = RNG.normal(size=(T + 1, N_D))
S0, PSI, CONTEXT = RNG.normal(size=N_S), RNG.normal(size=N_PSI), RNG.normal(size=N_C)
STATES, ACTIONS = RNG.normal(size=(T + 1, N_S)), RNG.normal(size=(T, N_U))


def dynamics(s, u, p, lib):
    return [s[0] + lib.sin(p[0] * s[1]) + u[0], 0.5 * s[1] - s[2] * u[1], s[2] + 0.1 * p[1] * u[0] * u[1]]


def stage_cost(s, u, p, c, d, lib):
    return d[0] * s[0] ** 2 + p[0] * d[1] * u[0] ** 2 + lib.cos(s[1] - c[0]) + u[1] ** 4


def terminal_cost(s, p, c, d, lib):
    return d[0] * p[1] * s[1] ** 2 + d[1] * lib.exp(s[2] - c[0])


def path_constraint(s, u, p, c, d, lib):
    return [d[0] * s[0] + u[1] - 1, lib.sin(p[1] * d[1] * u[0]) - c[0]]


def expressions(kind):
    """Arguments of `OCP.from_expressions` in SX or MX."""
    sizes = {"s": N_S, "u": N_U, "psi": N_PSI, "c": N_C, "d": N_D}
    s, u, p, c, d = (kind.sym(name, size) for name, size in sizes.items())
    return {
        "state": s,
        "action": u,
        "parameters": p,
        "context": c,
        "stage": d,
        "dynamics": ca.vertcat(*dynamics(s, u, p, ca)),
        "stage_cost": stage_cost(s, u, p, c, d, ca),
        "terminal_cost": terminal_cost(s, p, c, d, ca),
        "path_constraint": ca.vertcat(*path_constraint(s, u, p, c, d, ca)),
        "observation": ca.vertcat(s[2], s[0] * s[1]),
        "horizon": T,
        "schedule": SCHEDULE,
        "action_bounds": (-3, [3, 4]),
        "state_bounds": ([-5, -np.inf, -7], np.inf),
    }


def build(kind=ca.SX, **changes):
    return OCP.from_expressions(**(expressions(kind) | changes))


@pytest.fixture(params=[ca.SX, ca.MX], ids=["SX", "MX"])
def problem(request):
    return build(request.param)


def test_sizes_are_read_from_the_expressions(problem):
    sizes = problem.n_states, problem.n_actions, problem.n_parameters, problem.n_context, problem.n_path
    assert (*sizes, problem.n_observations) == (N_S, N_U, N_PSI, N_C, N_H, 2)


def test_a_problem_prints_its_sizes_and_no_arrays(problem):
    assert repr(problem) == (
        "<OCP of 4 steps: 3 states, 2 actions, 2 parameters, 1 context number, 2 schedule numbers, 2 bounded states, "
        "2 bounded actions, 2 path constraints>"
    )
    s = ca.SX.sym("s")
    assert repr(OCP.from_expressions(state=s, dynamics=s, horizon=2)) == "<OCP of 2 steps: 1 state>"


def test_rollout_equals_a_loop_in_python_and_is_time_first_from_simulate(problem):
    expected = [S0]
    for u in ACTIONS:
        expected.append(np.array(dynamics(expected[-1], u, PSI, np)))
    trajectory = problem.simulate(S0, ACTIONS, PSI)
    assert trajectory.states.shape == (T + 1, N_S)
    np.testing.assert_allclose(trajectory.states, expected, rtol=1e-14, atol=1e-14)
    np.testing.assert_array_equal(trajectory.actions, ACTIONS)
    np.testing.assert_array_equal(np.array(problem.rollout(S0, ACTIONS.T, PSI, CONTEXT)).T, trajectory.states)


def test_cost_equals_a_loop_in_python_with_row_t_of_the_schedule_at_stage_t(problem):
    stages = [stage_cost(STATES[t], ACTIONS[t], PSI, CONTEXT, SCHEDULE[t], np) for t in range(T)]
    expected = sum(stages) + terminal_cost(STATES[T], PSI, CONTEXT, SCHEDULE[T], np)
    np.testing.assert_allclose(float(problem.cost(STATES.T, ACTIONS.T, PSI, CONTEXT)), expected, rtol=1e-14)


def test_each_stage_sees_its_own_row_of_the_schedule_and_no_other(problem):
    def value(schedule):
        changed = build(schedule=schedule)
        return [float(changed.cost(states.T, ACTIONS.T, PSI, CONTEXT)) for states in at_one_stage]

    at_one_stage = [np.outer(np.arange(T + 1) == t, [1.0, 1.0, 0.0]) for t in range(T + 1)]
    bumped = [np.array(value(SCHEDULE + np.outer(np.arange(T + 1) == t, [1.0, 0.0]))) for t in range(T + 1)]
    # d[0] multiplies s[0]^2 = 1 at a stage and p[1] s[1]^2 = p[1] at the end, wherever the state is not zero
    expected = np.diag([1.0] * T + [PSI[1]])
    np.testing.assert_allclose(bumped - np.array(value(SCHEDULE)), expected, rtol=0, atol=1e-14)


def test_path_constraints_equal_a_loop_in_python(problem):
    expected = [path_constraint(STATES[t], ACTIONS[t], PSI, CONTEXT, SCHEDULE[t], np) for t in range(T)]
    found = np.array(problem.path(STATES.T, ACTIONS.T, PSI, CONTEXT)).T
    np.testing.assert_allclose(found, expected, rtol=1e-14, atol=1e-14)


def test_observation_is_taken_of_every_state(problem):
    expected = np.stack([STATES[:, 2], STATES[:, 0] * STATES[:, 1]])
    np.testing.assert_array_equal(np.array(problem.observe(STATES.T)), expected)


def test_without_an_observation_the_state_is_seen():
    problem = build(observation=None)
    assert problem.n_observations == N_S
    np.testing.assert_array_equal(np.array(problem.observe(STATES.T)).T, STATES)


def test_plain_functions_make_the_same_problem_as_expressions():
    given = build()
    problem = OCP(given.dynamics, given.stage_cost, given.terminal_cost, T, schedule=SCHEDULE)
    np.testing.assert_array_equal(problem.simulate(S0, ACTIONS, PSI).states, given.simulate(S0, ACTIONS, PSI).states)
    arguments = STATES.T, ACTIONS.T, PSI, CONTEXT
    assert float(problem.cost(*arguments)) == float(given.cost(*arguments))
    assert problem.path(*arguments).shape == (0, T)


def test_sx_and_mx_functions_may_be_mixed():
    sx, mx = build(ca.SX), build(ca.MX)
    mixed = OCP(sx.dynamics, mx.stage_cost, sx.terminal_cost, T, schedule=SCHEDULE)
    np.testing.assert_array_equal(mixed.simulate(S0, ACTIONS, PSI).states, sx.simulate(S0, ACTIONS, PSI).states)


def test_bounds_are_broadcast(problem):
    np.testing.assert_array_equal(problem.action_bounds, [[[-3, -3]] * T, [[3, 4]] * T])
    np.testing.assert_array_equal(problem.state_bounds, [[[-5, -np.inf, -7]] * (T + 1), [[np.inf] * 3] * (T + 1)])


def test_unconstrained_removes_bounds_and_path_and_nothing_else(problem):
    free = problem.unconstrained()
    assert problem.has_action_bounds
    assert problem.has_state_constraints
    assert not free.has_action_bounds
    assert not free.has_state_constraints
    assert free.n_path == 0
    np.testing.assert_array_equal(free.simulate(S0, ACTIONS, PSI).states, problem.simulate(S0, ACTIONS, PSI).states)
    arguments = STATES.T, ACTIONS.T, PSI, CONTEXT
    assert float(free.cost(*arguments)) == float(problem.cost(*arguments))


s, x = ca.SX.sym("s", N_S), ca.SX.sym("x")
INCONSISTENT = {  # what is wrong: the change, the message
    "horizon of zero": ({"horizon": 0}, "horizon must be a whole number of at least 1 step.*, got 0"),
    "horizon of two and a half": ({"horizon": 2.5}, "horizon must be a whole number"),
    "one row of the schedule short": ({"schedule": SCHEDULE[1:]}, r"\(T\+1, n_d\) = \(5, n_d\), got \(4, 2\)"),
    "schedule as a vector": ({"schedule": np.zeros(T + 1)}, r"got \(5,\)"),
    "one column of the schedule short": (
        {"schedule": SCHEDULE[:, :1]},
        r"schedule must have a column for every number of the stage, \(5, 2\), got \(5, 1\)",
    ),
    "free symbol in the dynamics": (
        {"dynamics": ca.vertcat(x, x, x)},
        "dynamics depends on x: its symbols are not among",
    ),
    "free symbol in the cost": ({"stage_cost": x}, "stage_cost depends on x: its symbols are not among"),
    "action in the terminal cost": (
        {"terminal_cost": ca.SX.sym("a")},
        "terminal_cost depends on a: its symbols are not among",
    ),
    "free symbol in the path constraint": (
        {"path_constraint": x},
        "path_constraint depends on x: its symbols are not among",
    ),
    "free symbol in the observation": ({"observation": x}, "observation depends on x: its symbols are not among"),
    "SX and MX mixed": (
        {"parameters": ca.MX.sym("p", N_PSI)},
        "parameters must be of the kind of the state, casadi.SX",
    ),
    "dynamics too short": ({"state": s, "dynamics": s[:2]}, "dynamics must .*one column of length 3"),
    "dynamics too long": ({"state": s, "dynamics": ca.vertcat(s, s)}, "dynamics must .*one column of length 3"),
    "cost not a scalar": ({"state": s, "stage_cost": s}, "stage_cost must .*one column of length 1"),
    "terminal cost not a scalar": ({"state": s, "terminal_cost": s}, "terminal_cost must .*one column of length 1"),
    "path constraint as a row": ({"state": s, "path_constraint": s.T}, "path_constraint must .*one column"),
    "observation as a row": ({"state": s, "observation": s.T}, "observation must .*one column"),
    "lower above upper": ({"action_bounds": ([-1, 2], [1, 1])}, "action_bounds must be numbers: no lower bound above"),
    "NaN bound": ({"state_bounds": (np.nan, 1)}, "state_bounds must be numbers"),
    "NaN upper bound": ({"action_bounds": (0, [1, np.nan])}, "action_bounds must be numbers"),
    "bounds of another length": ({"state_bounds": (np.zeros(2), 1)}, r"state_bounds must be .*\(3,\)"),
    "words as bounds": ({"state_bounds": ("low", "high")}, "state_bounds must be an array of numbers, got 'low'"),
    "three bounds": ({"action_bounds": (0, 1, 2)}, r"action_bounds must be \(lower, upper\)"),
}


@pytest.mark.parametrize("case", INCONSISTENT)
def test_an_inconsistent_problem_is_refused(case):
    changes, message = INCONSISTENT[case]
    if "state" in changes:  # the other expressions belong to another symbol
        constant = {"dynamics": s, "stage_cost": ca.SX(0), "terminal_cost": 0.0, "path_constraint": None}
        changes = constant | {"observation": None} | changes
    with pytest.raises(ProblemError, match=message):
        build(**changes)


matrix, row = ca.SX.sym("p", 2, 2), ca.SX.sym("u", 1, 2)
MEANINGLESS = {
    "both bounds infinite": {"action_bounds": (np.inf, np.inf)},
    "one bound": {"action_bounds": 1.0},
    "NaN in the schedule": {"schedule": SCHEDULE * np.nan},
    "psi as a matrix": {"state": s, "parameters": matrix, "observation": None},
    "action as a row": {"state": s, "action": row, "observation": None, "action_bounds": (-1, 1)},
}


@pytest.mark.parametrize("case", MEANINGLESS)
def test_an_argument_nobody_can_mean_is_refused(case):
    changes = MEANINGLESS[case]
    if "state" in changes:
        changes = {"dynamics": s, "stage_cost": ca.SX(0), "terminal_cost": 0.0, "path_constraint": None} | changes
    with pytest.raises(ProblemError):
        build(**changes)


def test_functions_with_swapped_roles_are_refused():
    given = build()
    with pytest.raises(ProblemError, match="dynamics must take"):
        OCP(given.dynamics, given.terminal_cost, given.stage_cost, T, schedule=SCHEDULE)
    with pytest.raises(ProblemError, match=r"dynamics must .* return one column of length 3"):
        OCP(given.stage_cost, given.stage_cost, given.terminal_cost, T, schedule=SCHEDULE)


@pytest.mark.parametrize("solver", [Ipopt(), GradientDescent()], ids=["Ipopt", "GradientDescent"])
@pytest.mark.parametrize("name", ["s0", "psi", "context"])
def test_a_vector_of_the_wrong_length_is_refused_by_name(solver, name):
    vectors = {"s0": S0, "psi": PSI, "context": CONTEXT}
    with pytest.raises(ProblemError, match=f"{name} must have length {len(vectors[name])}, got"):
        solver.solve(build().unconstrained(), **(vectors | {name: np.zeros(len(vectors[name]) + 1)}))


GUESSES = {"actions by columns": (STATES, ACTIONS.T), "a step too few": (STATES, ACTIONS[1:])}


@pytest.mark.parametrize("solver", [Ipopt(), GradientDescent()], ids=["Ipopt", "GradientDescent"])
@pytest.mark.parametrize("guess", GUESSES)
def test_a_guess_of_the_wrong_shape_is_refused(solver, guess):
    with pytest.raises(ProblemError, match=r"actions must be \(T, n_u\) = \(4, 2\), got"):
        solver.solve(build().unconstrained(), S0, PSI, CONTEXT, guess=Trajectory(*GUESSES[guess]))
    with pytest.raises(ProblemError, match=r"states must be \(T\+1, n_s\) = \(5, 3\), got \(4, 3\)"):
        Ipopt().solve(build(), S0, PSI, CONTEXT, guess=Trajectory(STATES[1:], ACTIONS))


OPTIONS = [(GradientDescent, {"steps": 0}), (GradientDescent, {"steps": 1.5}), (GradientDescent, {"step_size": np.nan})]
OPTIONS += [(Ipopt, {"tolerance": 0.0}), (Ipopt, {"max_iterations": 0}), (Ipopt, {"barrier": -1.0})]


@pytest.mark.parametrize(("solver", "option"), OPTIONS, ids=str)
def test_a_meaningless_option_is_refused(solver, option):
    with pytest.raises(ProblemError, match=next(iter(option))):
        solver(**option)
