"""The functions by which the core sees a problem whose dynamics bring derivatives arranged by hand: all stages at once.

With the Lagrangians L_t and L_T of `kpirl_ocp.ocp.interior_point.stage_functions`, side by side for all stages,

    horizon (S, U, psi, c, Lambda, Z, N, z_T, nu_T)
        -> J, f, h, e, g_T, e_T | grad J by x_t, by s_T, grad L_t, grad L_T | F, G', E', H, G_T', E_T', H_T

and `dynamics` (x, psi, c, d) -> f of one stage, for rollouts. Layers of a network become products of matrices this way.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, partial

import casadi as ca

from kpirl_ocp.ocp.conditions.stage_derivatives import psi_by_stage
from kpirl_ocp.ocp.interior_point.library import HORIZON
from kpirl_ocp.ocp.interior_point.stage_functions import Levels, constraint_functions, last_functions
from kpirl_ocp.ocp.problem.columns import in_blocks, map_shared
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.trajectory_cost import TrajectoryCost, stage_costs

_INPUTS, _OUTPUTS = HORIZON


@dataclass(frozen=True, eq=False)
class HorizonFunctions:
    """Values, first and second derivatives of the whole horizon; and the dynamics of one stage."""

    horizon: Levels
    dynamics: ca.Function


@lru_cache(maxsize=64)
def horizon_functions(problem: OCP) -> HorizonFunctions:
    """Of a problem with `OCP.derivatives`."""
    x, psi = ca.MX.sym("x", problem.n_states + problem.n_actions), ca.MX.sym("psi", problem.n_parameters)
    others = [ca.MX.sym(name, problem.stage_cost.size1_in(i)) for i, name in ((3, "c"), (4, "d"))]
    successor = problem.transition(x[: problem.n_states], x[problem.n_states :], psi)
    names = ["x", "psi", "context", "schedule"]
    dynamics = ca.Function("dynamics", [x, psi, *others], [successor], names, ["successor"])
    return HorizonFunctions(_levels(problem), dynamics)


def _levels(problem: OCP) -> Levels:
    """Expressions that levels have in common are written once."""
    point, dual = _symbols(problem)
    (states, actions, psi, context), costates = point, dual[0]
    cost = TrajectoryCost(problem, 1)
    theta = cost.coefficients(psi, context)
    at = [states[:, :-1], actions, psi_by_stage(problem, psi), costates]
    successors, Ft_lambda = in_blocks(partial(_stages_first, problem), at)
    rows = [_rows(problem, function, point, dual) for function in constraint_functions(problem)]
    ends = [_ends(problem, function, point, dual) for function in last_functions(problem)]
    total, by_states, by_actions = cost.first(states, actions, theta)
    stepped = map_shared(problem.transition, problem.horizon, [states[:, :-1], actions, psi])
    values = [total, *stepped, *rows[0][1:3], *ends[0][1:3]]
    slope, last_slope = ca.vertcat(by_states[:, :-1], by_actions), by_states[:, -1]
    slopes = [slope, last_slope, slope + Ft_lambda + rows[1][4], ends[1][4]]
    first = [total, successors, *rows[1][1:3], *ends[1][1:3], *slopes]
    second = _second(problem, [*at, theta.stages], rows[2], ends[2])
    return (
        _function("horizon_values", point, values),
        _function("horizon_first", [*point, *dual], first),
        _function("horizon_second", [*point, *dual], second),
    )


def _symbols(problem: OCP) -> tuple[list[ca.MX], list[ca.MX]]:
    """S, U, psi, c; and Lambda, Z, N, z_T, nu_T."""
    steps = problem.horizon
    shapes = {"Lambda": (problem.n_states, steps), "Z": (problem.n_path, steps), "N": (problem.n_path_equality, steps)}
    shapes |= {"z_T": (problem.n_terminal, 1), "nu_T": (problem.n_terminal_equality, 1)}
    return problem.symbols(), [ca.MX.sym(name, *shape) for name, shape in shapes.items()]


def _function(name: str, inputs: list[ca.MX], outputs: list[ca.MX]) -> ca.Function:
    dense = [ca.densify(output) for output in outputs]
    return ca.Function(name, inputs, dense, [*_INPUTS[: len(inputs)]], [*_OUTPUTS[: len(outputs)]])


def _second(problem: OCP, at: list[ca.MX], rows: list[ca.MX], ends: list[ca.MX]) -> list[ca.MX]:
    """The results with second derivatives."""
    value, slope, successors, Ft_lambda, F, H = in_blocks(partial(_stages_second, problem), at)
    if problem.n_path + problem.n_path_equality:
        H = H + rows[7]
    values = [ca.sum2(value) + ends[0], successors, *rows[1:3], *ends[1:3]]
    slopes = [slope, ends[3], slope + Ft_lambda + rows[4], ends[4]]
    return [*values, *slopes, F, *rows[5:7], H, *ends[5:]]


def _stages_first(problem: OCP, *at: ca.MX) -> list[ca.MX]:
    """(S, U, psi, Lambda) -> f and F' lambda, of some stages."""
    dynamics = problem.dynamics_derivatives.linearise(*at)
    return [dynamics.value, dynamics.Ft_lambda]


def _stages_second(problem: OCP, *at: ca.MX) -> list[ca.MX]:
    """(S, U, psi, Lambda, Theta) -> the results of `_stage_second`, of some stages."""
    states, actions, psi, costates, theta = at
    stage, prepared = problem.dynamics_derivatives.linearise(states, actions, psi, costates).second()
    mapped = _stage_second(problem, stage).map(states.size2())
    return list(mapped(states, actions, theta, costates, *prepared))


def _stage_second(problem: OCP, dynamics: ca.Function) -> ca.Function:
    """(s, u, theta, lambda, arguments of dynamics) -> l, its gradient, f, F' lambda, F, H; of one stage."""
    running, _ = stage_costs(problem)
    s, u = ca.MX.sym("s", problem.n_states), ca.MX.sym("u", problem.n_actions)
    theta, costate = ca.MX.sym("theta", running.hessian.size1_in(2)), ca.MX.sym("lambda", problem.n_states)
    prepared = [ca.MX.sym("prepared", dynamics.size1_in(i)) for i in range(dynamics.n_in())]
    value, slope, curvature = running.hessian(s, u, theta)
    successor, F, H = dynamics.call(prepared, True, False)
    F = ca.densify(F)
    outputs = [value, slope, successor, (costate.T @ F).T, F, _plus_sparse(H, curvature)]
    return _function("stage_second", [s, u, theta, costate, *prepared], outputs)


def _plus_sparse(dense: ca.MX, sparse: ca.MX) -> ca.MX:
    """The sum as a dense matrix; only entries that are there are touched."""
    total = ca.MX(ca.densify(dense))
    rows, columns = sparse.sparsity().get_triplet()
    where = [row + column * sparse.size1() for row, column in zip(rows, columns, strict=True)]
    if where:
        total.nz[where] = total.nz[where] + sparse.nz[:]
    return total


def _rows(problem: OCP, function: ca.Function, point: list[ca.MX], dual: list[ca.MX]) -> list[ca.MX]:
    """The results of one of `constraint_functions` at all stages, dense; cost and gradient in them are zero."""
    states, actions, psi, context = point
    x = ca.vertcat(states[:, :-1], actions)
    given = [x, psi, context, problem.stages[:, :-1], *dual[1:3]]
    return map_shared(function, problem.horizon, given[: function.n_in()])


def _ends(problem: OCP, function: ca.Function, point: list[ca.MX], dual: list[ca.MX]) -> list[ca.MX]:
    """The results of one of `last_functions`."""
    states, _, psi, context = point
    given = [states[:, -1], psi, context, problem.stages[:, -1], *dual[3:]]
    return list(function.call(given[: function.n_in()]))
