"""Stage functions against derivatives of the whole program, with hand-arranged derivatives and without."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from problems import TABLE, integrator, network

from kpirl_ocp.ocp import stages
from kpirl_ocp.ocp.calls import Call, call
from kpirl_ocp.ocp.derivatives import DynamicsDerivatives
from kpirl_ocp.ocp.kkt import transcribe
from kpirl_ocp.ocp.sensitivity import Instance, PrimalDual, linearise

RNG = np.random.default_rng(0)


def random_point(case):
    """An instance and a primal-dual point that is no solution of it."""
    problem, demonstration = case.problem, case.demonstration
    n_w = problem.horizon * (problem.n_states + problem.n_actions)
    nlp = transcribe(problem)
    n_bounds = np.isfinite(nlp.lower).sum() + np.isfinite(nlp.upper).sum()
    numbers = (n_w, problem.horizon * problem.n_states, n_bounds + problem.horizon * problem.n_path)
    point = PrimalDual(*(0.3 * RNG.normal(size=n) for n in numbers))
    return Instance(problem, demonstration.s0, case.psi, demonstration.context), point


def dense(instance, point):
    """Values, gradient, Hessian of the Lagrangian, Jacobians of defects and path constraints, by AD of the program."""
    nlp = transcribe(instance.problem)
    symbols = [nlp.symbols[name] for name in ("w", "s0", "psi", "c")]
    cost, defects, path = nlp.values(*symbols)
    mu = instance.path_forces(point.forces)
    lagrangian = cost + ca.dot(point.costates, defects) + ca.dot(mu, path)
    hessian, slope = ca.hessian(lagrangian, symbols[0])
    outputs = [defects, path, slope, hessian, ca.jacobian(defects, symbols[0]), ca.jacobian(path, symbols[0])]
    evaluate = ca.Function("dense", symbols, [ca.densify(x) for x in outputs])
    return [np.array(x) for x in evaluate(point.w, instance.s0, instance.psi, instance.context)]


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
        (instance.gradient(point), slope.ravel()),
        (system.times_hessian(w), H @ w),
        (system.times_jacobian(w), A @ w),
        (system.times_transposed_jacobian(costates), A.T @ costates),
        (instance.path_forces(system.times_rows(w)), G @ w),
    ]:
        scale = max(1.0, np.abs(expected).max(initial=0.0))
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * scale)


def test_stage_functions_take_the_derivatives_that_a_problem_brings():
    case = network("tanh")
    given = DynamicsDerivatives.by_ad(case.problem.dynamics)
    asked = [ca.MX.sym(f"x{i}", given.second.size1_in(i)) for i in range(4)]
    *others, hessian = given.second(*asked)
    marked = ca.Function("second", asked, [*others, hessian + 1])
    problem = replace(case.problem, derivatives=replace(given, second=marked))
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
