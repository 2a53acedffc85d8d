"""Derivatives of the KKT conditions by psi and the context: mixed second derivatives, stage by stage.

With the Lagrangian L_t(x_t; p) = l + lambda . f + mu . h of a stage and p = (psi, c), `pull` gives

    d/dp sum_t  dx_t . grad_x L_t + dlambda_t . f + dmu_t . h      (and dx_T . grad l_T at the end),

and `push` the changes of grad_x L_t, f and h along dp. All are taken at S, U, psi, c, Lambda, M
as in `stage_derivatives.first`.
"""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.conditions.stage_derivatives import Symbol, pairing, pairing_gradient, stage_arguments, symbols
from kpirl_ocp.ocp.problem.ocp import OCP


@lru_cache(maxsize=64)
def pull(problem: OCP) -> ca.Function:
    """(S, U, psi, c, Lambda, M, dX (n_x, T), ds_T (n_s,), dLambda (n_s, T), dM (n_h, T)) -> by psi, by c."""
    steps, n_s = problem.horizon, problem.n_states
    at, stage, end = _symbols(problem)
    dX, last = ca.MX.sym("dX", n_s + problem.n_actions, steps), ca.MX.sym("ds_T", n_s)
    dcostates, dforces = ca.MX.sym("dLambda", n_s, steps), ca.MX.sym("dM", problem.n_path, steps)
    changes = {"cost": ca.DM.zeros(1, steps), "path": dforces, "dynamics": dcostates}
    by_psi, by_context = _pull(_terminal(problem))(*end, 1, last, 0)
    for name, function, weights in _terms(problem, *at[4:]):
        shares = _pull(function).map(steps)(*stage, weights, dX, changes[name])
        by_psi, by_context = by_psi + ca.sum2(shares[0]), by_context + ca.sum2(shares[1])
    outputs = [ca.densify(x) for x in (by_psi, by_context)]
    return ca.Function("pull", [*at, dX, last, dcostates, dforces], outputs)


@lru_cache(maxsize=64)
def push(problem: OCP) -> ca.Function:
    """(S, U, psi, c, Lambda, M, dpsi, dc) -> dr (n_x, T), dr_T (n_s,), ddefects (n_s, T), dh (n_h, T)."""
    steps, n_s = problem.horizon, problem.n_states
    at, stage, end = _symbols(problem)
    directions = [ca.MX.sym("dpsi", problem.n_parameters), ca.MX.sym("dc", problem.n_context)]
    slopes: ca.MX = ca.MX.zeros(n_s + problem.n_actions, steps)
    values = {"path": ca.MX(problem.n_path, steps), "dynamics": ca.MX(n_s, steps)}
    for name, function, weights in _terms(problem, *at[4:]):
        repeated = [ca.repmat(direction, 1, steps) for direction in directions]
        slope, values[name] = _push(function).map(steps)(*stage, weights, *repeated)
        slopes += slope
    last = _push(_terminal(problem))(*end, 1, *directions)[0]
    outputs = [ca.densify(x) for x in (slopes, last, values["dynamics"], values["path"])]
    return ca.Function("push", [*at, *directions], outputs)


def _symbols(problem: OCP) -> tuple[list[ca.MX], list[ca.MX], list[ca.MX]]:
    """S, U, psi, c, Lambda, M; the arguments (s, u, psi, c, d) of all stages, and those of the end."""
    states, actions, psi, context, *_ = at = symbols(problem)
    end = [states[:, -1], ca.MX(0, 1), psi, context, problem.stages[:, -1]]
    return at, stage_arguments(problem, states, actions, psi, context), end


def _terms(problem: OCP, costates: ca.MX, forces: ca.MX) -> list[tuple[str, ca.Function, ca.MX]]:
    """The functions of a stage's Lagrangian that parameters can enter, as g(s, u, psi, c, d), with their weights."""
    terms = [("cost", problem.stage_cost, ca.DM.ones(1, problem.horizon))]
    if problem.path_constraint is not None:
        terms.append(("path", problem.path_constraint, forces))
    if problem.transition.jac_sparsity(0, 2).nnz():
        terms.append(("dynamics", _dynamics(problem), costates))
    return terms


def _pull(function: ca.Function) -> ca.Function:
    """(s, u, psi, c, d, mu, dx, dmu) -> gradient with respect to psi and c of dx . grad_x (mu . g) + dmu . g."""
    inputs, mu, value = pairing(function)
    slope, kind = pairing_gradient(inputs, mu, value), type(mu)
    dx, dmu = kind.sym("dx", slope.numel()), kind.sym("dmu", mu.numel())
    total = ca.dot(dx, slope) + ca.dot(dmu, value)
    outputs = [ca.densify(ca.gradient(total, inputs[i])) for i in (2, 3)]
    return ca.Function("pull", [*inputs, mu, dx, dmu], outputs)


def _push(function: ca.Function) -> ca.Function:
    """(s, u, psi, c, d, mu, dpsi, dc) -> change of grad_x (mu . g) and of g."""
    inputs, mu, value = pairing(function)
    slope, parameters = pairing_gradient(inputs, mu, value), inputs[2:4]
    moves = [type(mu).sym("dp", p.numel()) for p in parameters]
    outputs = [sum(ca.jtimes(y, p, dp) for p, dp in zip(parameters, moves, strict=True)) for y in (slope, value)]
    return ca.Function("push", [*inputs, mu, *moves], [ca.densify(y) for y in outputs])


def _terminal(problem: OCP) -> ca.Function:
    """l_T as a function of (s, no u, psi, c, d)."""
    s, _, psi, c, d = inputs = _inputs(problem, problem.terminal_cost, actions=0)
    return ca.Function("terminal", inputs, [problem.terminal_cost(s, psi, c, d)])


def _dynamics(problem: OCP) -> ca.Function:
    """f as a function of (s, u, psi, c, d)."""
    inputs = _inputs(problem, problem.transition, actions=problem.n_actions)
    return ca.Function("dynamics", inputs, [problem.transition(*inputs[:3])])


def _inputs(problem: OCP, function: ca.Function, actions: int) -> list[Symbol]:
    """Symbols s, u, psi, c, d of the kind that a function works in."""
    kind = ca.SX if function.is_a("SXFunction") else ca.MX
    lengths = (
        problem.n_states,
        actions,
        problem.n_parameters,
        problem.n_context,
        np.asarray(problem.schedule).shape[1],
    )
    return [kind.sym(name, length) for name, length in zip(("s", "u", "psi", "c", "d"), lengths, strict=True)]
