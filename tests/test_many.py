"""Many solves and gradients at once: the numbers of single ones, whatever the number of threads."""

import os
import pickle
import signal
import threading
import time
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
from problems import TABLE

from kpirl_ocp import LBFGS, Implicit, Ipopt, Riccati, Status, Trajectory, learn
from kpirl_ocp.errors import CertificateError, ProblemError
from kpirl_ocp.irl.hypergradients import implicit
from kpirl_ocp.ocp.sensitivity import sensitivity
from kpirl_ocp.ocp.solvers import pull_many, solve_many
from kpirl_ocp.ocp.solvers.many import side_by_side

CASE = TABLE["integrator"]()
STARTS = CASE.demonstration.s0 + np.linspace(-0.2, 0.2, 12)[:, None] * [1.0, 0.0]


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_many_solves_give_the_numbers_of_single_ones(threads):
    found = solve_many(CASE.problem, STARTS, CASE.psi, CASE.demonstration.context, threads=threads)
    for start, solution in zip(STARTS, found, strict=True):
        single = Riccati().solve(CASE.problem, start, CASE.psi, CASE.demonstration.context)
        assert solution.status is single.status is Status.CONVERGED
        np.testing.assert_array_equal(solution.actions, single.actions)
        np.testing.assert_array_equal(solution.multipliers.dynamics, single.multipliers.dynamics)


def test_everything_may_differ_from_solve_to_solve():
    scales = np.linspace(0.5, 2, 12)
    psi = CASE.psi * scales[:, None]
    first = solve_many(CASE.problem, STARTS, psi, CASE.demonstration.context)
    again = solve_many(CASE.problem, STARTS, psi, CASE.demonstration.context, guesses=first)
    for one, other, numbers in zip(first, again, psi, strict=True):
        np.testing.assert_array_equal(one.psi, numbers)
        np.testing.assert_allclose(other.actions, one.actions, rtol=0, atol=1e-6)
        assert other.iterations <= 5


def parts_of(value):
    """All numbers, texts and arrays of a record and of the records in it, by name."""
    if not is_dataclass(value):
        return [("", value)]
    assert vars(value).keys() == {field.name for field in fields(value)}, type(value)
    return [(f"{name}.{inner}", part) for name, field in vars(value).items() for inner, part in parts_of(field)]


@pytest.mark.parametrize("copy", [lambda one: pickle.loads(pickle.dumps(one)), replace], ids=["pickle", "replace"])
def test_records_of_many_have_all_their_fields_also_when_they_are_copied(copy):
    problem, found = CASE.problem, solve_many(CASE.problem, STARTS[:2], CASE.psi, CASE.demonstration.context)
    slopes = [np.ones((2, *getattr(found[0], name).shape)) for name in ("states", "actions")]
    for one in (*found, *pull_many(problem, found, *slopes)):
        for (name, part), (other, copied) in zip(sorted(parts_of(one)), sorted(parts_of(copy(one))), strict=True):
            assert (name, type(part)) == (other, type(copied))
            np.testing.assert_array_equal(part, copied)


def test_solutions_keep_their_numbers_when_those_they_were_given_change():
    psi = np.tile(CASE.psi, (len(STARTS), 1))
    found = solve_many(CASE.problem, STARTS, psi, CASE.demonstration.context)
    psi[:] = 0.0
    assert all((solution.psi == CASE.psi).all() for solution in found)


def test_every_solve_has_its_own_status():
    starts = [STARTS[0], [0.0, 50.0], STARTS[1]]  # the second is much too fast for the bounds
    found = solve_many(CASE.problem, starts, CASE.psi, CASE.demonstration.context)
    assert [solution.status.ok for solution in found] == [True, False, True]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(s0=np.zeros((3, 5))), r"s0 must be numbers of shape \(B, 2\) or \(2,\), got \(3, 5\)"),
        (dict(s0="start"), "s0 must be numbers"),
        (dict(psi=np.zeros((4, 3))), "as many of everything"),
        (dict(guesses=[None]), "as many of everything"),
        (dict(threads=0), "threads must be at least 1"),
    ],
)
def test_what_does_not_fit_is_refused(arguments, message):
    given = dict(s0=STARTS, psi=CASE.psi, context=CASE.demonstration.context) | arguments
    with pytest.raises(ProblemError, match=message):
        solve_many(CASE.problem, **given)


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_many_gradients_are_those_of_single_solutions(threads):
    problem, rng = CASE.problem, np.random.default_rng(0)
    solutions = solve_many(problem, STARTS, CASE.psi, CASE.demonstration.context)
    by_states, by_actions = (
        rng.normal(size=(len(STARTS), *getattr(solutions[0], name).shape)) for name in ("states", "actions")
    )
    found = pull_many(problem, solutions, by_states, by_actions, "flag", threads)
    for solution, gradients, *slopes in zip(solutions, found, by_states, by_actions, strict=True):
        single = sensitivity(problem, solution, "flag").pull(*slopes)
        for name in ("psi", "s0", "context"):
            np.testing.assert_array_equal(getattr(gradients, name), getattr(single, name))
        assert gradients.certificate.evidence() == single.certificate.evidence()


def test_a_slope_without_numbers_leaves_the_other_gradients_alone():
    problem, solutions = CASE.problem, solve_many(CASE.problem, STARTS[:3], CASE.psi, CASE.demonstration.context)
    by_states, by_actions = (np.ones((3, *getattr(solutions[0], name).shape)) for name in ("states", "actions"))
    whole = pull_many(problem, solutions, by_states, by_actions)
    by_states[1, 2] = np.nan
    found = pull_many(problem, solutions, by_states, by_actions, "flag", threads=1)
    assert [gradients.certificate.certified for gradients in found] == [True, False, True]
    assert all(np.isnan(part).all() for part in (found[1].psi, found[1].s0, found[1].context))
    for i in (0, 2):
        np.testing.assert_array_equal(found[i].psi, whole[i].psi)
    with pytest.raises(CertificateError, match="NaN or infinite"):
        pull_many(problem, solutions, by_states, by_actions)


def test_many_gradients_need_slopes_for_every_solution_and_certificates():
    problem, solutions = CASE.problem, solve_many(CASE.problem, STARTS[:2], CASE.psi, CASE.demonstration.context)
    slopes = [np.ones((2, *getattr(solutions[0], name).shape)) for name in ("states", "actions")]
    with pytest.raises(ProblemError, match="pull_many needs as many of everything"):
        pull_many(problem, solutions[:1], *slopes)
    short = Riccati(max_iterations=1).solve(problem, STARTS[0], CASE.psi, CASE.demonstration.context)
    with pytest.raises(CertificateError, match="gradient 1 is NOT certified: The solver did not converge"):
        pull_many(problem, [solutions[1], short], *slopes)


def test_a_solution_of_another_problem_is_named():
    problem, found = CASE.problem, solve_many(CASE.problem, STARTS, CASE.psi, CASE.demonstration.context)
    slopes = [np.ones((len(found), *getattr(found[0], name).shape)) for name in ("states", "actions")]
    wrong = replace(found[10], trajectory=Trajectory(found[10].states[:-1], found[10].actions))
    for threads in (1, 2):
        with pytest.raises(ProblemError, match=r"^solution 10's states must be \(\d+, 2\), got"):
            pull_many(problem, [*found[:10], wrong, found[11]], *slopes, threads=threads)


OTHER_SHAPES = [
    lambda x: x[:, :-1],
    lambda x: x[..., None],
    lambda x: x[:, :, :0],
    lambda x: x[0],
    np.ravel,
    lambda x: 0.0,
]


def test_slopes_of_another_shape_are_refused():
    problem, found = CASE.problem, solve_many(CASE.problem, STARTS[:2], CASE.psi, CASE.demonstration.context)
    slopes = {f"by_{name}": np.ones((2, *getattr(found[0], name).shape)) for name in ("states", "actions")}
    for name, wrong in ((name, change(slope)) for name, slope in slopes.items() for change in OTHER_SHAPES):
        with pytest.raises(ProblemError, match=r"must be|as many"):
            pull_many(problem, found, **slopes | {name: wrong})


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_the_first_error_ends_the_work_in_the_order_of_the_arguments(threads):
    begun = []

    def fail(number):
        begun.append(number)
        if number >= 5:
            raise ValueError(number)
        return number

    with pytest.raises(ValueError, match="5"):
        side_by_side(fail, range(1000), threads=threads)
    assert set(range(6)) <= set(begun)
    assert len(begun) <= 6 + threads
    assert side_by_side(fail, range(5), threads=threads) == list(range(5))


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_ctrl_c_ends_many_solves_after_those_that_are_under_way(threads):
    begun, two = [], threading.Barrier(threads, timeout=60)

    def solve(number):
        begun.append(number)
        if number < threads:
            two.wait()
        if threading.current_thread() is threading.main_thread():
            signal.raise_signal(signal.SIGINT)
        time.sleep(0.01)

    with pytest.raises(KeyboardInterrupt):
        side_by_side(solve, range(1000), threads=threads)
    assert len(begun) < 100


@pytest.mark.parametrize("solver", [Riccati(), Ipopt()])
def test_an_implicit_gradient_of_several_demonstrations_is_that_of_each(solver):
    demonstrations = [replace(CASE.demonstration, s0=start) for start in STARTS[:4]]
    method = Implicit(solver, policy="flag")
    for demonstration, result in zip(demonstrations, method.batch(CASE.problem, demonstrations, CASE.psi), strict=True):
        single = method(CASE.problem, demonstration, CASE.psi)
        assert result.loss == single.loss
        np.testing.assert_array_equal(result.gradient, single.gradient)


def test_learning_from_several_demonstrations_evaluates_them_side_by_side(monkeypatch):
    two, differentiate = threading.Barrier(2, timeout=60), implicit.differentiate

    def watched(*arguments):
        two.wait()  # for another thread
        return differentiate(*arguments)

    monkeypatch.setattr(implicit, "differentiate", watched)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    demonstrations = [replace(CASE.demonstration, s0=start) for start in STARTS]
    learn(CASE.problem, demonstrations, CASE.psi, Implicit(policy="flag"), LBFGS(), 1)
    assert not two.broken
