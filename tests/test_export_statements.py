"""The exported C does all that can be stated: same status, iterations and numbers as Python, and the same gradients."""

import platform
import tempfile
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from exported import STRICT, WARNINGS, built, loaded
from statements import CASES, DT, GRID, T

from kpirl_ocp import OCP, SQP, Riccati, Status
from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.codegen.compiler import EXPORT_FLAGS
from kpirl_ocp.ocp.export import export_c
from kpirl_ocp.ocp.interior_point import library

CONVERGED, BARRIER = Riccati(), 1e-4
CHAOTIC = {"states alone"}  # the number of iterations depends on rounding
_SCRATCH = tempfile.TemporaryDirectory()


@lru_cache
def exported(name, solver=CONVERGED):
    case = CASES[name]()
    problem, (s0, psi, *context) = case.problem, case.arguments
    goal = context[0] if context else ()
    out = Path(_SCRATCH.name) / f"{name}, {type(solver).__name__}".replace(" ", "_")
    return export_c(problem, solver, out, psi=psi, examples=[(s0, goal)]), problem, (s0, psi, goal)


def assert_same(ours, reference, tolerance=1e-9, iterations=True):
    assert ours.status is reference.status
    assert ours.iterations == reference.iterations or not iterations
    parts = [(ours.actions, reference.actions), (ours.states, reference.states)]
    parts += [(getattr(ours.multipliers, n), getattr(reference.multipliers, n)) for n in vars(reference.multipliers)]
    for found, expected in parts:
        np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * max(1, np.abs(expected).max(initial=0)))
    assert ours.objective == pytest.approx(reference.objective, rel=tolerance, abs=tolerance)


@pytest.mark.parametrize("name", CASES)
def test_the_interior_point_method_is_that_of_python(name):
    out, problem, arguments = exported(name)
    ours = loaded(out)
    cold, orderly = CONVERGED.solve(problem, *arguments), name not in CHAOTIC
    assert cold.status is Status.CONVERGED
    assert_same(ours.solve(problem, *arguments), cold, iterations=orderly)
    nearby = (np.array(arguments[0]) + 0.01, *arguments[1:])
    warm = CONVERGED.solve(problem, *nearby, guess=cold)
    assert_same(ours.solve(problem, *nearby, guess=cold), warm, iterations=orderly)


@pytest.fixture
def plain_core(monkeypatch):
    """Python's core as built for every processor of its kind, whose operations are those of a portable export."""
    if platform.machine() not in ("x86_64", "AMD64"):
        pytest.skip("compilers for this processor contract products and sums")
    monkeypatch.setattr(library, "_levels", lambda: [""])
    library.library.cache_clear()
    yield
    library.library.cache_clear()


@pytest.mark.parametrize("name", CASES)
def test_the_same_build_gives_the_same_numbers_to_the_last_bit(name, plain_core):
    out, _, arguments = exported(name)
    problem = CASES[name]().problem  # one whose core was not made yet
    ours, reference = loaded(out).solve(problem, *arguments), CONVERGED.solve(problem, *arguments)
    assert (ours.status, ours.iterations, ours.objective) == (
        reference.status,
        reference.iterations,
        reference.objective,
    )
    np.testing.assert_array_equal(ours.states, reference.states)
    np.testing.assert_array_equal(ours.actions, reference.actions)
    for part in vars(reference.multipliers):
        np.testing.assert_array_equal(getattr(ours.multipliers, part), getattr(reference.multipliers, part))


@pytest.mark.parametrize("name", CASES)
def test_gradients_are_the_differences_of_smoothed_solutions(name):
    """Central differences of the problem with a barrier, at two steps, extrapolated."""
    out, problem, (s0, psi, context) = exported(name)
    ours, rng, solver = loaded(out), np.random.default_rng(2), Riccati(barrier=BARRIER)
    ours.set(barrier=BARRIER)
    numbers = problem.inputs(s0, psi, context)
    plan = solver.solve(problem, *numbers)
    by_states, by_actions = rng.normal(size=plan.states.shape), rng.normal(size=plan.actions.shape)

    def loss(*numbers):
        found = solver.solve(problem, *numbers)
        assert found.status is Status.CONVERGED
        return np.sum(by_states * found.states) + np.sum(by_actions * found.actions)

    def slope(which, step):
        moved = [list(numbers) for _ in range(2)]
        moved[0][which], moved[1][which] = numbers[which] + step, numbers[which] - step
        return (loss(*moved[0]) - loss(*moved[1])) / (2 * np.abs(step).max())

    found, believed = ours.gradient(problem, *numbers, plan, by_states, by_actions)
    assert believed
    for which, key in enumerate(("s0", "psi", "context")):
        steps = 2e-4 * np.eye(len(numbers[which]))
        expected = np.array([(4 * slope(which, step / 2) - slope(which, step)) / 3 for step in steps])
        if key == "s0":
            expected[problem.free_start] = 0.0
        size = max(1, np.abs(expected).max(initial=0))
        np.testing.assert_allclose(getattr(found, key), expected, rtol=0, atol=1e-5 * size)


@pytest.mark.parametrize("name", CASES)
def test_sequential_quadratic_programming_is_that_of_python(name):
    out, problem, arguments = exported(name, SQP())
    found, reference = loaded(out).solve(problem, *arguments), SQP().solve(problem, *arguments)
    assert (found.status, found.iterations) == (reference.status, reference.iterations)
    np.testing.assert_allclose(found.states, reference.states, rtol=0, atol=1e-9)
    for part in vars(reference.multipliers):
        expected = getattr(reference.multipliers, part)
        np.testing.assert_allclose(getattr(found.multipliers, part), expected, rtol=0, atol=1e-7)


@pytest.mark.parametrize("name", CASES)
def test_it_compiles_without_a_word_at_every_level(name):
    out, _, _ = exported(name)
    assert "all agree" in built(out, out / "test/test.c", *EXPORT_FLAGS, *WARNINGS)


SCHEDULED = "context and schedule in the dynamics"


def test_a_schedule_is_given_at_run_time():
    out, problem, arguments = exported(SCHEDULED)
    even = replace(problem, schedule=np.full_like(GRID, DT))
    ours = loaded(out)
    changed = ours.solve(even, *arguments)
    assert_same(changed, CONVERGED.solve(even, *arguments))
    assert np.abs(changed.states - ours.solve(problem, *arguments).states).max() > 0.01


def test_the_example_moves_its_schedule_on_with_the_periods_where_it_knows_what_follows(tmp_path):
    """A cost with weights per step: planning again with those of the first step would never come to the later ones."""
    s, u, d = ca.SX.sym("s", 2), ca.SX.sym("u"), ca.SX.sym("d", 2)  # d: the weights of s and u
    problem = OCP.from_expressions(
        state=s, action=u, stage=d, horizon=T, dynamics=s + 0.1 * ca.vertcat(s[1], u),
        stage_cost=d[0] * (s[0] - 1) ** 2 + d[1] * u**2, terminal_cost=d[0] * (s[0] - 1) ** 2,
        schedule=np.column_stack([100.0 * (np.arange(T + 1) > T - 2), np.linspace(0.1, 1, T + 1)]),
    )  # fmt: skip
    rows = np.tile([0.0, 1.0], (T - 1, 1))
    out = export_c(problem, CONVERGED, tmp_path, preview=rows)
    lines = built(out, out / "example/main.c", *STRICT).splitlines()
    taken = [float(line.split()[-1]) for line in lines if "  ok " in line]
    plan = CONVERGED.solve(problem, np.zeros(2)).actions.ravel()
    assert np.ptp(plan) > 0.1
    np.testing.assert_allclose(taken, plan, rtol=0, atol=5.1e-5)  # it prints four decimals


PREVIEWS = {
    "one column too many": (CONVERGED, np.zeros((3, 3)), r"preview must be rows \(m, 1\).*\(3, 3\)"),
    "one row alone": (CONVERGED, np.zeros(1), r"rows \(m, 1\)"),
    "not finite": (CONVERGED, [[np.nan]], "preview must be finite"),
    "a solver with its schedule compiled in": (SQP(), [[0.1]], "preview is for Riccati: SQP"),
}


@pytest.mark.parametrize("name", PREVIEWS)
def test_a_preview_that_does_not_fit_is_refused(name, tmp_path):
    (solver, rows, message), problem = PREVIEWS[name], CASES[SCHEDULED]().problem
    with pytest.raises(ProblemError, match=message):
        export_c(problem, solver, tmp_path, preview=rows)


def test_a_preview_for_a_problem_without_schedule_is_refused(tmp_path):
    problem = CASES["states alone"]().problem
    with pytest.raises(ProblemError, match="has no schedule"):
        export_c(problem, CONVERGED, tmp_path, preview=np.zeros((3, 0)))


def test_a_solver_that_has_its_schedule_compiled_in_refuses_another():
    out, problem, arguments = exported(SCHEDULED, SQP())
    even = replace(problem, schedule=np.full_like(GRID, DT))
    with pytest.raises(ProblemError, match="schedule differ"):
        loaded(out).solve(even, *arguments)


def test_a_shift_takes_the_last_action_again_with_the_numbers_of_the_last_step():
    out, problem, arguments = exported(SCHEDULED)
    ours = loaded(out)
    plan = ours.solve(problem, *arguments)
    shifted = ours.shift(problem, plan)
    after = problem.dynamics(plan.states[-1], plan.actions[-1], *arguments[1:], GRID[T - 1])
    np.testing.assert_allclose(shifted.states[-1], np.array(after).ravel(), rtol=1e-13)
    np.testing.assert_array_equal(shifted.states[:-1], plan.states[1:])
    np.testing.assert_array_equal(shifted.multipliers.terminal, plan.multipliers.terminal)


def test_bounds_of_every_stage_are_given_at_run_time():
    out, problem, arguments = exported("bounds per stage")
    lower, upper = (np.array(bound) for bound in problem.action_bounds)
    upper *= np.linspace(0.5, 1.0, T)[:, None]
    tighter = replace(problem, action_bounds=(lower, upper))
    assert_same(loaded(out).solve(tighter, *arguments), CONVERGED.solve(tighter, *arguments))


def test_another_free_start_is_refused():
    out, problem, arguments = exported("free start")
    with pytest.raises(ProblemError, match="free_start"):
        loaded(out).solve(replace(problem, initial_bounds=None), *arguments)
