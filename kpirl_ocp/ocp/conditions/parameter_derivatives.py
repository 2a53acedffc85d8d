"""Derivatives of the KKT conditions by psi and the context: mixed second derivatives, stage by stage.

With the Lagrangian L_t = l + lambda . f + z . h + nu . e of a stage, that of the end L_T = l_T + z . g_T + nu . e_T,
and p = (psi, c),

    phi(p) = sum_t  dx_t . grad_x L_t + dlambda_t . f + dz_t . h + dnu_t . e

is the sum of the conditions, weighted by (dx, dlambda, dz, dnu). `pull` gives its gradient by p, and `push` the changes
of grad L, f, h and e along dp. Parameters enter the costs by way of their coefficients (see
`kpirl_ocp.ocp.problem.trajectory_cost`), so that weights per step take O(T) operations for all steps together. Vectors
over all stages are x = (s_0, u_0, s_1, .., s_T), costates (T n_s,), multipliers of h and g_T, and those of e and e_T.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TypeAlias

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.conditions.scalar import scalar
from kpirl_ocp.ocp.problem.columns import map_shared
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.trajectory_cost import Coefficients, TrajectoryCost, coefficients_of

Symbol: TypeAlias = "ca.SX | ca.MX"

_OF_STAGE = ("dynamics", "path_constraint", "path_equality")  # in the order of their multipliers
_OF_END = ("terminal_inequality", "terminal_equality")


@lru_cache(maxsize=64)
def pull(problem: OCP) -> ca.Function:
    """(x, psi, c, lambda, z, nu, dx, dlambda, dz, dnu) -> d phi/d psi, d phi/d c."""
    at, changes = _symbols(problem), _symbols(problem)
    x, psi, c, *duals = at
    dx, _, _, *dduals = changes
    stages, ends = (_split(problem, [x, *duals]), _split(problem, [dx, *dduals]))
    by_psi, by_c = _pull_cost(problem, x, psi, c, dx)
    for function, last in _functions(problem):
        weights, tangents = stages[last], ends[last]
        steps, d = _repeat(problem, last)
        given = [weights[0], psi, c, d, *weights[1:], *tangents]
        shares = map_shared(_pull(problem, function, last), steps, given, add=True)
        by_psi, by_c = by_psi + shares[0], by_c + shares[1]
    inputs = [x, psi, c, *duals, dx, *dduals]
    return ca.Function("pull", inputs, [ca.densify(y) for y in (by_psi, by_c)])


@lru_cache(maxsize=64)
def push(problem: OCP) -> ca.Function:
    """(x, psi, c, lambda, z, nu, dpsi, dc) -> changes of grad L (n_w,), f (T n_s,), h and g_T, e and e_T."""
    x, psi, c, *duals = _symbols(problem)
    dpsi, dc = ca.MX.sym("dpsi", problem.n_parameters), ca.MX.sym("dc", problem.n_context)
    weights = _split(problem, [x, *duals])
    results: list[list[ca.MX]] = []
    for last, change in zip((False, True), _push_cost(problem, x, psi, c, dpsi, dc), strict=True):
        steps, d = _repeat(problem, last)
        total = [change, *(ca.MX.zeros(part.shape) for part in weights[last][1:])]
        for function, of_end in _functions(problem):
            if of_end is not last:
                continue
            given = [weights[last][0], psi, c, d, *weights[last][1:], dpsi, dc]
            found = map_shared(_push(problem, function, last), steps, given)
            total = [a + b for a, b in zip(total, found, strict=True)]
        results.append([ca.vec(part) for part in total])
    (gradient, f, h, e), (gradient_T, h_T, e_T) = results
    outputs = [ca.vertcat(gradient, gradient_T), f, ca.vertcat(h, h_T), ca.vertcat(e, e_T)]
    return ca.Function("push", [x, psi, c, *duals, dpsi, dc], [ca.densify(y) for y in outputs])


def _pull_cost(problem: OCP, x: ca.MX, psi: ca.MX, c: ca.MX, dx: ca.MX) -> tuple[ca.MX, ca.MX]:
    """The gradient by psi and c of the costs' share of phi."""
    cost, coefficients = TrajectoryCost(problem, 1), coefficients_of(problem)
    *_, by_theta = cost.second(*_plan(problem, x), cost.coefficients(psi, c), *_plan(problem, dx))
    return coefficients.reverse(1)(psi, c, *coefficients(psi, c), ca.vec(by_theta.stages), by_theta.last)


def _push_cost(problem: OCP, x: ca.MX, psi: ca.MX, c: ca.MX, dpsi: ca.MX, dc: ca.MX) -> tuple[ca.MX, ca.MX]:
    """Changes of the costs' gradients by x_t (n_x, T) and by s_T (n_s, 1)."""
    cost, coefficients = TrajectoryCost(problem, 1), coefficients_of(problem)
    theta = cost.coefficients(psi, c)
    stages, last = coefficients.forward(1)(psi, c, *coefficients(psi, c), dpsi, dc)
    dtheta = Coefficients(ca.reshape(stages, theta.stages.shape), last)
    by_states, by_actions = cost.first_along(*_plan(problem, x), theta, dtheta)
    return ca.vertcat(by_states[:, :-1], by_actions), by_states[:, -1]


def _plan(problem: OCP, x: ca.MX) -> tuple[ca.MX, ca.MX]:
    """S (n_s, T+1) and U (n_u, T)."""
    n_s, n_x = problem.n_states, problem.n_states + problem.n_actions
    stages = ca.reshape(x[:-n_s], n_x, problem.horizon)
    return ca.horzcat(stages[:n_s, :], x[-n_s:]), stages[n_s:, :]


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
    """Names of the functions other than costs that depend on psi or the context; True for those of the end."""
    found = []
    for names, last in ((_OF_STAGE, False), (_OF_END, True)):
        for name in names:
            function, first = getattr(problem, name), 1 if last else 2
            if function is not None and any(function.jac_sparsity(0, first + i).nnz() for i in range(2)):
                found.append((name, last))
    return found


def _weighted(problem: OCP, name: str, last: bool) -> tuple[type[Symbol], list[Symbol], Symbol, int]:
    """Symbols (x, psi, c, d, multipliers ..) of a stage, the value of a function, and the index of its multiplier."""
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
    return kind, [x, *numbers, *duals], ca.densify(value), (_OF_END if last else _OF_STAGE).index(name)


def _pull(problem: OCP, name: str, last: bool) -> ca.Function:
    """(x, psi, c, d, multipliers .., dx, dmultipliers ..) -> gradient by psi and c of its share of phi."""
    kind, inputs, value, which = _weighted(problem, name, last)
    x, psi, c, _, *duals = inputs
    changes = [kind.sym("change", part.numel()) for part in (x, *duals)]
    total = ca.dot(changes[0], ca.gradient(ca.dot(duals[which], value), x)) + ca.dot(changes[1 + which], value)
    outputs = [ca.densify(ca.gradient(total, p)) for p in (psi, c)]
    return ca.Function("pull", [*inputs, *changes], outputs)


def _push(problem: OCP, name: str, last: bool) -> ca.Function:
    """(x, psi, c, d, multipliers .., dpsi, dc) -> changes of the gradient by x, and of every kind of row."""
    kind, inputs, value, which = _weighted(problem, name, last)
    x, psi, c, _, *duals = inputs
    moves = [kind.sym("dp", p.numel()) for p in (psi, c)]

    def along(y: Symbol) -> Symbol:
        return ca.densify(sum(ca.jtimes(y, p, dp) for p, dp in zip((psi, c), moves, strict=True)))

    rows = [along(value) if i == which else kind.zeros(part.numel()) for i, part in enumerate(duals)]
    outputs = [along(ca.gradient(ca.dot(duals[which], value), x)), *rows]
    return ca.Function("push", [*inputs, *moves], [ca.densify(y) for y in outputs])
