"""Solvers that know the stages against Ipopt, on a table of problems; real-time iterations; what they do when stuck."""

import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import casadi as ca
import kkt_in_c
import numpy as np
import pytest
from problems import TABLE, integrator, network, swing_up

from kpirl_ocp import OCP, Fatrop, Ipopt, Riccati, Status, Trajectory
from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.conditions.audit import audit
from kpirl_ocp.ocp.interior_point.machine_code import machine_code
from kpirl_ocp.ocp.problem.solver import solve_and_linearise
from kpirl_ocp.ocp.sensitivity import sensitivity
from kpirl_ocp.ocp.sensitivity.kkt_system import Instance, KKTSystem
from kpirl_ocp.ocp.sensitivity.solution_arrays import arrays_of, as_row
from kpirl_ocp.ocp.solvers.child_process import ChildProcess

SOLVERS = {"riccati": (Riccati(), 1e-8, 1e-6), "fatrop": (Fatrop(), 1e-6, 1e-4)}  # solver, objective, multipliers


def given(name):
    case = TABLE[name]()
    return case.problem, case.demonstration.s0, case.psi, case.demonstration.context


@lru_cache
def reference(name):
    return Ipopt().solve(*given(name)).raise_if_failed()


@lru_cache
def solution(name):
    return Riccati().solve(*given(name)).raise_if_failed()


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("name", TABLE)
def test_solvers_agree_on_objective_trajectory_and_multipliers(name, solver):
    method, on_objective, on_multipliers = SOLVERS[solver]
    found, expected = method.solve(*given(name)), reference(name)
    assert found.status is Status.CONVERGED
    np.testing.assert_allclose(found.objective, expected.objective, rtol=on_objective)
    np.testing.assert_allclose(found.actions, expected.actions, rtol=0, atol=on_multipliers)
    for kind, multipliers in vars(expected.multipliers).items():
        scale = max(1.0, np.abs(multipliers).max(initial=0.0))
        np.testing.assert_allclose(
            getattr(found.multipliers, kind), multipliers, rtol=0, atol=on_multipliers * scale, err_msg=kind
        )


@pytest.mark.parametrize("name", TABLE)
def test_residuals_that_riccati_reports_are_those_of_the_audit(name):
    problem, _, psi, context = given(name)
    found = solution(name)
    audited = audit(problem, psi, context, found.trajectory, found.multipliers)
    assert max(found.residuals.worst, audited.worst) <= 1e-10
    assert audited.scale == pytest.approx(found.residuals.scale, rel=1e-12)


@pytest.mark.parametrize("name", TABLE)
def test_solution_is_its_own_warm_start(name):
    again = Riccati().solve(*given(name), guess=solution(name))
    assert again.status is Status.CONVERGED
    assert again.iterations <= 5
    np.testing.assert_allclose(again.objective, solution(name).objective, rtol=1e-8)


def test_trajectory_as_a_guess_needs_no_dynamics_in_it():
    problem, s0, psi, context = given("swing-up")
    states = np.linspace(s0, [np.pi, 0.0], problem.horizon + 1)
    guess = Trajectory(states, np.zeros((problem.horizon, 1)))
    found = Riccati().solve(problem, s0, psi, context, guess=guess)
    assert found.status is Status.CONVERGED
    assert found.states[-1, 0] == pytest.approx(np.pi, abs=0.1)


@pytest.mark.parametrize("name", ["lqr", "pendulum"])
def test_real_time_iterations_are_newton_steps_that_converge_quadratically(name):
    problem, s0, psi, context = given(name)
    guess, residuals = solution(name), []
    for _ in range(3):
        guess = Riccati(steps=1).solve(problem, 1.02 * np.asarray(s0), psi, context, guess=guess)
        assert guess.iterations == 1
        np.testing.assert_allclose(guess.states[0], 1.02 * np.asarray(s0), rtol=1e-15)
        residuals.append(guess.residuals.worst)
    assert residuals[0] < 1e-2
    assert all(after <= max(10 * before**2, 1e-14) for before, after in pairwise(residuals))


def test_real_time_iterations_track_a_moving_start_close_to_the_solutions():
    problem, s0, psi, context = given("tanh network")
    tau, start = 1e-3, np.array(s0)
    tracker = Riccati(steps=1, barrier=tau)
    follow = Riccati(barrier=tau).solve(problem, start, psi, context)
    for _ in range(20):
        start = start + np.r_[np.full(4, 0.005), np.full(3, 0.002), np.zeros(3)]
        follow = tracker.solve(problem, start, psi, context, guess=follow)
        assert follow.status.ok
    exact = Riccati(barrier=tau).solve(problem, start, psi, context)
    assert np.abs(follow.actions - exact.actions).max() < 1e-3
    assert follow.objective == pytest.approx(exact.objective, rel=1e-4)


def test_one_call_of_several_steps_equals_several_calls_of_one_without_inequalities():
    problem, s0, psi, context = given("pendulum")
    start = Trajectory(np.tile(s0, (problem.horizon + 1, 1)), np.zeros((problem.horizon, 1)))
    together = Riccati(steps=3).solve(problem, s0, psi, context, guess=start)
    apart = start
    for _ in range(3):
        apart = Riccati(steps=1).solve(problem, s0, psi, context, guess=apart)
    np.testing.assert_allclose(together.actions, apart.actions, rtol=0, atol=1e-13)
    assert together.iterations == 3


def test_riccati_ends_on_relu_with_a_truthful_status():
    case = network("relu")
    found = Riccati(max_iterations=60).solve(case.problem, case.demonstration.s0, case.psi, case.demonstration.context)
    assert found.status in (Status.CONVERGED, Status.ITERATION_LIMIT, Status.STALLED)
    assert (found.status is Status.CONVERGED) == (found.residuals.worst <= 1e-10)
    assert np.isfinite(found.objective)


UNITS = 10.0 ** np.arange(-6, 7, 3)


@pytest.mark.parametrize("unit", UNITS)
def test_unit_of_the_cost_does_not_change_the_actions(unit):
    case = integrator()
    problem = case.problem
    s, u, psi, c, d = (ca.SX.sym(str(i), problem.stage_cost.size1_in(i)) for i in range(5))
    scaled = replace(
        problem,
        stage_cost=ca.Function("l", [s, u, psi, c, d], [unit * problem.stage_cost(s, u, psi, c, d)]),
        terminal_cost=ca.Function("l_T", [s, psi, c, d], [unit * problem.terminal_cost(s, psi, c, d)]),
    )
    solver = Riccati(tolerance=min(1e-10, 1e-10 * unit))  # the smallest is what rounding leaves of feasibility
    found = solver.solve(scaled, case.demonstration.s0, case.psi, case.demonstration.context)
    assert found.status.ok
    np.testing.assert_allclose(found.actions, solution("integrator").actions, rtol=0, atol=1e-6)


@pytest.mark.parametrize("solver", [Riccati(), Fatrop()], ids=str)
def test_infeasible_problem_is_not_called_converged(solver):
    case = integrator()
    problem = replace(case.problem, state_bounds=([2.0, -0.6], [3.0, 0.6]))  # the mass cannot be there in one step
    found = solver.solve(problem, case.demonstration.s0, case.psi, case.demonstration.context)
    assert found.status in (Status.INFEASIBLE, Status.FAILED)
    assert found.residuals.feasibility > 0.1


def terminal_equality(horizon):
    """Bring a double integrator to rest at 1 exactly, with the least effort."""
    s, u = ca.SX.sym("s", 2), ca.SX.sym("u")
    late = ca.SX.sym("late")
    return OCP.from_expressions(
        state=s,
        action=u,
        stage=late,
        dynamics=ca.vertcat(s[0] + 0.1 * s[1], s[1] + 0.1 * u),
        stage_cost=u**2,
        terminal_cost=0 * s[0],
        path_constraint=ca.vertcat(late * (s[0] - 1), late * (1 - s[0])) - 1e-9 + 1e-300 * u,  # with u: not at s_T
        schedule=np.eye(horizon + 1)[:, horizon - 1 : horizon],
        horizon=horizon,
    )


def test_two_sided_path_constraint_acts_as_an_equality():
    problem = terminal_equality(20)
    found, expected = (solver.solve(problem, [0.0, 0.0]) for solver in (Riccati(), Ipopt()))
    assert found.status is Status.CONVERGED
    assert found.states[19, 0] == pytest.approx(1.0, abs=1e-8)
    np.testing.assert_allclose(found.objective, expected.objective, rtol=1e-6)


def test_state_that_is_fixed_all_the_time_is_kept_exactly():
    case = integrator()
    problem = replace(case.problem, path_constraint=None, state_bounds=([-np.inf, 0.0], [np.inf, 0.0]))
    found = Riccati().solve(problem, case.demonstration.s0, case.psi, case.demonstration.context)
    assert found.status is Status.CONVERGED
    np.testing.assert_allclose(found.states[:, 1], 0, rtol=0, atol=1e-10)
    np.testing.assert_allclose(found.actions, 0, rtol=0, atol=1e-9)


@pytest.mark.parametrize("arguments", [{"tolerance": 0.0}, {"barrier": -1.0}, {"max_iterations": 0}, {"steps": 0}])
def test_impossible_settings_are_refused(arguments):
    with pytest.raises(ProblemError):
        Riccati(**arguments)


def test_swing_up_is_found_from_rest_by_a_step_that_needs_regularisation():
    case = swing_up()
    found = Riccati().solve(case.problem, case.demonstration.s0, case.psi, case.demonstration.context)
    assert found.status is Status.CONVERGED
    assert found.states[-1, 0] == pytest.approx(np.pi, abs=0.1)


@pytest.mark.skipif(not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="there is no C compiler")
@pytest.mark.parametrize("name", ["lqr", "integrator", "pendulum", "swing-up", "tanh network"])
def test_machine_code_gives_the_numbers_of_the_virtual_machine_to_the_last_bit(name):
    numbers = given(name)
    for solver in (Riccati(), Riccati(barrier=1e-3), Riccati(steps=1, barrier=1e-3)):
        one, other = (replace(solver, compile=wish).solve(*numbers) for wish in (False, True))
        assert (one.status, one.iterations, one.objective) == (other.status, other.iterations, other.objective)
        np.testing.assert_array_equal(one.states, other.states)
        np.testing.assert_array_equal(one.actions, other.actions)


@pytest.mark.skipif(not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="there is no C compiler")
@pytest.mark.parametrize("name", ["integrator", "tanh network"])
def test_problem_that_is_solved_often_is_compiled_in_the_background(name, monkeypatch):
    monkeypatch.setattr("kpirl_ocp.ocp.interior_point.machine_code._OFTEN", 0)
    numbers = given(name)
    problem = replace(numbers[0])  # one that nobody has solved
    results = [Riccati().solve(problem, *numbers[1:]) for _ in range(2)]
    code = machine_code(problem)
    code.wait()
    assert code.addresses() is not None
    results.append(Riccati().solve(problem, *numbers[1:]))
    for result in results[1:]:
        np.testing.assert_array_equal(result.actions, results[0].actions)


def test_without_a_compiler_problems_are_solved_without_a_word(monkeypatch, recwarn):
    monkeypatch.setattr("kpirl_ocp.ocp.codegen.compiler.find_compiler", lambda: None)
    monkeypatch.setattr("kpirl_ocp.ocp.interior_point.machine_code._OFTEN", 0)
    problem, *numbers = given("integrator")
    for _ in range(2):
        assert Riccati().solve(replace(problem), *numbers).status is Status.CONVERGED
    assert not [warning for warning in recwarn if "compiler" in str(warning.message)]


@pytest.mark.parametrize("name", ["integrator", "tanh network"])
def test_second_derivatives_are_handed_over_where_a_solve_ended_with_them(name):
    problem, *given_here = given(name)
    s0, psi, context = problem.inputs(*given_here)
    found, derivatives = Riccati().solve_and_linearise(problem, s0, psi, context)
    np.testing.assert_array_equal(found.actions, Riccati().solve(problem, s0, psi, context).actions)
    instance = Instance(problem, s0, psi, context)
    system, row = KKTSystem(instance), as_row(arrays_of(problem, found))
    kkt_in_c.declared("kkt_set_solution", 2)(system.address, row)
    fresh = kkt_in_c.derivatives_of(kkt_in_c.linearise(instance, system.point))
    kept = derivatives.numbers.copy()
    parts = np.split(kept, np.cumsum([len(part) for part in fresh]))
    for one, other in zip(parts, [*fresh, []], strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-13 * max(1.0, np.abs(other).max(initial=0.0)))
    assert Riccati(steps=1).solve_and_linearise(problem, s0, psi, context, guess=found)[1] is None
    np.testing.assert_array_equal(derivatives.numbers, kept)


def test_solvers_that_end_without_second_derivatives_hand_over_none():
    problem, *numbers = given("lqr")
    found, derivatives = solve_and_linearise(Ipopt(), problem, *numbers)
    assert found.status is Status.CONVERGED
    assert derivatives is None


def test_solutions_share_no_memory():
    problem, s0, psi, context = given("integrator")
    one = Riccati().solve(problem, s0, psi, context)
    kept = one.actions.copy()
    other = Riccati().solve(problem, s0 + np.array([0.3, 0.0]), psi, context)
    np.testing.assert_array_equal(one.actions, kept)
    assert np.abs(other.actions - kept).max() > 1e-3


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a system without fork")
@pytest.mark.filterwarnings("ignore:.*fork:RuntimeWarning", "ignore:.*fork:DeprecationWarning")  # JAX, of other tests
def test_a_forked_process_solves_and_differentiates_with_the_numbers_of_its_parent():
    problem, *arguments = given("integrator")
    expected = Riccati().solve(problem, *arguments)
    slopes = np.ones_like(expected.states), np.ones_like(expected.actions)
    gradient = sensitivity(problem, expected, "flag").pull(*slopes).psi
    child = os.fork()
    if child == 0:
        found = Riccati().solve(problem, *arguments)
        same = np.array_equal(found.actions, expected.actions)
        same = same and np.array_equal(sensitivity(problem, found, "flag").pull(*slopes).psi, gradient)
        os._exit(0 if same else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_the_process_of_fatrop_imports_the_package_that_its_parent_imports(tmp_path, monkeypatch):
    """Not other sources in the working directory, as those of an unpacked archive."""
    (tmp_path / "kpirl_ocp").mkdir()
    (tmp_path / "kpirl_ocp/__init__.py").write_text("raise ImportError('not this one')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("kpirl_ocp.ocp.solvers.fatrop._CHILD", ChildProcess())
    assert Fatrop().solve(*given("integrator")).status.ok


def test_threads_solve_at_the_same_time_without_meeting():
    problem, s0, psi, context = given("integrator")
    starts = [s0 + np.array([shift, 0.0]) for shift in np.linspace(-0.3, 0.3, 16)]

    def solve(start):
        return [Riccati().solve(problem, start, psi, context).actions for _ in range(5)]

    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(solve, starts))
    for start, found in zip(starts, together, strict=True):
        expected = Riccati().solve(problem, start, psi, context).actions
        for actions in found:
            np.testing.assert_array_equal(actions, expected)


@pytest.mark.parametrize("field", ["dynamics", "state", "action", "path"])
def test_multipliers_of_another_problem_are_refused(field):
    problem, *numbers = given("integrator")
    multipliers = replace(solution("integrator").multipliers, **{field: np.zeros((3, 7))})
    with pytest.raises(ProblemError, match=f"multipliers.{field} must be"):
        Riccati().solve(problem, *numbers, guess=replace(solution("integrator"), multipliers=multipliers))


def test_log_shows_every_iteration(capfd):
    found = replace(Riccati(), verbose=True).solve(*given("integrator"))
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 1 + found.iterations
    assert float(lines[-1].split()[1]) == pytest.approx(found.objective, rel=1e-7)


@pytest.mark.parametrize("barrier", [0.0, 1e-3])
def test_an_entry_whose_bounds_coincide_is_an_equality_to_the_audit(barrier):
    """Also with a barrier: its slack is zero, whatever tau is."""
    s, u = ca.SX.sym("s"), ca.SX.sym("u", 2)
    problem = OCP.from_expressions(
        state=s,
        action=u,
        horizon=3,
        dynamics=s + u[0] + u[1],
        stage_cost=(s - 2) ** 2 + ca.sumsqr(u),
        action_bounds=([0.3, -1], [0.3, 1]),
    )
    found = Riccati(barrier=barrier).solve(problem, [0])
    measured = audit(problem, found.psi, found.context, found.trajectory, found.multipliers, barrier)
    assert found.status is Status.CONVERGED
    assert max(measured.worst, measured.complementarity, found.residuals.worst) < 1e-9
    assert (np.abs(found.multipliers.action[:-1, 0]) > 0.1).all()
    moved = replace(found.trajectory, actions=found.actions + np.array([0.1, 0]))
    assert audit(problem, found.psi, found.context, moved, found.multipliers, barrier).feasibility > 0.09


@pytest.mark.parametrize("side", [-1, 1])
def test_a_wrong_multiplier_of_a_bound_on_both_sides_shows_by_the_slack_of_the_nearer_one(side):
    """With a barrier both sides push, and the farther one, whose slack is large, is known best: with tau / slack."""
    s, u, tau, off = ca.SX.sym("s"), ca.SX.sym("u"), 1e-3, 1e-4
    given = {"state": s, "action": u, "horizon": 1, "dynamics": s, "action_bounds": (-1, 1)}
    problem = OCP.from_expressions(**given, stage_cost=(u - 3 * side) ** 2)
    found = Riccati(barrier=tau).solve(problem, [0])
    wrong = replace(found.multipliers, action=found.multipliers.action + off)
    at = problem, found.psi, found.context, found.trajectory
    assert audit(*at, found.multipliers, tau).complementarity < 1e-10
    slack = 1 - abs(found.actions[0, 0])
    assert slack < 1e-3
    assert audit(*at, wrong, tau).complementarity == pytest.approx(off * slack, rel=1e-3)
