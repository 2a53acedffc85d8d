"""What the package offers is pickled before and after use, and works in pools; copies give the same numbers."""

import ctypes
import pickle
from dataclasses import fields, is_dataclass, replace
from multiprocessing import get_context

import numpy as np
import pytest
from exported import PLAIN, folder
from problems import pendulum

from kpirl_ocp import (
    LBFGS,
    SQP,
    Adam,
    Descent,
    ExportedSolver,
    Fatrop,
    FiniteDifference,
    GradientDescent,
    Implicit,
    Ipopt,
    Riccati,
    Truncated,
    Unrolled,
    evaluate,
    learn,
)
from kpirl_ocp.errors import CertificateError, ProblemError
from kpirl_ocp.irl.hypergradients.loss import ActionDistance, KeyFrames, WeightedSum
from kpirl_ocp.ocp.models import RBF, Default, KeypointCost, Robot, TimeDependent, Weighted
from kpirl_ocp.ocp.sensitivity import sensitivity

S0, PSI = [0.3, 0.0], [0.9, 0.6]
SOLVERS = [Riccati(), Riccati(barrier=1e-3), GradientDescent(20, 0.05), Ipopt(), Fatrop(), SQP()]
METHODS = [
    Implicit(),
    Implicit(Ipopt(), policy="flag"),
    Unrolled(GradientDescent(5, 0.05), policy="flag"),
    Truncated(GradientDescent(5, 0.05), 2),
    FiniteDifference(Riccati(), policy="flag"),
]


def bounded():
    """The problem of the pendulum with bounds on its torque, which gradient descent does not take."""
    return replace(pendulum().problem, action_bounds=(-1.0, 1.0))


def copied(thing):
    return pickle.loads(pickle.dumps(thing))


def numbers_of(record):
    """All arrays and numbers of a record, by name."""
    found = {}
    for field in fields(record):
        value = getattr(record, field.name)
        inner = numbers_of(value) if is_dataclass(value) else {"": value}
        found |= {f"{field.name}.{name}": number for name, number in inner.items()}
    return found


def assert_same(one, other):
    expected = numbers_of(other)
    for name, value in numbers_of(one).items():
        np.testing.assert_array_equal(value, expected[name], err_msg=name)


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda x: type(x).__name__)
def test_a_solver_is_pickled_before_and_after_use(solver):
    problem = pendulum().problem if isinstance(solver, GradientDescent) else bounded()
    before = copied(solver)
    found = solver.solve(problem, S0, PSI)
    for copy in (before, copied(solver)):
        assert copy == solver
        assert_same(copy.solve(problem, S0, PSI), found)


@pytest.mark.parametrize("method", METHODS, ids=lambda x: type(x).__name__)
def test_a_hypergradient_is_pickled_before_and_after_use(method):
    case, before = pendulum(), copied(method)
    loss, gradient, _ = method(case.problem, case.demonstration, PSI)
    for copy in (before, copied(method)):
        again = copy(case.problem, case.demonstration, PSI)
        assert again.loss == loss
        np.testing.assert_array_equal(again.gradient, gradient)


def test_a_solution_is_pickled_before_and_after_it_was_differentiated():
    problem = bounded()
    found = Riccati().solve(problem, S0, PSI)
    before, slopes = copied(found), (np.ones_like(found.states), np.ones_like(found.actions))
    gradients = sensitivity(problem, found).pull(*slopes)
    for copy in (before, copied(found)):
        assert_same(copy, found)
        np.testing.assert_array_equal(sensitivity(problem, copy).pull(*slopes).psi, gradients.psi)
    np.testing.assert_array_equal(copied(gradients).psi, gradients.psi)


PARTS = [
    *(Descent(0.1), Adam(0.1), LBFGS()),
    *(ActionDistance(), KeyFrames(), WeightedSum(((1.0, KeyFrames()), (2.0, ActionDistance())))),
    *(KeypointCost(basis, effort=0.5) for basis in (Weighted(), TimeDependent(), RBF(3), Default())),
]


@pytest.mark.parametrize("part", PARTS, ids=lambda part: type(part).__name__)
def test_losses_costs_and_optimisers_are_pickled(part):
    assert copied(part) == part


def test_a_robot_is_pickled_before_and_after_use():
    robot, theta = Robot.iiwa(), np.linspace(-0.5, 0.5, 7)
    before = copied(robot)
    keypoints = np.array(robot.keypoint_function(theta))
    for copy in (before, copied(robot)):
        np.testing.assert_array_equal(np.array(copy.keypoint_function(theta)), keypoints)


def test_what_was_learned_and_its_evaluation_are_pickled():
    case = pendulum()
    learned = learn(case.problem, [case.demonstration], PSI, Implicit(), Adam(0.01), steps=2, progress=False)
    evaluated = evaluate(case.problem, [case.demonstration], learned.psi, Riccati())
    np.testing.assert_array_equal(copied(learned).psi, learned.psi)
    np.testing.assert_array_equal(copied(learned).losses, learned.losses)
    np.testing.assert_array_equal(copied(evaluated).losses, evaluated.losses)


def test_an_exported_controller_is_pickled_with_its_settings_but_not_with_a_clock():
    out, case = folder("integrator", Riccati())
    ours, seen = ExportedSolver(out, PLAIN), case.demonstration
    before = copied(ours)
    ours.set(max_iterations=3)
    cut = ours.solve(case.problem, seen.s0, case.psi, seen.context)
    assert_same(copied(ours).solve(case.problem, seen.s0, case.psi, seen.context), cut)
    assert before.solve(case.problem, seen.s0, case.psi, seen.context).iterations > cut.iterations == 3
    clock = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_void_p)(lambda _: 0.0)
    ours.set(now=ctypes.cast(clock, ctypes.c_void_p), time_limit=1.0)
    with pytest.raises(ProblemError, match="clock of a time limit"):
        copied(ours)


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_a_pool_gives_the_gradients_of_this_process_and_hands_over_a_certificate_error(method):
    """An exception that cannot be unpickled would leave the pool waiting for ever."""
    case = pendulum()
    given = case.problem, case.demonstration, PSI
    with get_context(method).Pool(1) as pool:
        result = pool.apply_async(Implicit(), given).get(120)
        with pytest.raises(CertificateError) as refused:
            pool.apply_async(Implicit(Riccati(max_iterations=1)), given).get(120)
    np.testing.assert_array_equal(result.gradient, Implicit()(*given).gradient)
    assert refused.value.certificate.solution.iterations == 1
