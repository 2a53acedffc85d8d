"""How psi and the context enter the KKT conditions: mixed second derivatives, stage by stage.

With the Lagrangian L_t(x_t; p) = l + lambda . f + mu . h of a stage and p = (psi, c), `pull` gives

    d/dp sum_t  dx_t . grad_x L_t + dlambda_t . f + dmu_t . h      (and dx_T . grad l_T at the end),

and `push` the changes of grad_x L_t, f and h along dp. What does not depend on p costs nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.problem import OCP
from kpirl_ocp.ocp.stages import stages

Symbol: TypeAlias = "ca.SX | ca.MX"


@dataclass(frozen=True, eq=False)
class Influence:
    """Functions of a point S, U, psi, c, Lambda, M as in `Stages`.

    pull: also (dX (n_x, T), ds_T (n_s,), dLambda (n_s, T), dM (n_h, T)) -> gradients (n_psi,) and (n_c,).
    push: also (dpsi, dc) -> dr (n_x, T), dr_T (n_s,), ddefects (n_s, T), dh (n_h, T).
    """

    pull: ca.Function
    push: ca.Function


@lru_cache(maxsize=64)
def influence(problem: OCP) -> Influence:
    """The functions of a problem; cached, and compiled as its `Stages` are."""
    steps, n_s, n_u = problem.horizon, problem.n_states, problem.n_actions
    states, actions = ca.MX.sym("S", n_s, steps + 1), ca.MX.sym("U", n_u, steps)
    psi, context = ca.MX.sym("psi", problem.n_parameters), ca.MX.sym("c", problem.n_context)
    costates, forces = ca.MX.sym("Lambda", n_s, steps), ca.MX.sym("M", problem.n_path, steps)
    dX, last = ca.MX.sym("dX", n_s + n_u, steps), ca.MX.sym("ds_T", n_s)
    dcostates, dforces = ca.MX.sym("dLambda", n_s, steps), ca.MX.sym("dM", problem.n_path, steps)
    dpsi, dcontext = ca.MX.sym("dpsi", psi.numel()), ca.MX.sym("dc", context.numel())
    schedule = ca.DM(np.asarray(problem.schedule)).T
    ones = ca.DM.ones(1, steps)

    def repeat(*values: ca.MX) -> list[ca.MX]:
        return [ca.repmat(value, 1, steps) for value in values]

    point = [states[:, :steps], actions, *repeat(psi, context), schedule[:, :steps]]
    final = [states[:, steps], ca.MX(0, 1), psi, context, schedule[:, steps]]
    terms = [(problem.stage_cost, ones, 0 * ones)]  # function, its weights, their change
    if problem.path_constraint is not None:
        terms.append((problem.path_constraint, forces, dforces))

    by_psi, by_context = _pull(_terminal(problem))(*final, 1, last, 0)
    push = [0, _push(_terminal(problem))(*final, 1, dpsi, dcontext)[0], ca.MX(n_s, steps), ca.MX(0, steps)]
    for function, weights, dweights in terms:
        pulled = _pull(function).map(steps)(*point, weights, dX, dweights)
        by_psi, by_context = by_psi + ca.sum2(pulled[0]), by_context + ca.sum2(pulled[1])
        slope, value = _push(function).map(steps)(*point, weights, *repeat(dpsi, dcontext))
        push[0] += slope
        push[3] = value
    if problem.path_constraint is None:
        push[3] = ca.MX(0, steps)
    if problem.dynamics.jac_sparsity(0, 2).nnz():
        dynamics = _dynamics(problem)
        by_psi += ca.sum2(_pull(dynamics).map(steps)(*point, costates, dX, dcostates)[0])
        slope, push[2] = _push(dynamics).map(steps)(*point, costates, *repeat(dpsi, dcontext))
        push[0] += slope

    at = [states, actions, psi, context, costates, forces]
    compile = stages(problem).compile
    pulled = [ca.densify(x) for x in (by_psi, by_context)]
    return Influence(
        pull=compile(ca.Function("pull", [*at, dX, last, dcostates, dforces], pulled)),
        push=compile(ca.Function("push", [*at, dpsi, dcontext], [ca.densify(x) for x in push])),
    )


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
    inputs = _inputs(problem, problem.dynamics, actions=problem.n_actions)
    return ca.Function("dynamics", inputs, [problem.dynamics(*inputs[:3])])


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
