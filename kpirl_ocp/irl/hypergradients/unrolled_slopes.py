"""One-sided finite differences of the loss after all gradient steps, which show kinks that derivatives do not.

CasADi's derivative at a kink of a cost is that of one side. Where steps end on a kink, or cross it again and again, the
loss changes at another rate than the product of their derivatives says. Along a fixed random direction d of psi,

    (L(psi + h d) - L(psi)) / h    and    (L(psi) - L(psi - h d)) / h    must both equal    dL/dpsi . d.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.irl.hypergradients.loss import Loss, data_of
from kpirl_ocp.ocp.codegen.numpy_calls import Call
from kpirl_ocp.ocp.problem.columns import regroup, repeat
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.reduced_cost import ReducedCost, reduced_symbols
from kpirl_ocp.ocp.problem.solver import Guess, guess_actions
from kpirl_ocp.ocp.sensitivity.certificate import KINK
from kpirl_ocp.ocp.solvers.gradient_descent import GradientDescent, check_constraints, next_actions
from kpirl_ocp.types import Array, Demonstration

STEP = 1e-6  # h, relative to psi
_CLOSER = 0.1  # a second h, relative to the first: errors by curvature shrink with h, those by a kink do not
_ROUNDING = 1e-11  # rounding error of the loss, relative to its terms, with a safety margin
SMALL = 1e-3  # every parameter counts as at least this share of the largest one


@dataclass(frozen=True)
class Descent:
    """The inputs of one descent.

    psi: (n_psi,). actions: (T, n_u) initial actions. start: (n_s,). context: (n_c,). observed: (T+1, n_z).
    """

    problem: OCP
    solver: GradientDescent
    loss: Loss
    psi: Array
    actions: Array
    start: Array
    context: Array
    observed: Array

    @classmethod
    def toward(
        cls,
        problem: OCP,
        solver: GradientDescent,
        loss: Loss,
        demonstration: Demonstration,
        psi: ArrayLike,
        guess: Guess = None,
    ) -> Descent:
        """The descent from a guess, or from zero actions; errors as in `Hypergradient`."""
        check_constraints(problem, solver.project)
        start, numbers, context = problem.inputs(demonstration.s0, psi, demonstration.context)
        observed = data_of(loss, problem, demonstration).T
        return cls(problem, solver, loss, numbers, guess_actions(problem, guess), start, context, observed)

    @np.errstate(over="ignore", invalid="ignore")
    def kink(self, losses: Call, loss: float, gradient: Array, terms: float) -> float:
        """The largest relative difference between gradient and one-sided slopes that curvature does not explain.

        Args:
            losses: `losses_function` for two descents.
            loss: at psi.
            gradient: (n_psi,).
            terms: the size of the terms of the loss, times the amplification of rounding by the steps.
        """
        move = direction(self.psi)
        noise = _ROUNDING * terms / STEP
        expected, total = gradient @ move, np.abs(gradient * move).sum()
        far = self._slopes(losses, move, STEP, loss)
        kink = _ratio(np.abs(far - expected).max(), np.max([total, noise, *np.abs(far)]))
        if not kink > KINK:
            return kink
        near = self._slopes(losses, move, _CLOSER * STEP, loss)
        left = np.abs(near - expected - _CLOSER * (far - expected)).max() / (1 - _CLOSER)
        return _ratio(left, np.max([total, noise / _CLOSER, *np.abs(far), *np.abs(near)]))

    def _slopes(self, losses: Call, move: Array, length: float, loss: float) -> Array:
        """Forward and backward difference quotient."""
        sides = [replace(self, psi=self.psi + sign * length * move) for sign in (1.0, -1.0)]
        (shifted,) = losses(*side_by_side(sides))
        return np.array([1.0, -1.0]) * (shifted - loss) / length


def side_by_side(descents: Sequence[Descent]) -> list[Array]:
    """Actions, starts, parameters, contexts and observations, each with one descent after the other."""
    arrays = ((x.actions, x.start, x.psi, x.context, x.observed) for x in descents)
    return list(map(np.concatenate, zip(*arrays, strict=True)))


def direction(psi: Array) -> Array:
    """A random direction (n_psi,), the same in every call, scaled by the size of the parameters."""
    sizes = np.abs(psi)
    largest = sizes.max(initial=0.0)
    own = np.maximum(sizes, SMALL * largest) if largest > 0 else np.ones(len(psi))
    return own * _shares(len(psi))


@lru_cache(maxsize=64)
def _shares(count: int) -> Array:
    """Random numbers (count,), the same in every call."""
    return np.random.default_rng(0).uniform(0.5, 1.0, count)


def _ratio(part: float, whole: float) -> float:
    """part / whole; 0 where both are 0, and infinite where the whole is not finite."""
    if whole > 0 and np.isfinite(whole):
        return float(part / whole)
    return 0.0 if part == 0 and whole == 0 else math.inf


def losses_function(problem: OCP, solver: GradientDescent, loss: Loss, columns: int) -> ca.Function:
    """(U_0, s0, psi, c, Z) -> the losses (1, B) after all steps; shapes as in `unrolled_function`."""
    reduced, (u, s0, psi, context) = ReducedCost(problem, columns), reduced_symbols(problem, columns)
    function = loss(problem)
    observed = ca.MX.sym("Z", function.size1_in(2), columns * (problem.horizon + 1))
    step = next_actions(problem, solver, columns)
    constants = (s0, psi, *reduced.cost.coefficients(psi, context))
    final = step.fold(solver.steps)(regroup(u, problem.horizon), *repeat(constants, solver.steps))
    rollout = reduced.passes.rollout(s0, final, psi)
    states, actions = regroup(rollout.states, columns), regroup(final, columns)
    value = function.map(columns)(states, actions, observed)
    return ca.Function("losses", [u, s0, psi, context, observed], [ca.densify(value)])
