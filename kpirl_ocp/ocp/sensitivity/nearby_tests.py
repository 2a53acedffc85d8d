"""Tests of the derivatives at a computed solution, by evaluations nearby.

A solution is only known to the solver's tolerance, so the active set was guessed, and second derivatives were taken
beside the true solution. One Newton step on the KKT conditions leads (quadratically) closer to it:

* distance: the step itself must be small;
* signs: every multiplier of an active row and every slack of an inactive one must be positive after it;
* stability: the adjoint, solved again after it, must be the same. The step is lengthened by 1e-9 along the softest
  direction, because no solution is known better than that: at a fold or a flat minimum the adjoint then explodes;
* smoothness in the unknowns: the gradient of the Lagrangian and the constraints, differenced along the adjoint to
  either side, must agree with their derivatives. At a kink (ReLU, max, norm) they do not;
* smoothness in psi, s_0 and the context: what the adjoint makes of the conditions, differenced to either side, must
  agree with the gradient, and the gradient must not jump.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import StageValues
from kpirl_ocp.ocp.sensitivity.factorisation import Factorisation
from kpirl_ocp.ocp.sensitivity.implicit_function import ByParameters, WeightedConditions
from kpirl_ocp.ocp.sensitivity.kkt_system import Instance, KKTSystem, PrimalDual, sizes_of
from kpirl_ocp.ocp.sensitivity.rows import rows_of
from kpirl_ocp.types import Array

_KNOWN = 1e-9  # relative accuracy to which no solution is known better
_DIFFERENCE = 1e-6  # step of a difference quotient, relative: truncation about 1e-12, rounding about 1e-10
_CLOSER = 0.1  # of two steps the shorter one; jumps do not shrink with it
_ROUNDING = 1e-12  # of the conditions, relative, with a margin by which kinks are told from it
_SMALL = 1e-3  # share of the largest parameter that the others move by at least
_FLOOR = 1e-9  # share of the whole gradient below which one of its entries may be rounding


class Nearby(NamedTuple):
    """The neighbourhood that a Newton step leads to.

    point: after the step, moved a little further along the softest direction.
    step: length of the step in the decisions, relative to their sizes; the error of the solution.
    margin: smallest multiplier of an active and slack of an inactive row after the step, relative, negative if the
        active set was wrong; infinite without inequalities, or when they are smoothed.
    """

    point: PrimalDual
    step: float
    margin: float


def newton_step(system: KKTSystem, factors: Factorisation) -> Nearby:
    """One Newton step on the KKT conditions with this active set."""
    point, move, linear = system.point, factors.newton_step(), system.linear
    forces, slack = system.pushing + move.forces, system.slack - linear.times(move.x)
    margins = system.margins(forces, slack)
    margin = np.inf
    if not system.instance.barrier > 0:
        margin = float(np.min(margins[system.instance.rows.inequality], initial=np.inf))
    size = linear.decision_norm(system.sizes) or 1.0
    x = point.x + move.x + _KNOWN * size * factors.softest
    kept = np.where(system.active | system.instance.rows.inequality, forces, point.forces)
    return Nearby(PrimalDual(x, point.costates + move.costates, kept), linear.decision_norm(move.x) / size, margin)


def kink_along(system: KKTSystem, direction: Array, enough: float) -> float:
    """Relative disagreement of the conditions, differenced to either side along x (n_w,), with their derivative.

    A second, shorter step is taken where the first one disagrees by more than `enough`: a kink does not shrink with it.
    """
    size = np.abs(direction / system.sizes).max(initial=0.0)
    if size == 0:
        return 0.0
    error = np.inf
    for length in (_DIFFERENCE, _CLOSER * _DIFFERENCE):
        error = min(error, _kink(system, length / size * direction))
        if error <= enough:
            break
    return error


def _kink(system: KKTSystem, move: Array) -> float:
    instance, nothing = system.instance, PrimalDual(move, *(np.zeros(n) for n in system.linear.duals))
    left, here, right = (_conditions(system, instance.values(system.point.plus(nothing, k))) for k in (-1.0, 0.0, 1.0))
    length = np.abs(move / system.sizes).max()
    errors = [0.0]
    for i, (before, at, after, slope) in enumerate(
        zip(left, here, right, _derivatives_along(system, move), strict=True)
    ):
        sides = after - at, at - before
        whole = (
            length
            if i
            else max(_length(part) for part in (*sides, slope, _FLOOR * system.curvature * move * system.sizes))
        )
        off = max(_length(side - slope) for side in sides)
        errors.append(off / whole if whole > 0 else off)
    return _worst(*errors)


def _length(vector: Array) -> float:
    return float(np.linalg.norm(vector))


def _conditions(system: KKTSystem, at: StageValues) -> list[Array]:
    """Gradient, defects and rows but bounds, in units that compare."""
    rows = np.concatenate([at.path, at.equality])
    return [at.gradient * system.sizes, at.defects / system.successor_sizes, rows / system.constraint_sizes]


def _derivatives_along(system: KKTSystem, move: Array) -> list[Array]:
    """Their changes along x by first and second derivatives."""
    linear, rows = system.linear, system.instance.rows
    zeros = [np.zeros(n) for n in linear.duals]
    values = linear.times(move)
    gradient = linear.balance([move, *zeros]) - linear.transposed_times(system.stiffness * values)
    return [
        gradient * system.sizes,
        system.defects_along(move) / system.successor_sizes,
        values[rows.n_bounds :] / system.constraint_sizes,
    ]


def kink_in_parameters(weighted: WeightedConditions, by: ByParameters) -> float:
    """The same along psi, s_0 and the context, and the relative jump of derivatives by them.

    by: the derivatives of the weighted conditions.
    """
    instance = weighted.instance
    moves = ByParameters(*(_steps(p) for p in (instance.psi, instance.s0, instance.context)))
    return _kink_in_parameters(weighted, by, moves)


def parameter_jump(problem: OCP, x: Array, psi: Array, context: Array) -> float:
    """The same along psi for random weights, at a plan x (n_w,) that need not be a solution."""
    n_s, rows = problem.n_states, rows_of(problem)
    numbers = len(x), problem.horizon * n_s, len(rows.equality)
    instance, sizes = Instance(problem, x[:n_s], psi, context), sizes_of(rows, x)
    one, costates, forces = (_spread(n) for n in numbers)
    weighted = WeightedConditions(
        instance, PrimalDual(x, costates, forces), PrimalDual(one * sizes, one[: len(costates)], forces)
    )
    moves = ByParameters(_steps(psi), np.zeros(n_s), np.zeros(len(context)))
    return _kink_in_parameters(weighted, weighted.gradients(np.zeros(n_s)), moves)


def _kink_in_parameters(weighted: WeightedConditions, by: ByParameters, moves: ByParameters) -> float:
    expected = sum(float(part @ move) for part, move in zip(by, moves, strict=True))
    total = sum(float(np.abs(part) @ np.abs(move)) for part, move in zip(by, moves, strict=True))
    left, here, right = (weighted.conditions(moves, k * _DIFFERENCE) for k in (-1.0, 0.0, 1.0))
    weights = weighted.flat
    slopes = [float(weights @ (one - other)) / _DIFFERENCE for one, other in ((right, here), (here, left))]
    noise = _ROUNDING * float(np.abs(weights) @ np.abs(here)) / _DIFFERENCE
    whole = max(total, *map(abs, slopes), noise)
    quotient = max(abs(slope - expected) for slope in slopes) / whole if whole > 0 else 0.0
    instance = weighted.instance

    def gradients(k: float) -> Array:
        at = weighted.gradients_at(instance.psi + k * moves.psi, instance.context + k * moves.context)
        return np.concatenate(at) * np.concatenate([moves.psi, moves.context])

    return _worst(quotient, jump(gradients, whole))


def jump(gradients: Callable[[float], Array], whole: float = 0.0) -> float:
    """The largest relative jump of entries of a function of a step at 0, from its values at four steps beside it.

    Differences of a smooth function shrink with the step, so that what is left of them at step 0 is a jump.
    whole: entries much smaller than it may be rounding.
    """
    far, near = ([gradients(sign * step) for sign in (1, -1)] for step in (_DIFFERENCE, _CLOSER * _DIFFERENCE))
    if not far[0].size:
        return 0.0
    left_over = np.abs(near[0] - near[1] - _CLOSER * (far[0] - far[1])) / (1 - _CLOSER)
    sizes = np.maximum(np.abs([*far, *near, gradients(0.0)]).max(axis=0), _FLOOR * whole)
    return _worst(*(left_over / np.where(sizes > 0, sizes, 1.0)))


def _steps(numbers: Array) -> Array:
    """A random direction, in units of the numbers."""
    size = np.abs(numbers).max(initial=0.0)
    sizes = np.maximum(np.abs(numbers), _SMALL * size) if size > 0 else np.ones(len(numbers))
    return sizes * _spread(len(numbers))


@lru_cache(maxsize=64)
def _spread(size: int) -> Array:
    """Random numbers, none of them close to zero."""
    return np.random.default_rng(0).uniform(0.5, 1.0, size)


def _worst(*errors: float) -> float:
    """The largest; infinite if one is NaN."""
    return float(np.max(errors)) if np.isfinite(errors).all() else np.inf


def kink_of_loss(evaluate: Callable[[Array], Array], point: Array, sizes: Array) -> float:
    """Relative jump of the slopes of a loss of x (n_w,), and disagreement of its differences with them.

    evaluate: x -> (loss, slopes (n_w,)). sizes: (n_w,) of the entries of x; zero for those that stay.
    """
    move = sizes * np.random.default_rng(0).choice([-1.0, 1.0], len(point)) * _spread(len(point))
    left, here, right = (evaluate(point + k * _DIFFERENCE * move) for k in (-1.0, 0.0, 1.0))
    slopes = np.array([right[0] - here[0], here[0] - left[0]]) / _DIFFERENCE
    expected = float(here[1:] @ move)
    noise = _ROUNDING * float(abs(here[0])) / _DIFFERENCE
    bend = float(np.abs(right[1:] - left[1:]) @ np.abs(move))  # of a smooth loss: how much its slopes change anyway
    whole = max(float(np.abs(here[1:]) @ np.abs(move)), bend, noise)
    off = max(float(np.abs(slopes - expected).max()) - bend, 0.0)
    return _worst(
        off / whole if whole > 0 else off, jump(lambda k: evaluate(point + k * move)[1:] * np.abs(move), whole)
    )
