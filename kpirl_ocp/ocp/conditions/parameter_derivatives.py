"""How psi and the context enter the KKT conditions: mixed second derivatives, stage by stage.

With the Lagrangian L_t(x_t; p) = l + lambda . f + mu . h of a stage and p = (psi, c), `pull` gives

    d/dp sum_t  dx_t . grad_x L_t + dlambda_t . f + dmu_t . h      (and dx_T . grad l_T at the end),

and `push` the changes of grad_x L_t, f and h along dp. Points are S, U, psi, c, Lambda, M as in `stages.first`.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TypeAlias

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.problem.ocp import OCP

Symbol: TypeAlias = "ca.SX | ca.MX"


@lru_cache(maxsize=64)
def pull(problem: OCP) -> ca.Function:
    """(S, U, psi, c, Lambda, M, dX (n_x, T), ds_T (n_s,), dLambda (n_s, T), dM (n_h, T)) -> by psi, by c."""
    steps, n_s = problem.horizon, problem.n_states
    at, stage, final = _points(problem)
    dX, last = ca.MX.sym("dX", n_s + problem.n_actions, steps), ca.MX.sym("ds_T", n_s)
    dcostates, dforces = ca.MX.sym("dLambda", n_s, steps), ca.MX.sym("dM", problem.n_path, steps)
    changes = {"cost": ca.DM.zeros(1, steps), "path": dforces, "dynamics": dcostates}
    by_psi, by_context = _pull(_terminal(problem))(*final, 1, last, 0)
    for name, function, weights in _terms(problem, *at[4:]):
        pulled = _pull(function).map(steps)(*stage, weights, dX, changes[name])
        by_psi, by_context = by_psi + ca.sum2(pulled[0]), by_context + ca.sum2(pulled[1])
    outputs = [ca.densify(x) for x in (by_psi, by_context)]
    return ca.Function("pull", [*at, dX, last, dcostates, dforces], outputs)


@lru_cache(maxsize=64)
def push(problem: OCP) -> ca.Function:
    """(S, U, psi, c, Lambda, M, dpsi, dc) -> dr (n_x, T), dr_T (n_s,), ddefects (n_s, T), dh (n_h, T)."""
    steps, n_s = problem.horizon, problem.n_states
    at, stage, final = _points(problem)
    directions = [ca.MX.sym("dpsi", problem.n_parameters), ca.MX.sym("dc", problem.n_context)]
    slopes: ca.MX = ca.MX.zeros(n_s + problem.n_actions, steps)
    values = {"path": ca.MX(problem.n_path, steps), "dynamics": ca.MX(n_s, steps)}
    for name, function, weights in _terms(problem, *at[4:]):
        repeated = [ca.repmat(direction, 1, steps) for direction in directions]
        slope, values[name] = _push(function).map(steps)(*stage, weights, *repeated)
        slopes += slope
    last = _push(_terminal(problem))(*final, 1, *directions)[0]
    outputs = [ca.densify(x) for x in (slopes, last, values["dynamics"], values["path"])]
    return ca.Function("push", [*at, *directions], outputs)


def _points(problem: OCP) -> tuple[list[ca.MX], list[ca.MX], list[ca.MX]]:
    """S, U, psi, c, Lambda, M; the arguments (s, u, psi, c, d) of all stages, and those of the end."""
    steps, n_s = problem.horizon, problem.n_states
    states, actions = ca.MX.sym("S", n_s, steps + 1), ca.MX.sym("U", problem.n_actions, steps)
    psi, context = ca.MX.sym("psi", problem.n_parameters), ca.MX.sym("c", problem.n_context)
    costates, forces = ca.MX.sym("Lambda", n_s, steps), ca.MX.sym("M", problem.n_path, steps)
    schedule = ca.DM(np.asarray(problem.schedule)).T
    repeated = [ca.repmat(value, 1, steps) for value in (psi, context)]
    stage = [states[:, :steps], actions, *repeated, schedule[:, :steps]]
    final = [states[:, steps], ca.MX(0, 1), psi, context, schedule[:, steps]]
    return [states, actions, psi, context, costates, forces], stage, final


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
    inputs, x, mu, value = _pairing(function)
    kind = type(mu)
    dx, dmu = kind.sym("dx", x[0].numel() + x[1].numel()), kind.sym("dmu", mu.numel())
    slope = ca.vertcat(*(ca.gradient(ca.dot(mu, value), part) for part in x))
    total = ca.dot(dx, slope) + ca.dot(dmu, value)
    outputs = [ca.densify(ca.gradient(total, inputs[i])) for i in (2, 3)]
    return ca.Function("pull", [*inputs, mu, dx, dmu], outputs)


def _push(function: ca.Function) -> ca.Function:
    """(s, u, psi, c, d, mu, dpsi, dc) -> change of grad_x (mu . g) and of g."""
    inputs, x, mu, value = _pairing(function)
    parameters = inputs[2:4]
    moves = [type(mu).sym("dp", p.numel()) for p in parameters]
    slope = ca.vertcat(*(ca.gradient(ca.dot(mu, value), part) for part in x))
    outputs = [sum(ca.jtimes(y, p, dp) for p, dp in zip(parameters, moves, strict=True)) for y in (slope, value)]
    return ca.Function("push", [*inputs, mu, *moves], [ca.densify(y) for y in outputs])


def _pairing(function: ca.Function) -> tuple[list[Symbol], list[Symbol], Symbol, Symbol]:
    """Inputs s, u, psi, c, d of g; s and u again; weights mu; and g: of one kind, SX where the function is."""
    kind = ca.SX if function.is_a("SXFunction") else ca.MX
    inputs = [kind.sym(name, function.size1_in(i)) for i, name in enumerate(("s", "u", "psi", "c", "d"))]
    return inputs, inputs[:2], kind.sym("mu", function.size1_out(0)), function(*inputs)


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
