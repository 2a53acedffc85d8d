"""Derivatives of the KKT conditions by psi and the context: mixed second derivatives, stage by stage.

With the Lagrangian L_t = l + lambda . f + z . h + nu . e of a stage, that of the end L_T = l_T + z . g_T + nu . e_T,
and p = (psi, c),

    phi(p) = sum_t  dx_t . grad_x L_t + dlambda_t . f + dz_t . h + dnu_t . e

is how (dx, dlambda, dz, dnu) weigh the conditions. `pull` gives its gradient by p, and `push` the changes of grad L, f,
h and e along dp. Vectors over all stages are x = (s_0, u_0, s_1, .., s_T); costates (T n_s,); multipliers of h and g_T;
those of e and e_T.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TypeAlias

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.conditions.scalar import scalar
from kpirl_ocp.ocp.problem.ocp import OCP

Symbol: TypeAlias = "ca.SX | ca.MX"


@lru_cache(maxsize=64)
def pull(problem: OCP) -> ca.Function:
    """(x, psi, c, lambda, z, nu, dx, dlambda, dz, dnu) -> d phi/d psi, d phi/d c."""
    at, changes = _symbols(problem), _symbols(problem)
    x, psi, c, *duals = at
    dx, _, _, *dduals = changes
    stages, ends = (_split(problem, [x, *duals]), _split(problem, [dx, *dduals]))
    by_psi, by_c = ca.MX.zeros(problem.n_parameters), ca.MX.zeros(problem.n_context)
    for function, last in _functions(problem):
        weights, tangents = stages[last], ends[last]
        steps, d = _repeat(problem, last)
        shares = _pull(problem, function, last).map(steps)(
            weights[0], *(ca.repmat(p, 1, steps) for p in (psi, c)), d, *weights[1:], *tangents
        )
        by_psi, by_c = by_psi + ca.sum2(shares[0]), by_c + ca.sum2(shares[1])
    inputs = [x, psi, c, *duals, dx, *dduals]
    return ca.Function("pull", inputs, [ca.densify(y) for y in (by_psi, by_c)])


@lru_cache(maxsize=64)
def push(problem: OCP) -> ca.Function:
    """(x, psi, c, lambda, z, nu, dpsi, dc) -> changes of grad L (n_w,), f (T n_s,), h and g_T, e and e_T."""
    x, psi, c, *duals = _symbols(problem)
    dpsi, dc = ca.MX.sym("dpsi", problem.n_parameters), ca.MX.sym("dc", problem.n_context)
    weights = _split(problem, [x, *duals])
    results: list[list[ca.MX]] = []
    for last in (False, True):
        steps, d = _repeat(problem, last)
        n = problem.n_states + (0 if last else problem.n_actions)
        rows = [part.size1() for part in weights[last][1:]]
        total = [ca.MX.zeros(size, steps) for size in (n, *rows)]
        for function, of_end in _functions(problem):
            if of_end is not last:
                continue
            found = _push(problem, function, last).map(steps)(
                weights[last][0],
                *(ca.repmat(p, 1, steps) for p in (psi, c)),
                d,
                *weights[last][1:],
                *(ca.repmat(p, 1, steps) for p in (dpsi, dc)),
            )
            total = [a + b for a, b in zip(total, found, strict=True)]
        results.append([ca.vec(part) for part in total])
    (gradient, f, h, e), (gradient_T, h_T, e_T) = results
    outputs = [ca.vertcat(gradient, gradient_T), f, ca.vertcat(h, h_T), ca.vertcat(e, e_T)]
    return ca.Function("push", [x, psi, c, *duals, dpsi, dc], [ca.densify(y) for y in outputs])


def _symbols(problem: OCP) -> list[ca.MX]:
    """x, psi, c, costates, multipliers of h and g_T, of e and e_T."""
    T, n_s, n_u = problem.horizon, problem.n_states, problem.n_actions
    sizes = {"x": T * (n_s + n_u) + n_s, "psi": problem.n_parameters, "c": problem.n_context, "lambda": T * n_s}
    sizes |= {"z": T * problem.n_path + problem.n_terminal}
    sizes |= {"nu": T * problem.n_path_equality + problem.n_terminal_equality}
    return [ca.MX.sym(name, size) for name, size in sizes.items()]


def _split(problem: OCP, parts: list[ca.MX]) -> tuple[list[ca.MX], list[ca.MX]]:
    """(x, lambda, z, nu) of all stages as columns, and (x, z, nu) of the end."""
    T, n_x = problem.horizon, problem.n_states + problem.n_actions
    rows = n_x, problem.n_states, problem.n_path, problem.n_path_equality
    stages = [ca.reshape(part[: n * T], n, T) for n, part in zip(rows, parts, strict=True)]
    ends = [part[n * T :] for n, part in zip(rows, parts, strict=True)]
    return stages, [ends[0], ends[2], ends[3]]


def _repeat(problem: OCP, last: bool) -> tuple[int, ca.DM]:
    """The number of stages, and their d."""
    return (1, problem.stages[:, -1]) if last else (problem.horizon, problem.stages[:, :-1])


def _functions(problem: OCP) -> list[tuple[str, bool]]:
    """The names of the functions that psi or the context can enter; True for those of the end."""
    stage = ("stage_cost", "dynamics", "path_constraint", "path_equality")
    end = ("terminal_cost", "terminal_inequality", "terminal_equality")
    found = []
    for names, last in ((stage, False), (end, True)):
        for name in names:
            function, first = getattr(problem, name), 1 if last else 2
            if function is not None and any(function.jac_sparsity(0, first + i).nnz() for i in range(2)):
                found.append((name, last))
    return found


def _weighted(problem: OCP, name: str, last: bool) -> tuple[type[Symbol], list[Symbol], Symbol, int]:
    """Symbols (x, psi, c, d, multipliers ..) of a stage, the value of a function, and which multiplier is its own."""
    (function,) = scalar([getattr(problem, name)])
    assert function is not None
    kind = ca.SX if function.is_a("SXFunction") else ca.MX
    n_s, n_u = problem.n_states, problem.n_actions
    rows = [problem.n_terminal, problem.n_terminal_equality]
    if not last:
        rows = [n_s, problem.n_path, problem.n_path_equality]
    x = kind.sym("x", n_s if last else n_s + n_u)
    n_d = np.asarray(problem.schedule).shape[1]
    numbers = [kind.sym(n, size) for n, size in (("psi", problem.n_parameters), ("c", problem.n_context), ("d", n_d))]
    duals = [kind.sym("multiplier", size) for size in rows]
    value = function(*([x] if last else [x[:n_s], x[n_s:]]), *numbers)
    order = ("terminal_inequality", "terminal_equality") if last else ("dynamics", "path_constraint", "path_equality")
    return kind, [x, *numbers, *duals], ca.densify(value), order.index(name) if name in order else -1


def _pull(problem: OCP, name: str, last: bool) -> ca.Function:
    """(x, psi, c, d, multipliers .., dx, dmultipliers ..) -> gradient by psi and c of its share of phi."""
    kind, inputs, value, which = _weighted(problem, name, last)
    x, psi, c, _, *duals = inputs
    changes = [kind.sym("change", part.numel()) for part in (x, *duals)]
    weighted = value if which < 0 else ca.dot(duals[which], value)
    total = ca.dot(changes[0], ca.gradient(weighted, x))
    if which >= 0:
        total += ca.dot(changes[1 + which], value)
    outputs = [ca.densify(ca.gradient(total, p)) for p in (psi, c)]
    return ca.Function("pull", [*inputs, *changes], outputs)


def _push(problem: OCP, name: str, last: bool) -> ca.Function:
    """(x, psi, c, d, multipliers .., dpsi, dc) -> changes of the gradient by x, and of every kind of row."""
    kind, inputs, value, which = _weighted(problem, name, last)
    x, psi, c, _, *duals = inputs
    moves = [kind.sym("dp", p.numel()) for p in (psi, c)]
    weighted = value if which < 0 else ca.dot(duals[which], value)

    def along(y: Symbol) -> Symbol:
        return ca.densify(sum(ca.jtimes(y, p, dp) for p, dp in zip((psi, c), moves, strict=True)))

    rows = [along(value) if i == which else kind.zeros(part.numel()) for i, part in enumerate(duals)]
    outputs = [along(ca.gradient(weighted, x)), *rows]
    return ca.Function("push", [*inputs, *moves], [ca.densify(y) for y in outputs])
