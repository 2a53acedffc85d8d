"""Derivatives of solutions by psi, s_0 and the context: against one dense KKT matrix, and against each other."""

import ctypes
from dataclasses import replace
from functools import lru_cache

import casadi as ca
import kkt_in_c
import numpy as np
import pytest
from dense_kkt import derivative, unknowns
from problems import TABLE, network, swing_up

from kpirl_ocp import OCP, Ipopt, Riccati, Trajectory
from kpirl_ocp.ocp.interior_point import library as c
from kpirl_ocp.ocp.problem.layout import by_stage, split
from kpirl_ocp.ocp.sensitivity.factorisation import Factorisation
from kpirl_ocp.ocp.sensitivity.implicit_function import ByParameters, ImplicitFunction
from kpirl_ocp.ocp.sensitivity.kkt_system import PrimalDual, Triple, at_solution
from kpirl_ocp.ocp.sensitivity.solution_sensitivity import sensitivity

CASES = TABLE | {
    "swing-up, 45 steps": lambda: swing_up(45),
    "tanh network, 100 steps": lambda: long_network(),
}
SMOOTHED = {"integrator": 1e-3, "tanh network": 1e-4}


@lru_cache
def long_network():
    """A network problem of 100 steps; the random network is too lively for that without smaller steps."""
    case = network("tanh", 100)
    return replace(case, psi=case.psi * np.array([0.3, 0.3, 0.3, 0.3, 1.0]))


@lru_cache
def solved(name, barrier=0.0):
    """The arguments of a solve, the solution, its derivative and the dense one."""
    case = CASES[name]()
    given = (case.problem, case.demonstration.s0, case.psi, case.demonstration.context)
    solver = Riccati(tolerance=1e-11)
    solution = (solver.with_barrier(barrier) if barrier else solver).solve(*given).raise_if_failed()
    return given, solution, ImplicitFunction.at(given[0], solution), derivative(given[0], solution)


ROWS = [(name, 0.0) for name in CASES] + list(SMOOTHED.items())


def random_slope(system, seed=0):
    return np.random.default_rng(seed).normal(size=len(system.point.x))


def in_dense_order(problem, x):
    return unknowns(problem, *split(x, problem.horizon, problem.n_states, problem.n_actions))


@pytest.mark.parametrize(("name", "barrier"), ROWS)
def test_gradients_equal_those_of_the_dense_kkt_matrix(name, barrier):
    (problem, *_), _, function, dense = solved(name, barrier)
    slope = random_slope(function.system)
    adjoint, residual = kkt_in_c.adjoint_of(function.factors, slope)
    found = kkt_in_c.pull(function.system, adjoint)
    expected = in_dense_order(problem, slope) @ dense
    assert len(found.psi) == problem.n_parameters
    np.testing.assert_allclose(np.concatenate(found), expected, rtol=0, atol=1e-8 * np.abs(expected).max())
    assert residual < 1e-10


@pytest.mark.parametrize(("name", "barrier"), ROWS)
def test_changes_of_the_trajectory_equal_those_of_the_dense_kkt_matrix(name, barrier):
    (problem, s0, psi, context), _, function, dense = solved(name, barrier)
    parts = ByParameters(*(np.random.default_rng(1).normal(size=len(x)) for x in (psi, s0, context)))
    found, residual = function.push(parts)
    expected = dense @ np.concatenate(parts)
    changes = in_dense_order(problem, found.x)
    np.testing.assert_allclose(changes, expected, rtol=0, atol=1e-8 * np.abs(expected).max())
    np.testing.assert_array_equal(found.x[: len(s0)], parts.s0)
    assert residual < 1e-10


@pytest.mark.parametrize("name", ["lqr", "pendulum", "iiwa", "swing-up", "swing-up, 45 steps"])
def test_one_substitution_solves_to_rounding_where_no_rows_but_bounds_of_decisions_are_active(name):
    (problem, *_), _, function, _ = solved(name)
    system, rng = function.system, np.random.default_rng(6)
    r, d, values = (rng.normal(size=size) for size in system.sizes_of_parts)
    right, start = PrimalDual(r, d, np.where(system.active, values, 0.0)), rng.normal(size=problem.n_states)
    once, given = Triple(PrimalDual(*map(np.empty_like, (r, d, values)))), Triple(right, start)
    assert kkt_in_c.declared("system_other_rows", 1, ctypes.c_int)(system.address) == 0
    kkt_in_c.declared("system_solve_once", 3)(system.address, given.address, once.address)
    refined, residual = function.factors.solve(right, start)
    assert residual < 1e-14
    for part in ("x", "costates", "forces"):
        found, expected = getattr(once.point, part), getattr(refined, part)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max(initial=0))


@pytest.mark.parametrize("name", CASES)
def test_both_products_are_adjoint(name):
    (_, s0, psi, context), _, function, _ = solved(name)
    slope, rng = random_slope(function.system, 2), np.random.default_rng(3)
    slope[: len(s0)] = 0.0
    parts = ByParameters(*(rng.normal(size=len(x)) for x in (psi, s0, context)))
    one = slope @ function.push(parts)[0].x
    adjoint, _ = kkt_in_c.adjoint_of(function.factors, slope)
    other = np.concatenate(kkt_in_c.pull(function.system, adjoint)) @ np.concatenate(parts)
    np.testing.assert_allclose(one, other, rtol=1e-9)


@pytest.mark.parametrize("name", ["integrator", "iiwa at a limit", "tanh network"])
def test_derivative_by_the_initial_state_equals_differences_of_solutions(name):
    (problem, s0, psi, context), solution, function, _ = solved(name)
    direction = np.random.default_rng(3).normal(size=len(s0))
    found = function.push(ByParameters(np.zeros(len(psi)), direction, np.zeros(len(context))))[0].x
    errors = []
    for h in (1e-3, 1e-4, 1e-5):
        ends = [
            Ipopt(tolerance=1e-12).solve(problem, s0 + sign * h * direction, psi, context, guess=solution)
            for sign in (1, -1)
        ]
        right, left = (by_stage(end.states, end.actions) for end in ends)
        slope = (right - left) / (2 * h)
        errors.append(np.abs(slope - found).max() / np.abs(slope).max())
    assert min(errors) < 1e-6


@pytest.mark.parametrize("name", ["tanh network", "iiwa at a limit", "integrator"])
def test_curvature_and_qualification_equal_their_dense_definitions(name):
    _, _, function, _ = solved(name)
    system, factors = function.system, function.factors
    H, Z, rows = dense_parts(system)
    Z = Z / system.roots  # each decision in units of its own curvature
    rows = rows[system.active] @ Z
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    _, singular, right = np.linalg.svd(rows)
    free = right[len(singular) :].T
    values = np.linalg.eigvalsh(free.T @ Z.T @ H @ Z @ free)
    assert len(rows) > 0
    np.testing.assert_allclose(factors.qualification, singular.min(), rtol=1e-2)
    np.testing.assert_allclose(factors.curvature, values[0], rtol=4e-2)


@pytest.mark.parametrize("name", ["tanh network", "iiwa at a limit", "integrator"])
def test_the_lowest_mode_follows_the_dynamics_and_has_the_lowest_curvature(name):
    _, _, function, _ = solved(name)
    system = function.system
    lowest, mode = function.factors.curvature, c.read(system.structure.lowest_mode, len(system.point.x))
    H, Z, rows = dense_parts(system)
    decisions = mode[system.instance.rows.decisions]
    np.testing.assert_allclose(Z @ decisions, mode, atol=1e-12 * np.abs(mode).max())
    np.testing.assert_allclose(np.linalg.norm(system.roots * decisions), 1.0)
    np.testing.assert_allclose(rows[system.active] @ mode, 0.0, atol=1e-7 * np.abs(mode).max())
    np.testing.assert_allclose(mode @ H @ mode, lowest, rtol=4e-2)


@pytest.mark.parametrize("name", ["tanh network", "iiwa at a limit", "integrator"])
def test_curvatures_of_entries_by_themselves_equal_the_dense_product(name):
    """|H_t| + |F_t|' |H_t+1| |F_t|, on the diagonal."""
    (problem, *_), _, function, _ = solved(name)
    system, d = function.system, kkt_in_c.derivatives_of(function.system)
    T, n_s, n_x = problem.horizon, problem.n_states, problem.n_states + problem.n_actions
    H = np.abs(dense_parts(system)[0])
    expected = np.diag(H).copy()
    for t in range(T):
        F = np.abs(d.F[t * n_s * n_x :][: n_s * n_x].reshape(n_x, n_s).T)
        next_ = slice((t + 1) * n_x, (t + 1) * n_x + n_s)
        expected[t * n_x : (t + 1) * n_x] += np.diag(F.T @ H[next_, next_] @ F)
    np.testing.assert_allclose(c.read(system.structure.curvature, len(expected)), expected, rtol=1e-13)


@pytest.mark.parametrize(("share", "curvature"), [(1.0, 1.0), (2e-12, 1.0), (5e-13, 5e-13), (0.0, 0.0)])
def test_a_decision_is_measured_by_its_own_curvature_down_to_a_trillionth_of_the_largest(share, curvature):
    """Of (u_0 - 1)^2 + share (u_1 - 1)^2 both eigenvalues are one in the units of each; without them, `share`."""
    u, s = ca.SX.sym("u", 2), ca.SX.sym("s")
    cost = (u[0] - 1) ** 2 + share * (u[1] - 1) ** 2
    problem = OCP.from_expressions(state=s, action=u, horizon=1, dynamics=s + u[0], stage_cost=cost)
    plan = Riccati().solve(problem, [0.0], guess=Trajectory([[0.0], [1.0]], [[0.9, 1.0]]))
    found = Factorisation(at_solution(problem, plan)).curvature
    np.testing.assert_allclose(found, curvature, rtol=1e-6, atol=1e-20)


def dense_parts(system):
    """H (n_w, n_w), Z (n_w, n_decisions) from decisions to what follows by the dynamics, and rows (n_rows, n_w)."""
    problem, d, size = system.instance.problem, kkt_in_c.derivatives_of(system), len(system.point.x)
    T, n_s, n_x = problem.horizon, problem.n_states, problem.n_states + problem.n_actions
    H, Z = np.zeros((size, size)), np.zeros((size, len(system.instance.rows.decisions)))
    Z[system.instance.rows.decisions, np.arange(Z.shape[1])] = 1.0
    for t in range(T + 1):
        n, at = (n_x if t < T else n_s), slice(t * n_x, t * n_x + (n_x if t < T else n_s))
        lower = np.tril(d.H[t * n_x * n_x :][: n * n].reshape(n, n).T)
        H[at, at] = lower + np.tril(lower, -1).T
        if t < T:
            Z[(t + 1) * n_x : (t + 1) * n_x + n_s] = d.F[t * n_s * n_x :][: n_s * n_x].reshape(n_x, n_s).T @ Z[at]
    return H, Z, np.array([kkt_in_c.rows_along(system, column) for column in np.eye(size)]).T


def test_unstable_dynamics_do_not_hide_a_minimum():
    """s' = 1.3 s + u over 60 steps: the first action is worth 7e6 at the end, squared, beside an effort of one."""
    s, u, psi = ca.SX.sym("s"), ca.SX.sym("u"), ca.SX.sym("psi")
    problem = OCP.from_expressions(
        state=s, action=u, parameters=psi, horizon=60, dynamics=1.3 * s + u, stage_cost=psi * s**2 + u**2
    )
    solution = Riccati().solve(problem, [1.0], [1.0]).raise_if_failed()
    gradients = sensitivity(problem, solution).pull(np.zeros((61, 1)), np.eye(60)[:, :1])
    assert gradients.certificate.certified
    gain = []  # of u_0 = -K s_0 by the recursion of Riccati, for psi = 1 +- h
    for q in (1 + 1e-6, 1 - 1e-6):
        p = 0.0
        for _ in range(60):
            k = 1.3 * p / (1 + p)
            p = q + k**2 + p * (1.3 - k) ** 2
        gain.append(k)
    np.testing.assert_allclose(gradients.psi, -(gain[0] - gain[1]) / 2e-6, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "barrier"), [("integrator", 0.0), ("iiwa at a limit", 0.0), ("tanh network", 0.0), *SMOOTHED.items()]
)
def test_change_of_the_adjoint_nearby_is_that_between_two_linearisations(name, barrier):
    _, _, function, _ = solved(name, barrier)
    system, rng = function.system, np.random.default_rng(4)
    slope = rng.normal(size=len(system.point.x))
    adjoint, _ = kkt_in_c.adjoint_of(function.factors, slope)
    point, given_start = system.point, np.arange(len(system.point.x)) >= len(system.instance.s0)
    nearby = PrimalDual(
        point.x + 1e-6 * rng.normal(size=point.x.shape) * given_start,
        point.costates + 1e-4 * rng.normal(size=point.costates.shape),
        point.forces * (1 + 1e-4 * rng.normal(size=point.forces.shape)),
    )
    there = kkt_in_c.linearise(system.instance, nearby, system.active)
    found = kkt_in_c.change_nearby(system, there, slope, adjoint)
    moved, _ = kkt_in_c.adjoint_of(Factorisation(kkt_in_c.linearise(system.instance, nearby, system.active)), slope)
    decisions = system.instance.rows.decisions
    one, other = (system.roots * part.x[decisions] for part in (moved, adjoint))
    np.testing.assert_allclose(found, np.linalg.norm(one - other) / np.linalg.norm(other), rtol=1e-2, atol=1e-8)


@pytest.mark.parametrize("name", ["swing-up, 45 steps", "iiwa at a limit", "tanh network"])
def test_differences_of_first_derivatives_show_the_residual_of_the_adjoint_nearby(name):
    _, _, function, _ = solved(name)
    system, rng = function.system, np.random.default_rng(5)
    slope, given_start = rng.normal(size=len(system.point.x)), len(system.instance.s0)
    adjoint, _ = kkt_in_c.adjoint_of(function.factors, slope)
    move = 1e-7 * rng.normal(size=slope.shape) * (np.arange(len(slope)) >= given_start)
    costates = system.point.costates * (1 + 1e-5 * rng.normal(size=system.point.costates.shape))
    moved = replace(system.point, x=system.point.x + move, costates=costates)
    there = kkt_in_c.linearise(system.instance, moved, system.active)
    kink, residual = kkt_in_c.kink_nearby(system, there, adjoint)
    expected = (slope - kkt_in_c.balance(there, adjoint))[given_start:]
    assert kink < 1e-3
    assert np.abs(expected).max() > 1e-6
    np.testing.assert_allclose(residual.x[given_start:], expected, rtol=0, atol=3e-7)
    np.testing.assert_allclose(residual.costates, -kkt_in_c.defects_along(there, adjoint.x), rtol=0, atol=1e-7)


@pytest.mark.parametrize("name", ["swing-up, 45 steps", "tanh network"])
def test_adjoint_is_not_found_where_these_factors_are_of_no_use(name):
    _, _, function, _ = solved(name)
    system, slope = function.system, np.ones(len(function.system.point.x))
    far = replace(system.point, costates=system.point.costates * -1e4)  # another Hessian
    there = kkt_in_c.linearise(system.instance, far, system.active)
    assert kkt_in_c.change_nearby(system, there, slope, kkt_in_c.adjoint_of(function.factors, slope)[0]) == np.inf


@pytest.mark.parametrize("name", ["integrator", "tanh network", "iiwa at a limit"])
def test_the_newton_step_from_a_perturbed_solution_leads_back_to_it(name):
    _, _, function, _ = solved(name)
    system, rng = function.system, np.random.default_rng(6)
    moved = replace(
        system.point, costates=system.point.costates * (1 + 1e-5 * rng.normal(size=system.point.costates.shape))
    )
    there = kkt_in_c.linearise(system.instance, moved, system.active)
    step = kkt_in_c.newton_step(Factorisation(there).system)
    scale = np.abs(system.point.costates).max()
    np.testing.assert_allclose(moved.costates + step.costates, system.point.costates, rtol=0, atol=1e-8 * scale)


@pytest.mark.parametrize("steps", [1, 2, 5, 31, 40])
def test_qualification_of_states_at_their_bounds_is_the_smallest_singular_value_of_sums_of_actions(steps):
    """s_t = u_0 + .. + u_{t-1} <= 1 at every t: rows (1, .., 1, 0, .., 0) / sqrt t; from few rows, and from many."""
    s, u = ca.SX.sym("s"), ca.SX.sym("u")
    cost = {"stage_cost": u**2 - 100 * s, "terminal_cost": -100 * s}
    problem = OCP.from_expressions(state=s, action=u, horizon=steps, dynamics=s + u, state_bounds=(-9, 1), **cost)
    found = sensitivity(problem, Riccati(1e-10).solve(problem, [0.0]), "flag")
    certificate = found.pull(np.ones((steps + 1, 1)), np.ones((steps, 1))).certificate
    rows = np.tril(np.ones((steps, steps))) / np.sqrt(np.arange(1, steps + 1))[:, None]
    assert certificate.active.sum() == steps
    np.testing.assert_allclose(certificate.qualification, np.linalg.svd(rows)[1].min(), rtol=0.1)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0 - 1e-4, 1.0])
def test_qualification_of_a_row_beside_actions_at_their_bounds_is_that_of_the_angle_between_them(share):
    """Rows u_1 and a u_1 + b u_2, a^2 + b^2 = 1: the smallest singular value is sqrt(1 - a)."""
    s, u = ca.SX.sym("s"), ca.SX.sym("u", 2)
    other = np.sqrt(1 - share**2)
    problem = OCP.from_expressions(
        state=s,
        action=u,
        horizon=1,
        dynamics=s + u[0],
        stage_cost=ca.sumsqr(u - 1 - ca.DM([1 + share, other])),  # both rows press alike at u = (1, 1)
        action_bounds=([-9, -9], [1, 9]),
        path_constraint=share * u[0] + other * u[1] - (share + other),
    )
    solution = Riccati(1e-10).solve(problem, [0.0])
    certificate = sensitivity(problem, solution, "flag").pull(np.ones((2, 1)), np.ones((1, 2))).certificate
    assert certificate.active.sum() == 2
    np.testing.assert_allclose(certificate.qualification, np.sqrt(1 - share), rtol=1e-6)
    assert certificate.certified is (share < 1)


def test_the_lanczos_method_keeps_its_basis_orthonormal_where_products_hardly_differ():
    """A = I + 1e-9 D: what a product adds to the basis is 1e-9 of it, so that one orthogonalisation leaves 1e-7."""
    n, most = 8, 5
    rng = np.random.default_rng(0)
    eigenvalues, start = 1 + 1e-9 * rng.normal(size=n), rng.normal(size=n)
    vector, basis, error = start.copy(), np.zeros((most + 1, n)), ctypes.c_double()

    @ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.POINTER(ctypes.c_double), ctypes.POINTER(ctypes.c_double))
    def product(_, v, result):
        for i in range(n):
            result[i] = eigenvalues[i] * v[i]

    lanczos = ctypes.CDLL(c.library()._name).kpirl_mpc_lanczos
    lanczos.argtypes, lanczos.restype = (
        [*[ctypes.c_void_p] * 2, *[ctypes.c_int] * 3, *[ctypes.c_void_p] * 3],
        ctypes.c_double,
    )
    arrays = vector.ctypes.data, basis.ctypes.data, ctypes.addressof(error)
    value = lanczos(ctypes.cast(product, ctypes.c_void_p), None, n, most, 1, *arrays)
    known = basis[:-1][np.linalg.norm(basis[:-1], axis=1) > 0]
    assert len(known) == 3  # enough for a first digit
    np.testing.assert_allclose(known @ known.T, np.eye(3), rtol=0, atol=1e-14)
    np.testing.assert_allclose(value, eigenvalues.max(), rtol=1e-9)
    np.testing.assert_allclose(basis[-1], eigenvalues * vector, rtol=0, atol=1e-14)
