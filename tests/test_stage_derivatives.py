"""Stage functions against derivatives of the whole program, with hand-arranged derivatives and without."""

from dataclasses import dataclass, replace
from functools import partial

import casadi as ca
import numpy as np
import pytest
from kkt_products import times_hessian, times_jacobian, times_transposed_jacobian
from problems import TABLE, integrator, network

from kpirl_ocp.ocp.codegen.numpy_calls import Call, call
from kpirl_ocp.ocp.conditions import stage_derivatives as stages
from kpirl_ocp.ocp.conditions.hessian_products import Lagrangian
from kpirl_ocp.ocp.conditions.program import transcribe
from kpirl_ocp.ocp.linear.stage_operators import flat
from kpirl_ocp.ocp.problem.constraints import BoundRows
from kpirl_ocp.ocp.problem.layout import limits
from kpirl_ocp.ocp.problem.linearised_dynamics import LinearisedByStage
from kpirl_ocp.ocp.sensitivity import conditioning as kkt_spectra
from kpirl_ocp.ocp.sensitivity import refinement as kkt_solves
from kpirl_ocp.ocp.sensitivity.kkt_system import Instance, PrimalDual, linearise

RNG = np.random.default_rng(0)


def random_point(case):
    """An instance and a primal-dual point that is no solution of it."""
    problem, demonstration = case.problem, case.demonstration
    n_w = problem.horizon * (problem.n_states + problem.n_actions)
    n_bounds = len(BoundRows.of(*limits(problem)).entries)
    numbers = (n_w, problem.horizon * problem.n_states, n_bounds + problem.horizon * problem.n_path)
    point = PrimalDual(*(0.3 * RNG.normal(size=n) for n in numbers))
    return Instance(problem, demonstration.s0, case.psi, demonstration.context), point


def dense(instance, point):
    """Values, gradient, Hessian of the Lagrangian, Jacobians of defects and path constraints, by AD of the program."""
    program, n_s = transcribe(instance.problem), instance.problem.n_states
    cost, defects, path = program.values(*program.symbols)
    w, mu = program.symbols[0], instance.path_forces(point.forces)
    hessian, slope = ca.hessian(cost + ca.dot(point.costates, defects) + ca.dot(mu, path), w)
    jacobians = [ca.jacobian(rows, w)[:, n_s:] for rows in (defects, path)]  # s_0 is given
    outputs = [defects, path, slope[n_s:], hessian[n_s:, n_s:], *jacobians]
    evaluate = ca.Function("dense", program.symbols, [ca.densify(x) for x in outputs])
    return [np.array(x) for x in evaluate(np.append(instance.s0, point.w), instance.psi, instance.context)]


@pytest.mark.parametrize("name", TABLE)
def test_products_with_stage_matrices_are_those_with_derivatives_of_the_whole_program(name):
    instance, point = random_point(TABLE[name]())
    defects, path, slope, H, A, G = dense(instance, point)
    system = linearise(instance, point, np.zeros(len(point.forces), bool))
    w, costates = RNG.normal(size=len(point.w)), RNG.normal(size=len(point.costates))
    for found, expected in [
        (system.defects, defects.ravel()),
        (system.slack[len(system.slack) - len(path) :], -path.ravel()),
        (system.gradient, slope.ravel()),
        (times_hessian(system, w), H @ w),
        (times_jacobian(system, w), A @ w),
        (times_transposed_jacobian(system, costates), A.T @ costates),
        (instance.path_forces(system.times_rows(w)), G @ w),
    ]:
        scale = max(1.0, np.abs(expected).max(initial=0.0))
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * scale)


@pytest.mark.parametrize("name", TABLE)
def test_products_without_matrices_are_those_with_them(name):
    instance, point = random_point(TABLE[name]())
    problem, steps = instance.problem, instance.problem.horizon
    system = linearise(instance, point, np.zeros(len(point.forces), bool))
    at = stages.symbols(problem)
    x, last = ca.MX.sym("x", problem.n_states + problem.n_actions, steps), ca.MX.sym("last", problem.n_states)
    costates, forces = ca.MX.sym("costates", problem.n_states, steps), ca.MX.sym("forces", problem.n_path, steps)
    here = Lagrangian(problem, *at)
    balance, end = here.balance(x, last, costates, forces)
    outputs = [flat(problem, balance, end), ca.vec(here.F_times(x)), ca.vec(here.path(x)), here.slope()]
    evaluate = ca.Function("products", [*at, x, last, costates, forces], outputs)
    w, dcostates, dforces = (RNG.normal(size=size.shape) for size in (point.w, point.costates, point.forces))
    dforces[: len(dforces) - len(instance.path_forces(dforces))] = 0  # bounds are not part of it
    columns, s_last = system.by_stage(w)
    direction = columns.T, s_last, dcostates.reshape(steps, -1).T, instance.path_forces(dforces).reshape(steps, -1).T
    shaped = [v.reshape(at[i].shape, order="F") for i, v in enumerate(instance.arguments(point))]
    found = [np.array(value).ravel() for value in evaluate(*shaped, *direction)]
    n = len(point.costates)
    pulled = times_transposed_jacobian(system, dcostates) + np.append(dcostates, np.zeros(len(w) - n))
    slope = system.gradient + np.append(point.costates, np.zeros(len(w) - n))
    expected = [
        times_hessian(system, w) + pulled + system.times_transposed_rows(dforces),
        times_jacobian(system, w) + w[:n],
        instance.path_forces(system.times_rows(w)),
        slope,
    ]
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12 * max(1.0, np.abs(other).max(initial=0.0)))


@dataclass(frozen=True, eq=False)
class Marked(LinearisedByStage):
    """Another Hessian, to see whether it is asked for."""

    def second(self):
        function, arguments = super().second()
        *others, hessian = function(*function.mx_in())
        return ca.Function("second", function.mx_in(), [*others, hessian + 1]), arguments


def test_stage_functions_take_the_derivatives_that_a_problem_brings():
    case = network("tanh")
    by_ad = case.problem.dynamics_derivatives
    marked = replace(by_ad, linearise=partial(Marked, case.problem.transition))
    problem = replace(case.problem, derivatives=marked)
    instance, point = random_point(case)
    arguments = (*instance.at(point.w), point.costates, np.zeros(0))
    plain, other = (call(p, stages.second)(*arguments)[9] for p in (case.problem, problem))
    np.testing.assert_allclose(other - plain, 1, rtol=1e-9)


def test_calls_refuse_arguments_of_the_wrong_length_and_sparse_functions():
    problem = integrator().problem
    with pytest.raises(ValueError, match="expected"):
        call(problem, stages.values)(np.zeros(3), np.zeros(12), np.zeros(3), np.zeros(1))
    x = ca.MX.sym("x", 2)
    with pytest.raises(ValueError, match="not dense"):
        Call(ca.Function("sparse", [x], [ca.diag(x)]))


def test_calls_return_arrays_of_their_own():
    x = ca.MX.sym("x", 2)
    double = Call(ca.Function("double", [x], [2 * x]))
    (one,), (other,) = double(np.ones(2)), double(np.zeros(2))
    np.testing.assert_array_equal(one, [2, 2])
    np.testing.assert_array_equal(other, [0, 0])


def test_arguments_that_were_fixed_stay_and_the_others_change():
    x, y = ca.MX.sym("x", 3000), ca.MX.sym("y", 2)  # one that is handed over as it is, one that is copied
    function = ca.Function("sums", [x, y], [ca.sum1(x) + y, 2 * x])
    fixed = Call(function).fix(np.ones(3000))
    (one, doubled), (other, again) = fixed(np.zeros(2)), fixed(np.array([1.0, 2.0]))
    np.testing.assert_array_equal(one, [3000, 3000])
    np.testing.assert_array_equal(other, [3001, 3002])
    assert not np.shares_memory(doubled, again)
    with pytest.raises(ValueError, match="0 arguments were given, expected 1"):
        fixed()
    np.testing.assert_array_equal(fixed.fix()(np.full(3000, 2.0), np.zeros(2))[0], [6000, 6000])


@pytest.mark.parametrize("name", ["integrator", "tanh network", "iiwa at a limit"])
def test_row_variances_are_those_of_the_dense_condensed_rows(name):
    instance, point = random_point(TABLE[name]())
    system = linearise(instance, point, np.zeros(len(point.forces), bool))
    n = len(point.costates)
    A = np.array([times_jacobian(system, column) for column in np.eye(len(point.w))]).T
    Z = np.vstack([-np.linalg.solve(A[:, :n], A[:, n:]), np.eye(len(point.w) - n)])
    rows = np.array([system.times_rows(column) for column in Z.T]).T
    (found,) = call(instance.problem, kkt_spectra.row_variances)(system.F, system.G)
    np.testing.assert_allclose(found, (rows**2).sum(axis=1), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("name", ["integrator", "tanh network"])
def test_residuals_that_a_step_of_refinement_reports_are_those_of_the_system(name):
    instance, point = random_point(TABLE[name]())
    some = RNG.random(len(point.forces)) < 0.1
    system = linearise(instance, point, some)
    w, costates, forces = (RNG.normal(size=x.shape) for x in (point.w, point.costates, point.forces))
    right, defects, values = (RNG.normal(size=x.shape) for x in (w, costates, forces))
    stiffness, scale = np.where(some, 10.0, 0.0), np.ones(len(some))
    factors = [RNG.normal(size=kkt_solves.refine(instance.problem).numel_in(i)) for i in range(2, 6)]  # not used
    system_side = [*system.matrices[2:], system.stiffness, some.astype(float), scale, right, defects, values]
    off = [np.zeros_like(x) for x in (right, defects, values)]  # the step is then zero
    step = call(instance.problem, kkt_solves.refine)
    forces = np.where(some, forces, 0.0)
    *found, norms = step(system.F, system.G, *factors, stiffness, *system_side, w, costates, forces, *off)
    balance = times_hessian(system, w) + times_transposed_jacobian(system, costates)
    expected = [
        w,
        costates,
        forces,
        right - balance - system.times_transposed_rows(forces),
        defects - times_jacobian(system, w),
        np.where(some, values - system.times_rows(w), 0.0),
    ]
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-11 * max(1.0, np.abs(other).max()))
    np.testing.assert_allclose(norms, [np.linalg.norm(x) for x in (*expected[3:], w)], rtol=1e-10)


def test_dynamics_that_depend_on_psi_keep_it_and_others_do_not_repeat_it():
    network_, pendulum_ = TABLE["tanh network"]().problem, TABLE["pendulum"]().problem
    assert stages.dynamics_alone(network_).size1_in(2) == 0
    assert stages.dynamics_alone(pendulum_) is pendulum_.transition
    s, u, psi = (
        RNG.normal(size=network_.n_states),
        RNG.normal(size=network_.n_actions),
        RNG.normal(size=network_.n_parameters),
    )
    np.testing.assert_array_equal(stages.dynamics_alone(network_)(s, u, []), network_.transition(s, u, psi))
