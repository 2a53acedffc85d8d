"""The unrolled gradient as one CasADi function: N gradient steps forward, then back with one Hessian product each.

    forward   U_{k+1} = P(U_k - alpha dJ/dU(U_k; theta)),          theta = coefficients(psi, c)
    back      w = P' v_{k+1},  v_k = w - alpha H_k w,              v_N = dL/dU
              dL/dtheta = -alpha sum_k d(w . dJ/dU)/dtheta,        and dL/dpsi = (dtheta/dpsi)^T dL/dtheta once

The steps are taken in segments. A segment keeps a record of every step for the way back, or, with checkpoints, is taken
again from its first iterate, so that memory grows like sqrt(N).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import casadi as ca
import numpy as np

from kpirl_ocp.irl.hypergradients.allowed_move import allowed_move
from kpirl_ocp.irl.hypergradients.loss import Loss
from kpirl_ocp.ocp.problem.columns import (
    by_trajectory,
    regroup,
    repeat,
    reverse,
    smallest,
    smallest_block,
    smallest_by_column,
    sum_blocks,
    symbols_like,
)
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.reduced_cost import Linearisation, ReducedCost, reduced_symbols
from kpirl_ocp.ocp.problem.scope import constant_bounds
from kpirl_ocp.ocp.problem.trajectory_cost import Coefficients
from kpirl_ocp.ocp.problem.trajectory_passes import Rollout
from kpirl_ocp.ocp.solvers.gradient_descent import (
    GradientDescent,
    extremes,
    gradient_step,
    projection_slope,
    terminal_point,
)

_SINGLE = 32  # up to this many steps are written out one by one


def unrolled_function(
    problem: OCP, solver: GradientDescent, loss: Loss, last: int, checkpoint: bool, columns: int
) -> ca.Function:
    """(U_0, s0, psi, c, Z) -> loss, remainder, kink distance, clearance, cost of U_0, gradient, `terminal_point`.

    The outputs are stacked in one column. For B demonstrations all arguments and the output have B columns, except
    U_0 (n_u, B T) and Z (n_z, B (T+1)), which hold one demonstration after the other. Clearance is `allowed_move`.
    """
    reduced, (u, s0, psi, context) = ReducedCost(problem, columns), reduced_symbols(problem, columns)
    observed = ca.MX.sym("Z", loss(problem).size1_in(2), columns * (problem.horizon + 1))
    theta = reduced.cost.coefficients(psi, context)
    constants, step = (s0, psi, *theta), gradient_step(problem, solver, columns)
    back = _step_back(problem, solver, step, columns)

    skipped, taken = _segments(solver.steps - last), _segments(last)
    wide = {length: repeat(constants, length) for length in {*skipped, *taken}}
    steps = {length: _segment(step, length) if length > 1 else step for length in wide}
    sweeps = {length: _segment_back(back, length) if length > 1 else back for length in set(taken)}

    iterate, walk = regroup(u, problem.horizon), []
    for length in skipped + taken:
        start = iterate
        iterate, values, found, record = _take(steps[length], start, wide[length])
        walk.append((length, start, values, found, record))
    kinks = [_kink_distance(problem, solver, record[1], columns) for *_, record in walk]

    at = reduced.linearise(s0, iterate, psi, theta)
    value, slope, gradient = _loss_and_gradients(loss, reduced, at, psi, observed)
    adjoint = slope
    by_theta: list[list[ca.MX]] = []
    for length, start, *_, record in reversed(walk[len(skipped) :]):
        if checkpoint:
            *_, record = _take(steps[length], start, wide[length])
        adjoint, by_psi, *share = sweeps[length](adjoint, *record, *wide[length][1:])
        gradient, by_theta = gradient + by_psi, [*by_theta, share]
    totals = (sum(shares[1:], shares[0]) for shares in zip(*by_theta, strict=True))
    gradient = gradient + _pull_back(reduced)(psi, context, *totals)

    remainder = _norms(adjoint, columns) / ca.fmax(_norms(slope, columns), np.finfo(float).tiny)
    kink = kinks[0]
    for other in kinks[1:]:
        kink = ca.fmin(kink, other)
    least = smallest(extremes(at), *(found for _, _, _, found, _ in walk))
    clear = allowed_move(reduced, solver, at, psi, theta, least)
    initial = walk[0][2][:, :columns]
    point = terminal_point(at, columns)
    output = ca.vertcat(value, remainder, kink, clear, initial, gradient, point)
    return ca.Function("unrolled", [u, s0, psi, context, observed], [ca.densify(output)])


def _segments(steps: int) -> list[int]:
    """Lengths of segments that add up to `steps`: ones if there are few steps, else about the root of their number."""
    length = 1 if steps <= _SINGLE else math.isqrt(steps)
    return [length] * (steps // length) + ([steps % length] if steps % length else [])


def _segment(step: ca.Function, length: int) -> ca.Function:
    """Several steps as one function, which keeps the extremes of all of them, and not those of each."""
    u, *wide = symbols_like("x", (step.mx_in(0), *repeat(step.mx_in()[1:], length)))
    iterates, values, found, *record = step.mapaccum(length).call([u, *wide])
    return ca.Function(
        "segment", [u, *wide], [iterates, values, smallest_block(found, values.size2() // length), *record]
    )


def _take(steps: ca.Function, u: ca.MX, constants: Sequence[ca.MX]) -> tuple[ca.MX, ca.MX, ca.MX, list[ca.MX]]:
    """U after a segment, costs and extremes within it, and for every step the record that the reverse pass needs.

    constants: s0, psi and theta, side by side for every step.
    """
    iterates, values, found, *record = steps.call([u, *constants])
    width = u.size2()
    before = ca.horzcat(u, iterates[:, :-width]) if iterates.size2() > width else u
    return iterates[:, -width:], values, found, [before, *record]


def _step_back(problem: OCP, solver: GradientDescent, step: ca.Function, columns: int) -> ca.Function:
    """(v, record of a step, psi, theta) -> (dPhi/dU)^T v, (dPhi/dpsi)^T v, (dPhi/dtheta)^T v: one Hessian product."""
    u, s0, psi, *theta = step.mx_in()
    reduced, coefficients = ReducedCost(problem, columns), Coefficients(*theta)
    remembered = len(reduced.passes.rollout(s0, u, psi).memory)
    free, states, *record = symbols_like("record", step.mx_out()[3:])
    at = Rollout(states, u, tuple(record[:remembered]))
    v = ca.MX.sym("v", *u.shape)
    moved = projection_slope(problem, solver, free) * v
    product = reduced.hessian_product(at, tuple(record[remembered:]), psi, coefficients, moved)
    shares = (-solver.step_size * x for x in (product.by_parameters, *product.by_coefficients))
    outputs = [moved - solver.step_size * product.by_actions, *shares]
    return ca.Function("step_back", [v, u, free, states, *record, psi, *theta], outputs)


def _segment_back(back: ca.Function, length: int) -> ca.Function:
    """`back` for a segment: records and constants side by side -> v before it, and the sums of the other outputs.

    It is a function of its own, so that the summands of a segment are not stored beyond it.
    """
    v, *wide = symbols_like("x", (back.mx_in(0), *repeat(back.mx_in()[1:], length)))
    pieces = [reverse(array, array.size2() // length) for array in wide]
    adjoints, *shares = back.mapaccum(length)(v, *pieces)
    sums = [sum_blocks(share, share.size2() // length) for share in shares]
    return ca.Function("segment_back", [v, *wide], [adjoints[:, -v.size2() :], *sums])


def _pull_back(reduced: ReducedCost) -> ca.Function:
    """(psi, c, x) -> (dtheta/dpsi)^T x."""
    _, _, psi, context = reduced_symbols(reduced.problem, reduced.columns)
    theta = reduced.cost.coefficients(psi, context)
    x = symbols_like("x", theta)
    paired = ca.dot(theta.stages, x[0]) + ca.dot(theta.last, x[1])
    return ca.Function("pull_back", [psi, context, *x], [ca.gradient(paired, psi)])


def _loss_and_gradients(
    loss: Loss, reduced: ReducedCost, at: Linearisation, psi: ca.MX, observed: ca.MX
) -> tuple[ca.MX, ca.MX, ca.MX]:
    """L (1, B), dL/dU and, through the dynamics, dL/dpsi."""
    columns, function = reduced.columns, loss(reduced.problem)
    states, actions, seen = (ca.MX.sym("x", *function.size_in(i)) for i in range(3))
    value = function(states, actions, seen)
    outputs = [value, ca.gradient(value, states), ca.gradient(value, actions)]
    slopes = ca.Function("slopes", [states, actions, seen], outputs).map(columns)
    value, by_states, by_actions = slopes(
        regroup(at.rollout.states, columns), regroup(at.rollout.actions, columns), observed
    )
    horizon = reduced.problem.horizon
    adjoint = reduced.passes.adjoint(at.rollout, psi, regroup(by_states, horizon + 1))
    return value, regroup(by_actions, horizon) + adjoint.by_actions, adjoint.by_parameters


def _kink_distance(problem: OCP, solver: GradientDescent, free: ca.MX, columns: int) -> ca.MX:
    """Smallest distances (1, B) of unprojected iterates to an action bound."""
    bounds = constant_bounds(problem)[2:]
    finite = [(bound, np.flatnonzero(np.isfinite(bound))) for bound in bounds]
    distances = [
        by_trajectory(ca.fabs(free[rows.tolist(), :] - ca.repmat(ca.DM(bound[rows]), 1, free.size2())), columns)
        for bound, rows in finite
        if solver.project and len(rows)
    ]
    if not distances:
        return ca.MX(ca.DM.inf(1, columns))
    return smallest_by_column(ca.vertcat(*distances))


def _norms(array: ca.MX, columns: int) -> ca.MX:
    """The norm of each trajectory's share (1, B)."""
    return ca.horzcat(*(ca.norm_2(column) for column in ca.horzsplit(by_trajectory(array, columns))))
