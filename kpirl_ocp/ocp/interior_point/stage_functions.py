"""The functions by which the core in C sees a problem: values, first and second derivatives of a stage.

With the Lagrangian of one stage, L = l + lambda . f + z . h + nu . e, and of the end, L_T = l_T + z . g_T + nu . e_T,

    stage  (x, psi, c, d, lambda, z, nu) -> l, f, h, e  | grad l, grad L      | F, G', E', lower triangle of H
    last   (s, psi, c, d, z, nu)         -> l_T, g_T, e_T | grad l_T, grad L_T  | G_T', E_T', lower triangle of H_T

x = (s, u), H is the second derivative of L by x, and F, G and E are the Jacobians of f, h and e. Each function has the
results of its level and of those before. Jacobians and Hessians are sparse. Inputs and outputs bear the names of the
pointers in `c/kpirl_mpc_model.h`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate, chain

import casadi as ca

from kpirl_ocp.ocp.conditions.scalar import scalar
from kpirl_ocp.ocp.interior_point.library import STAGE
from kpirl_ocp.ocp.problem.ocp import OCP

Levels = tuple[ca.Function, ca.Function, ca.Function]
"""A function of values, one of first and one of second derivatives."""

_INPUTS, _NAMES = STAGE
_OUTPUTS = _NAMES[:4], _NAMES[4:6], _NAMES[6:]  # values, first and second derivatives
_OF_DYNAMICS = ("costates", "successor", "F")  # which the end does not have
_SHARED = 3_000  # operations to look for common subexpressions among, at most: it takes longer than a solve


@dataclass(frozen=True, eq=False)
class StageFunctions:
    """Values, first and second derivatives (three functions each) of a stage and of the end."""

    stage: Levels
    last: Levels

    @property
    def all(self) -> list[ca.Function]:
        """The six functions."""
        return [*self.stage, *self.last]


@lru_cache(maxsize=64)
def stage_functions(problem: OCP) -> StageFunctions:
    """Of a problem, by AD; in scalar operations where the problem can be written out in them."""
    parts = [problem.dynamics, problem.stage_cost, problem.path_constraint, problem.path_equality]
    return StageFunctions(_stage(problem, *scalar(parts)), last_functions(problem))


def last_functions(problem: OCP) -> Levels:
    """Those of the end."""
    return _last(problem, *scalar([problem.terminal_cost, problem.terminal_inequality, problem.terminal_equality]))


def constraint_functions(problem: OCP) -> Levels:
    """Those of a stage's constraints alone, as of an end with s and u: (x, psi, c, d, z, nu) -> 0, h, e | .. ."""
    return _without_dynamics(problem, None)


def local_functions(problem: OCP) -> Levels:
    """Those of a stage without its dynamics, as of an end with s and u: (x, psi, c, d, z, nu) -> l, h, e | .. ."""
    return _without_dynamics(problem, problem.stage_cost)


def _without_dynamics(problem: OCP, cost: ca.Function | None) -> Levels:
    cost, path, equality = scalar([cost, problem.path_constraint, problem.path_equality])
    kind = _kind([cost, path, equality])
    n_s = problem.n_states
    x, numbers = kind.sym("x", n_s + problem.n_actions), _numbers(kind, problem)
    point = [x[:n_s], x[n_s:], *numbers]
    rows = [kind(0, 1) if g is None else ca.densify(g(*point)) for g in (path, equality)]
    value = kind.zeros(1) if cost is None else ca.densify(cost(*point))
    return _levels(kind, "rows", x, numbers, [value, *rows], constraints=2)


def _kind(functions: list[ca.Function | None]) -> type[ca.SX] | type[ca.MX]:
    return ca.SX if all(f is None or f.is_a("SXFunction") for f in functions) else ca.MX


def _stage(
    problem: OCP, f: ca.Function, cost: ca.Function, path: ca.Function | None, equality: ca.Function | None
) -> Levels:
    kind = _kind([f, cost, path, equality])
    n_s, n_u = problem.n_states, problem.n_actions
    x, numbers = kind.sym("x", n_s + n_u), _numbers(kind, problem)
    point = [x[:n_s], x[n_s:], *numbers]
    rows = [kind(0, 1) if g is None else ca.densify(g(*point)) for g in (path, equality)]
    values = [ca.densify(cost(*point)), ca.densify(f(*point)), *rows]
    return _levels(kind, "stage", x, numbers, values, constraints=3)


def _last(problem: OCP, cost: ca.Function, path: ca.Function | None, equality: ca.Function | None) -> Levels:
    kind = _kind([cost, path, equality])
    s, numbers = kind.sym("s", problem.n_states), _numbers(kind, problem)
    rows = [kind(0, 1) if g is None else ca.densify(g(s, *numbers)) for g in (path, equality)]
    return _levels(kind, "last", s, numbers, [ca.densify(cost(s, *numbers)), *rows], constraints=2)


def _levels(
    kind: type[ca.SX] | type[ca.MX],
    name: str,
    x: ca.SX | ca.MX,
    numbers: list[ca.SX | ca.MX],
    values: list[ca.SX | ca.MX],
    constraints: int,
) -> Levels:
    """The three functions of a cost and the constraints that follow it in `values`."""
    multipliers = [kind.sym("multiplier", value.numel()) for value in values[1:]]
    if kind is ca.SX:
        values = _shared(values)
    lagrangian = values[0] + sum(ca.dot(one, value) for one, value in zip(multipliers, values[1:], strict=True))
    slopes = [ca.densify(ca.gradient(value, x)) for value in (values[0], lagrangian)]
    *jacobians, hessian = _jacobians([*values[1:], slopes[1]], x)
    matrices = [*jacobians[:-2], *(jacobian.T for jacobian in jacobians[-2:]), ca.tril(hessian)]
    results = [*values, *slopes, *matrices]
    if kind is ca.MX:
        results = _shared(results)
    names = [[one for one in row if constraints == 3 or one not in _OF_DYNAMICS] for row in (_INPUTS, *_OUTPUTS)]
    inputs, ends = [x, *numbers, *multipliers], list(accumulate(map(len, names[1:])))
    functions = []
    for level, n_in, n_out in zip(("values", "first", "second"), (4, len(inputs), len(inputs)), ends, strict=True):
        of_level = names[0][:n_in], [*chain.from_iterable(names[1:])][:n_out]
        functions.append(ca.Function(f"{name}_{level}", inputs[:n_in], results[:n_out], *of_level))
    return functions[0], functions[1], functions[2]


def _shared(expressions: list[ca.SX | ca.MX]) -> list[ca.SX | ca.MX]:
    """With common subexpressions found, unless there are too many operations: before scalars are differentiated, since
    derivatives repeat what is repeated; of graphs of matrices after that.
    """
    return expressions if ca.n_nodes(ca.veccat(*expressions)) > _SHARED else ca.cse(expressions)


def _jacobians(columns: list[ca.SX | ca.MX], x: ca.SX | ca.MX) -> list[ca.SX | ca.MX]:
    """Those of constraints and of a gradient, which scalars have in one sweep: both need the tangents of f."""
    if isinstance(x, ca.MX):
        *constraints, gradient = columns
        return [*(ca.jacobian(value, x) for value in constraints), ca.jacobian(gradient, x, {"symmetric": True})]
    ends = [0, *accumulate(column.numel() for column in columns)]
    return list(ca.vertsplit(ca.jacobian(ca.vertcat(*columns), x), ends))


def _numbers(kind: type[ca.SX] | type[ca.MX], problem: OCP) -> list[ca.SX | ca.MX]:
    """psi, c and d."""
    return [kind.sym(name, problem.stage_cost.size1_in(i)) for i, name in ((2, "psi"), (3, "c"), (4, "d"))]
