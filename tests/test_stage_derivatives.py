"""Stage functions against derivatives of the whole program, with hand-arranged derivatives and without."""

from dataclasses import dataclass, replace
from functools import partial

import casadi as ca
import kkt_in_c
import numpy as np
import pytest
import statements
from problems import TABLE, integrator, network

from kpirl_ocp import Riccati
from kpirl_ocp.irl.cases.network_cases import placing_case
from kpirl_ocp.irl.hypergradients.implicit import differentiate
from kpirl_ocp.ocp.codegen.numpy_calls import Call, call
from kpirl_ocp.ocp.conditions import parameter_derivatives
from kpirl_ocp.ocp.conditions.program import transcribe
from kpirl_ocp.ocp.interior_point.horizon_functions import horizon_functions
from kpirl_ocp.ocp.problem.columns import map_shared
from kpirl_ocp.ocp.problem.layout import by_stage, split, unpack
from kpirl_ocp.ocp.problem.linearised_dynamics import LinearisedByStage
from kpirl_ocp.ocp.sensitivity.kkt_system import Instance, PrimalDual
from kpirl_ocp.ocp.sensitivity.rows import rows_of

PRODUCTS = parameter_derivatives.pull, parameter_derivatives.push
RNG = np.random.default_rng(0)


def random_point(problem):
    """An instance and a primal-dual point that is no solution of it."""
    T, n_s, n_u = problem.horizon, problem.n_states, problem.n_actions
    numbers = T * (n_s + n_u) + n_s, T * n_s, len(rows_of(problem).equality)
    point = PrimalDual(*(0.3 * RNG.normal(size=n) for n in numbers))
    sizes = n_s, problem.n_parameters, problem.n_context
    s0, psi, context = (0.3 + RNG.random(size) for size in sizes)
    return Instance(problem, s0, psi, context), point


def dense(instance, point):
    """Gradient and Hessian of the Lagrangian, equalities, inequalities and their Jacobians, by AD of the program."""
    problem, program = instance.problem, transcribe(instance.problem)
    cost, g_E, g_I = program.values(*program.symbols)
    w, (z, nu) = program.symbols[0], instance.rows.split(point.forces)[1:]
    hessian, slope = ca.hessian(cost + ca.dot(np.append(point.costates, nu), g_E) + ca.dot(z, g_I), w)
    outputs = [slope, hessian, g_E, ca.jacobian(g_E, w), g_I, ca.jacobian(g_I, w)]
    evaluate = ca.Function("dense", program.symbols, [ca.densify(x) for x in outputs])
    trajectory = split(point.x, problem.horizon, problem.n_states, problem.n_actions)
    found = evaluate(np.concatenate([part.ravel() for part in trajectory]), instance.psi, instance.context)
    return [np.array(x) for x in found]


def in_order_of_time(problem):
    """Of every entry of x, its place in w."""
    n_w = (problem.horizon + 1) * problem.n_states + problem.horizon * problem.n_actions
    w = unpack(problem, np.arange(float(n_w)))
    return by_stage(w.states, w.actions).astype(int)


PROBLEMS = {name: lambda name=name: TABLE[name]().problem for name in TABLE}
PROBLEMS |= {name: lambda name=name: statements.CASES[name]().problem for name in statements.CASES}


@pytest.mark.parametrize("name", PROBLEMS)
def test_products_with_stage_matrices_are_those_with_derivatives_of_the_whole_program(name):
    problem = PROBLEMS[name]()
    instance, point = random_point(problem)
    order = in_order_of_time(problem)
    slope, H, g_E, A, g_I, G = dense(instance, point)
    system = kkt_in_c.linearise(instance, point, np.zeros(len(point.forces), bool))
    x, costates, forces = (RNG.normal(size=part.shape) for part in (point.x, point.costates, point.forces))
    n, (_, z, nu) = len(costates), instance.rows.split(forces)
    w = np.zeros(len(x))
    w[order] = x
    rows, at = instance.rows.split(kkt_in_c.rows_along(system, x)), kkt_in_c.derivatives_of(system)
    pushed = forces.copy()
    pushed[: instance.rows.n_bounds] = 0.0
    balance = kkt_in_c.balance(system, PrimalDual(x, costates, pushed))
    for found, expected in [
        (at.gradient, slope.ravel()[order]),
        (np.append(at.defects, at.equality), g_E.ravel()),
        (at.path, g_I.ravel()),
        (kkt_in_c.defects_along(system, x), A[:n] @ w),
        (rows[1], G @ w),
        (rows[2], A[n:] @ w),
        (balance, (H @ w + A.T @ np.append(costates, nu) + G.T @ z)[order]),
    ]:
        scale = max(1.0, np.abs(expected).max(initial=0.0))
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * scale)


@pytest.mark.parametrize("name", PROBLEMS)
def test_parameters_enter_the_conditions_as_in_the_whole_program(name):
    problem = PROBLEMS[name]()
    instance, point = random_point(problem)
    order, program = in_order_of_time(problem), transcribe(problem)
    cost, g_E, g_I = program.values(*program.symbols)
    w, psi, c = program.symbols
    z, nu = instance.rows.split(point.forces)[1:]
    slope = ca.gradient(cost + ca.dot(np.append(point.costates, nu), g_E) + ca.dot(z, g_I), w)
    jacobians = [ca.densify(ca.jacobian(part, p)) for part in (slope, g_E, g_I) for p in (psi, c)]
    trajectory = split(point.x, problem.horizon, problem.n_states, problem.n_actions)
    at = np.concatenate([part.ravel() for part in trajectory]), instance.psi, instance.context
    parts = [np.array(x) for x in ca.Function("dense", program.symbols, jacobians)(*at)]
    by_gradient, by_equalities, by_inequalities = (np.hstack(parts[i : i + 2]) for i in (0, 2, 4))
    dpsi, dc = RNG.normal(size=len(instance.psi)), RNG.normal(size=len(instance.context))
    move = np.append(dpsi, dc)
    given = point.x, instance.psi, instance.context, point.costates, z, nu
    dgradient, df, dh, de = call(problem, parameter_derivatives.push)(*given, dpsi, dc)
    for found, expected in [
        (dgradient, (by_gradient @ move)[order]),
        (np.append(df, de), by_equalities @ move),
        (dh, by_inequalities @ move),
    ]:
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * max(1.0, np.abs(expected).max(initial=0.0)))
    changes = [RNG.normal(size=part.shape) for part in (point.x, point.costates, z, nu)]
    found = np.concatenate(call(problem, parameter_derivatives.pull)(*given, *changes))
    dw = np.zeros(len(point.x))
    dw[order] = changes[0]
    expected = dw @ by_gradient + np.append(changes[1], changes[3]) @ by_equalities + changes[2] @ by_inequalities
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * max(1.0, np.abs(expected).max(initial=0.0)))


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
    instance, point = random_point(case.problem)
    n = problem.n_states + problem.n_actions
    both = (kkt_in_c.linearise(one, point) for one in (instance, instance._replace(problem=problem)))
    found = [kkt_in_c.derivatives_of(one).H for one in both]
    plain, other = (H[: problem.horizon * n**2].reshape(-1, n, n) for H in found)
    lower = np.triu(np.ones((n, n), bool))  # by columns
    np.testing.assert_allclose((other - plain)[:, lower], 1, rtol=1e-9)


def test_memory_grows_with_the_horizon_and_not_with_its_square_where_every_step_has_weights():
    sizes = []
    for horizon in (20, 40, 80):
        problem = placing_case(horizon, 1).bounded
        functions = [*horizon_functions(problem).horizon, *(f(problem) for f in PRODUCTS)]
        sizes.append([function.sz_w() for function in functions])
    small, middle, large = np.array(sizes)
    assert (large - middle <= 2.1 * (middle - small)).all()


@pytest.mark.parametrize("steps", [1, 3])
def test_steps_share_inputs_of_one_step_and_leave_out_those_that_do_not_matter(steps):
    for kind in (ca.SX, ca.MX):
        x, p, unused = kind.sym("x", 2), kind.sym("p", 3), kind.sym("unused", 4)
        f = ca.Function("f", [x, p, unused], [ca.dot(x, x) * p, kind.zeros(2), x[0] + p[0]])
        X, P, nothing = ca.MX.sym("X", 2, steps), ca.MX.sym("P", 3), ca.MX.sym("nothing", 4, steps)
        at = RNG.normal(size=(2, steps)), RNG.normal(size=3)
        squares = (at[0] ** 2).sum(axis=0)
        side_by_side, summed = (
            ca.Function("mapped", [X, P], map_shared(f, steps, [X, P, nothing], add))(*at) for add in (False, True)
        )
        expected = np.outer(at[1], squares), np.zeros((2, steps)), at[0][:1] + at[1][0]
        for found, total, value in zip(side_by_side, summed, expected, strict=True):
            np.testing.assert_allclose(found, value, rtol=1e-14)
            np.testing.assert_allclose(total, value.sum(axis=1, keepdims=True), rtol=1e-14)


def test_calls_refuse_arguments_of_the_wrong_length_and_sparse_functions():
    problem = integrator().problem
    with pytest.raises(ValueError, match="expected"):
        call(problem, parameter_derivatives.pull)(np.zeros(3))
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


@pytest.mark.parametrize("name", ["iiwa", "lqr"])
def test_machine_code_of_mixed_derivatives_gives_the_gradient_of_the_virtual_machine_to_the_last_bit(name):
    case = TABLE[name]()
    seen, found = case.demonstration, []
    for wish in (False, True):
        problem = replace(case.problem)  # another one, of which nothing is known yet
        solution = Riccati(compile=wish).solve(problem, seen.s0, case.psi, seen.context)
        found.append(differentiate(problem, seen, solution).gradient)
    np.testing.assert_array_equal(*found)
