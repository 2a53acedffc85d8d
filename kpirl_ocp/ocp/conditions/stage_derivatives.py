"""Values and derivatives of all stages at once, dense, as the structured solvers and sensitivities take them.

With x_t = (s_t, u_t) and the Lagrangian of the dynamics and path constraints

    sum_t l(x_t) + lambda_t . (f(x_t) - s_{t+1}) + mu_t . h(x_t)  +  l_T(s_T),

first derivatives are F_t = df/dx_t, G_t = dh/dx_t and r_t = gradient with respect to x_t, second ones
H_t = d^2 (l + lambda_t . f + mu_t . h) / dx_t^2. Bounds are linear and are added by whoever needs them. Matrices of all
stages lie side by side, vectors are columns: F (n_s, n_x T), G (n_h, n_x T), H (n_x, n_x T), r (n_x, T).
Derivatives of f come from `OCP.dynamics_derivatives`.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TypeAlias

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.problem.linearised_dynamics import LinearisedDynamics, depends_on_psi, without_psi
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.trajectory_cost import TrajectoryCost, stage_costs
from kpirl_ocp.types import Array

Symbol: TypeAlias = "ca.SX | ca.MX"


@lru_cache(maxsize=64)
def values(problem: OCP) -> ca.Function:
    """(S (n_s, T+1), U (n_u, T), psi, c) -> J, defects f - s_next (n_s, T), path constraints h (n_h, T)."""
    states, actions, psi, context = point = problem.symbols()
    cost = TrajectoryCost(problem, 1)
    successors = dynamics_alone(problem).map(problem.horizon)(states[:, :-1], actions, psi_by_stage(problem, psi))
    total = cost.first(states, actions, cost.coefficients(psi, context))[0]
    outputs = [total, successors - states[:, 1:], problem.path(*point)]
    return ca.Function("stage_values", point, [ca.densify(x) for x in outputs])


@lru_cache(maxsize=64)
def first(problem: OCP) -> ca.Function:
    """(S, U, psi, c, Lambda (n_s, T), M (n_h, T)) -> `values`, gradient of J (n_x, T) and (n_s,), r and r_T (n_s,)."""
    states, actions, psi, context, costates, forces = at = symbols(problem)
    point, steps = at[:4], problem.horizon
    cost = TrajectoryCost(problem, 1)
    total, by_states, by_actions = cost.first(states, actions, cost.coefficients(psi, context))
    dynamics = linearise_dynamics(problem, states, actions, psi, costates)
    Ft_lambda, path = dynamics.Ft_lambda, problem.path(*point)
    if problem.path_constraint is not None:
        Ft_lambda += stage_gradient(problem.path_constraint).map(steps)(*stage_arguments(problem, *point), forces)
    slope, last_slope = ca.vertcat(by_states[:, :steps], by_actions), by_states[:, steps]
    lagrangian = _lagrangian(problem, slope, last_slope, Ft_lambda, costates)
    outputs = [total, dynamics.value - states[:, 1:], path, slope, last_slope, *lagrangian]
    return ca.Function("stage_first", at, [ca.densify(x) for x in outputs])


@lru_cache(maxsize=64)
def second(problem: OCP) -> ca.Function:
    """The arguments of `first` -> its outputs, then F, G, H and H_T (n_s, n_s)."""
    states, actions, psi, context, costates, forces = at = symbols(problem)
    point, steps = at[:4], problem.horizon
    theta = TrajectoryCost(problem, 1).coefficients(psi, context)
    dynamics, prepared = linearise_dynamics(problem, states, actions, psi, costates).second()
    arguments = stage_arguments(problem, *point)
    if problem.path_constraint is None:
        arguments = arguments[:2]
    value, slope, successors, path, constraints, F, G, H = _stage_second(problem, dynamics).map(steps)(
        *arguments, theta.stages, costates, forces, *prepared
    )
    _, final = stage_costs(problem)
    last, last_slope, H_last = final.hessian(states[:, steps], ca.MX(0, 1), theta.last)
    lagrangian = _lagrangian(problem, slope, last_slope, constraints, costates)
    outputs = [ca.sum2(value) + last, successors - states[:, 1:], path, slope, last_slope, *lagrangian, F, G, H, H_last]
    return ca.Function("stage_second", at, [ca.densify(x) for x in outputs])


def linearise_dynamics(problem: OCP, states: ca.MX, actions: ca.MX, psi: ca.MX, costates: ca.MX) -> LinearisedDynamics:
    """The dynamics at all stages of S (n_s, T+1), U (n_u, T), psi and Lambda (n_s, T)."""
    at = states[:, :-1], actions, psi_by_stage(problem, psi), costates
    return problem.dynamics_derivatives.linearise(*at)


@lru_cache(maxsize=64)
def dynamics_second(problem: OCP) -> ca.Function:
    """Of one stage: (s, u, p, lambda) -> f_s (n_s, n_s), f_u (n_s, n_u), (lambda . f)'' (n_x, n_x).

    p: of `OCP.transition`; psi where the dynamics see neither the context nor the schedule.
    """
    n_s, n_p = problem.n_states, problem.transition.size1_in(2)
    sizes = {"s": n_s, "u": problem.n_actions, "p": n_p, "lambda": n_s}
    s, u, p, costate = at = [ca.MX.sym(name, size) for name, size in sizes.items()]
    given = p if depends_on_psi(problem.transition) else ca.MX(0, 1)
    function, arguments = problem.dynamics_derivatives.linearise(s, u, given, costate).second()
    _, F, H = function.call(arguments, True, False)
    return ca.Function("dynamics_second", at, [F[:, :n_s], F[:, n_s:], H])


@lru_cache(maxsize=64)
def dynamics_jacobian(problem: OCP) -> ca.Function:
    """Of one stage: (s, u, p) -> f_s (n_s, n_s), f_u (n_s, n_u)."""
    *at, costate = dynamics_second(problem).mx_in()
    by_s, by_u, _ = dynamics_second(problem).call([*at, ca.MX.zeros(costate.shape)], True, False)
    return ca.Function("dynamics_jacobian", at, [by_s, by_u])


def by_time(problem: OCP, x: Array, last: Array) -> Array:
    """Columns x_t (n_x, T), flat, and s_T (n_s,) as one vector (s_0, .. s_T, u_0 .. u_{T-1})."""
    columns = x.reshape(problem.horizon, -1)
    return np.concatenate([columns[:, : problem.n_states].ravel(), last, columns[:, problem.n_states :].ravel()])


def symbols(problem: OCP) -> list[ca.MX]:
    """S, U, psi, c, Lambda and M."""
    shapes = {"Lambda": (problem.n_states, problem.horizon), "M": (problem.n_path, problem.horizon)}
    return [*problem.symbols(), *(ca.MX.sym(name, *shape) for name, shape in shapes.items())]


def stage_arguments(problem: OCP, states: ca.MX, actions: ca.MX, psi: ca.MX, context: ca.MX) -> list[ca.MX]:
    """s, u, psi, c and d of all stages, as columns."""
    wide = [_repeat(problem, value) for value in (psi, context)]
    return [states[:, :-1], actions, *wide, problem.stages[:, :-1]]


def _lagrangian(problem: OCP, slope: ca.MX, last: ca.MX, constraints: ca.MX, costates: ca.MX) -> list[ca.MX]:
    """r and r_T; `constraints` holds the columns F' lambda + G' mu."""
    arriving = ca.horzcat(ca.MX.zeros(problem.n_states, 1), costates)  # s_t is where stage t-1 arrives
    leaving = ca.vertcat(arriving[:, : problem.horizon], ca.MX.zeros(problem.n_actions, problem.horizon))
    return [slope + constraints - leaving, last - arriving[:, problem.horizon]]


def psi_by_stage(problem: OCP, psi: ca.MX) -> ca.MX:
    """psi for every stage; (0, T) if the dynamics do not depend on it."""
    return _repeat(problem, psi) if depends_on_psi(problem.transition) else ca.MX(0, problem.horizon)


def dynamics_alone(problem: OCP) -> ca.Function:
    """f(s, u, psi), psi as in `psi_by_stage`."""
    return problem.transition if depends_on_psi(problem.transition) else without_psi(problem.transition)


def _repeat(problem: OCP, value: ca.MX) -> ca.MX:
    return ca.repmat(value, 1, problem.horizon)


def _stage_second(problem: OCP, dynamics: ca.Function) -> ca.Function:
    """(s, u, psi, c, d, theta, lambda, mu, arguments of dynamics) -> l, its gradient, f, h, F' lambda + G' mu, F, G, H.

    Of one stage; without path constraints (s, u, theta, ..). dynamics: that of `LinearisedDynamics.second`.
    """
    path, (running, _) = problem.path_constraint, stage_costs(problem)
    names = ("s", "u", "psi", "c", "d") if path is not None else ("s", "u")
    point = [ca.MX.sym(name, problem.stage_cost.size1_in(i)) for i, name in enumerate(names)]
    theta = ca.MX.sym("theta", running.hessian.size1_in(2))
    costate, force = ca.MX.sym("lambda", problem.n_states), ca.MX.sym("mu", problem.n_path)
    prepared = [ca.MX.sym("prepared", dynamics.size1_in(i)) for i in range(dynamics.n_in())]
    value, slope, curvature = running.hessian(*point[:2], theta)
    successor, F, H = dynamics.call(prepared, True, False)
    F, H = ca.densify(F), _plus_sparse(H, curvature)
    constraints = (costate.T @ F).T
    G, h = ca.MX(0, problem.n_states + problem.n_actions), ca.MX(0, 1)
    if path is not None:
        h, G = path(*point), ca.densify(_stage_jacobian(path)(*point))
        H, constraints = H + _stage_hessian(path)(*point, force), constraints + (force.T @ G).T
    outputs = [ca.densify(x) for x in (value, slope, successor, h, constraints, F, G, H)]
    return ca.Function("stage_second", [*point, theta, costate, force, *prepared], outputs)


def _plus_sparse(dense: ca.MX, sparse: ca.MX) -> ca.MX:
    """The sum as a dense matrix; only entries that are there are touched."""
    total = ca.MX(ca.densify(dense))
    rows, columns = sparse.sparsity().get_triplet()
    where = [row + column * sparse.size1() for row, column in zip(rows, columns, strict=True)]
    if where:
        total.nz[where] = total.nz[where] + sparse.nz[:]
    return total


def pairing(function: ca.Function) -> tuple[list[Symbol], Symbol, Symbol]:
    """Inputs of g(s, u, psi, c, d), weights mu, and g; of one kind, SX where the function is."""
    kind = ca.SX if function.is_a("SXFunction") else ca.MX
    inputs = [kind.sym(name, function.size1_in(i)) for i, name in enumerate(("s", "u", "psi", "c", "d"))]
    return inputs, kind.sym("mu", function.size1_out(0)), function(*inputs)


def pairing_gradient(inputs: list[Symbol], mu: Symbol, value: Symbol) -> Symbol:
    """The gradient of mu . g with respect to (s, u), of the results of `pairing`."""
    return ca.vertcat(*(ca.gradient(ca.dot(mu, value), x) for x in inputs[:2]))


def stage_gradient(function: ca.Function) -> ca.Function:
    """(s, u, psi, c, d, mu) -> gradient of mu . g with respect to (s, u)."""
    inputs, mu, value = pairing(function)
    return ca.Function("gradient", [*inputs, mu], [ca.densify(pairing_gradient(inputs, mu, value))])


def _stage_jacobian(function: ca.Function) -> ca.Function:
    """(s, u, psi, c, d) -> Jacobian of g with respect to (s, u)."""
    inputs, _, value = pairing(function)
    return ca.Function("jacobian", inputs, [ca.densify(ca.horzcat(*(ca.jacobian(value, x) for x in inputs[:2])))])


def _stage_hessian(function: ca.Function) -> ca.Function:
    """(s, u, psi, c, d, mu) -> second derivative of mu . g with respect to (s, u)."""
    inputs, mu, value = pairing(function)
    slope = pairing_gradient(inputs, mu, value)
    hessian = ca.horzcat(*(ca.jacobian(slope, x) for x in inputs[:2]))
    return ca.Function("hessian", [*inputs, mu], [ca.densify(hessian)])
