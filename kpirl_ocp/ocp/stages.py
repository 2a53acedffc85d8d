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

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.problem import OCP
from kpirl_ocp.types import Array


@lru_cache(maxsize=64)
def values(problem: OCP) -> ca.Function:
    """(S (n_s, T+1), U (n_u, T), psi, c) -> J, defects f - s_next (n_s, T), path constraints h (n_h, T)."""
    point, _ = _symbols(problem)
    return ca.Function("stage_values", point, _values(problem, point))


@lru_cache(maxsize=64)
def first(problem: OCP) -> ca.Function:
    """(S, U, psi, c, Lambda (n_s, T), M (n_h, T)) -> `values`, gradient of J (n_x, T) and (n_s,), r and r_T (n_s,)."""
    point, dual = _symbols(problem)
    states, actions, psi, _ = point
    after, *pulled = _value_vjp(problem).map(problem.horizon)(states[:, :-1], actions, _repeat(problem, psi), dual[0])
    outputs = [*_values(problem, point, after), *_gradients(problem, point, dual, ca.vertcat(*pulled))]
    return ca.Function("stage_first", [*point, *dual], outputs)


@lru_cache(maxsize=64)
def second(problem: OCP) -> ca.Function:
    """The arguments of `first` -> its outputs, then F, G, H and H_T (n_s, n_s)."""
    point, dual = _symbols(problem)
    *matrices, pulled, after = _matrices(problem, *point, *dual)
    outputs = [*_values(problem, point, after), *_gradients(problem, point, dual, pulled), *matrices]
    return ca.Function("stage_second", [*point, *dual], outputs)


def by_time(problem: OCP, x: Array, last: Array) -> Array:
    """Columns x_t (n_x, T), flat, and s_T (n_s,) as one vector (s_0, .. s_T, u_0 .. u_{T-1})."""
    columns = x.reshape(problem.horizon, -1)
    return np.concatenate([columns[:, : problem.n_states].ravel(), last, columns[:, problem.n_states :].ravel()])


def _symbols(problem: OCP) -> tuple[list[ca.MX], list[ca.MX]]:
    """S, U, psi, c and Lambda, M."""
    steps, n_s = problem.horizon, problem.n_states
    point = [
        ca.MX.sym("S", n_s, steps + 1),
        ca.MX.sym("U", problem.n_actions, steps),
        ca.MX.sym("psi", problem.n_parameters),
        ca.MX.sym("c", problem.n_context),
    ]
    return point, [ca.MX.sym("Lambda", n_s, steps), ca.MX.sym("M", problem.n_path, steps)]


def _values(problem: OCP, point: list[ca.MX], after: ca.MX | None = None) -> list[ca.MX]:
    """J, defects and path constraints; `after` are the columns f(x_t) if they are known."""
    states, actions, psi, context = point
    if after is None:
        after = problem.dynamics.map(problem.horizon)(states[:, :-1], actions, _repeat(problem, psi))
    cost, path = problem.cost(states, actions, psi, context), problem.path(states, actions, psi, context)
    return [cost, ca.densify(after - states[:, 1:]), ca.densify(path)]


def _gradients(problem: OCP, point: list[ca.MX], dual: list[ca.MX], pulled: ca.MX) -> list[ca.MX]:
    """Gradients of J and of the Lagrangian; `pulled` holds the columns F' lambda (n_x, T)."""
    (states, actions, psi, context), (costates, forces) = point, dual
    steps, n_s = problem.horizon, problem.n_states
    before, schedule = states[:, :-1], ca.DM(np.asarray(problem.schedule)).T
    arguments = [before, actions, _repeat(problem, psi), _repeat(problem, context), schedule[:, :steps]]
    cost = _stage_gradient(problem.stage_cost).map(steps)(*arguments, ca.DM.ones(1, steps))
    last = _terminal(problem)(states[:, -1], psi, context, schedule[:, steps])[0]
    lagrangian = cost + pulled
    if problem.path_constraint is not None:
        lagrangian += _stage_gradient(problem.path_constraint).map(steps)(*arguments, forces)
    arriving = ca.horzcat(ca.MX.zeros(n_s, 1), costates)  # s_t is where stage t-1 arrives
    lagrangian -= ca.vertcat(arriving[:, :steps], ca.MX.zeros(problem.n_actions, steps))
    return [ca.densify(x) for x in (cost, last, lagrangian, last - arriving[:, steps])]


def _matrices(
    problem: OCP, states: ca.MX, actions: ca.MX, psi: ca.MX, context: ca.MX, costates: ca.MX, forces: ca.MX
) -> list[ca.MX]:
    """F, G, H, H_T, F' lambda and f."""
    steps, schedule = problem.horizon, ca.DM(np.asarray(problem.schedule)).T
    arguments = [states[:, :-1], actions, _repeat(problem, psi), _repeat(problem, context), schedule[:, :steps]]
    F, G, H, pulled, after = _stage_matrices(problem).map(steps)(*arguments, costates, forces)
    last = _terminal(problem)(states[:, -1], psi, context, schedule[:, steps])[1]
    return [ca.densify(x) for x in (F, G, H, last, pulled, after)]


def _repeat(problem: OCP, value: ca.MX) -> ca.MX:
    return ca.repmat(value, 1, problem.horizon)


def _value_vjp(problem: OCP) -> ca.Function:
    """(s, u, psi, lambda) -> f, f_s' lambda, f_u' lambda."""
    derivatives = problem.dynamics_derivatives
    if derivatives.value_vjp is not None:
        return derivatives.value_vjp
    inputs = _dynamics_symbols(problem)
    outputs = [problem.dynamics(*inputs[:3]), *derivatives.vjp(*inputs)[:2]]
    return ca.Function("value_vjp", inputs, outputs)


def _expansion(problem: OCP) -> ca.Function:
    """(s, u, psi, lambda) -> f, f_s, f_u, second derivative of lambda . f."""
    derivatives = problem.dynamics_derivatives
    if derivatives.expansion is not None:
        return derivatives.expansion
    inputs = _dynamics_symbols(problem)
    outputs = [problem.dynamics(*inputs[:3]), *derivatives.jacobian(*inputs[:3]), derivatives.hessian(*inputs)]
    return ca.Function("expansion", inputs, outputs)


def _dynamics_symbols(problem: OCP) -> list[ca.MX]:
    """s, u, psi, lambda."""
    lengths = (problem.n_states, problem.n_actions, problem.n_parameters, problem.n_states)
    return [ca.MX.sym(name, length) for name, length in zip(("s", "u", "psi", "lambda"), lengths, strict=True)]


def _stage_matrices(problem: OCP) -> ca.Function:
    """(s, u, psi, c, d, lambda, mu) -> F, G, H, F' lambda and f of one stage."""
    path = problem.path_constraint
    point = [ca.MX.sym(name, problem.stage_cost.size1_in(i)) for i, name in enumerate(("s", "u", "psi", "c", "d"))]
    costate, force = ca.MX.sym("lambda", problem.n_states), ca.MX.sym("mu", problem.n_path)
    after, by_state, by_action, curvature = _expansion(problem)(*point[:3], costate)
    F = ca.densify(ca.horzcat(by_state, by_action))
    H = curvature + _stage_hessian(problem.stage_cost)(*point, 1)
    G = ca.MX(0, problem.n_states + problem.n_actions)
    if path is not None:
        G, H = _stage_jacobian(path)(*point), H + _stage_hessian(path)(*point, force)
    outputs = [ca.densify(x) for x in (F, G, H, F.T @ costate, after)]
    return ca.Function("stage_matrices", [*point, costate, force], outputs)


def _pairing(function: ca.Function) -> tuple[list[ca.SX | ca.MX], ca.SX | ca.MX, ca.SX | ca.MX]:
    """Inputs of g(s, u, psi, c, d), weights mu, and g; of one kind, SX where the function is."""
    kind = ca.SX if function.is_a("SXFunction") else ca.MX
    inputs = [kind.sym(name, function.size1_in(i)) for i, name in enumerate(("s", "u", "psi", "c", "d"))]
    return inputs, kind.sym("mu", function.size1_out(0)), function(*inputs)


def _stage_gradient(function: ca.Function) -> ca.Function:
    """(s, u, psi, c, d, mu) -> gradient of mu . g with respect to (s, u)."""
    inputs, mu, value = _pairing(function)
    return ca.Function("gradient", [*inputs, mu], [ca.densify(_gradient(ca.dot(mu, value), inputs))])


def _stage_jacobian(function: ca.Function) -> ca.Function:
    """(s, u, psi, c, d) -> Jacobian of g with respect to (s, u)."""
    inputs, _, value = _pairing(function)
    return ca.Function("jacobian", inputs, [ca.densify(ca.horzcat(*(ca.jacobian(value, x) for x in inputs[:2])))])


def _stage_hessian(function: ca.Function) -> ca.Function:
    """(s, u, psi, c, d, mu) -> second derivative of mu . g with respect to (s, u)."""
    inputs, mu, value = _pairing(function)
    slope = _gradient(ca.dot(mu, value), inputs)
    hessian = ca.horzcat(*(ca.jacobian(slope, x) for x in inputs[:2]))
    return ca.Function("hessian", [*inputs, mu], [ca.densify(hessian)])


def _gradient(value: ca.SX | ca.MX, inputs: list[ca.SX | ca.MX]) -> ca.SX | ca.MX:
    return ca.vertcat(*(ca.gradient(value, x) for x in inputs[:2]))


def _terminal(problem: OCP) -> ca.Function:
    """(s, psi, c, d) -> gradient and Hessian of l_T."""
    function = problem.terminal_cost
    kind = ca.SX if function.is_a("SXFunction") else ca.MX
    inputs = [kind.sym(name, function.size1_in(i)) for i, name in enumerate(("s", "psi", "c", "d"))]
    hessian, gradient = ca.hessian(function(*inputs), inputs[0])
    return ca.Function("terminal", inputs, [ca.densify(gradient), ca.densify(hessian)])
