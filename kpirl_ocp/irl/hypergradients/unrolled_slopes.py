"""One-sided finite differences of the loss after all gradient steps, which show kinks that derivatives do not.

CasADi's derivative at a kink of a cost is that of one side. Where steps end on a kink, or cross it again and again, the
loss changes at another rate than the product of their derivatives says. Along a fixed random direction d of psi,

    (L(psi + h d) - L(psi)) / h    and    (L(psi) - L(psi - h d)) / h    must both equal    dL/dpsi . d.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.irl.hypergradients.loss import Loss, data_of
from kpirl_ocp.ocp.codegen.compiler import compiled
from kpirl_ocp.ocp.codegen.numpy_calls import call_built
from kpirl_ocp.ocp.problem.columns import regroup, repeat
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.reduced_cost import ReducedCost, reduced_symbols
from kpirl_ocp.ocp.problem.solver import Guess, guess_actions
from kpirl_ocp.ocp.sensitivity.certificate import KINK
from kpirl_ocp.ocp.solvers.gradient_descent import GradientDescent, check_constraints, gradient_step
from kpirl_ocp.types import Array, Demonstration

STEP = 1e-6  # h, relative to psi
_CLOSER = 0.1  # a second h, relative to the first: errors by curvature shrink with h, those by a kink do not
_ROUNDING = 1e-11  # rounding error of the loss, relative to its terms, with a safety margin
SMALL = 1e-3  # every parameter counts as at least this share of the largest one


@dataclass(frozen=True)
class Descents:
    """The inputs of B descents with the same psi (n_psi,), one after the other in each array.

    actions: (B T, n_u) initial actions. starts: (B n_s,). contexts: (B n_c,). observed: (B (T+1), n_z).
    """

    problem: OCP
    solver: GradientDescent
    loss: Loss
    psi: Array
    actions: Array
    starts: Array
    contexts: Array
    observed: Array

    @classmethod
    def toward(
        cls,
        problem: OCP,
        solver: GradientDescent,
        loss: Loss,
        demonstrations: Sequence[Demonstration],
        psi: ArrayLike,
        guesses: Sequence[Guess] | None = None,
    ) -> Descents:
        """One descent per demonstration, from its guess or from zero actions; errors as in `Hypergradient`."""
        check_constraints(problem, solver.project)
        inputs = [problem.inputs(demonstration.s0, psi, demonstration.context) for demonstration in demonstrations]
        starts, psis, contexts = zip(*inputs, strict=True)
        actions = [guess_actions(problem, guess) for guess in guesses or [None] * len(inputs)]
        observed = [data_of(loss, problem, demonstration).T for demonstration in demonstrations]
        together = (np.concatenate(parts) for parts in (actions, starts, contexts, observed))
        return cls(problem, solver, loss, psis[0], *together)

    @np.errstate(over="ignore", invalid="ignore")
    def kinks(self, losses: Array, gradients: Array, terms: Array) -> Array:
        """The largest relative difference (B,) between gradients and one-sided slopes that curvature does not explain.

        Args:
            losses: (B,) at psi.
            gradients: (B, n_psi).
            terms: (B,) the size of the terms of each loss, times the amplification of rounding by the steps.
        """
        move = direction(self.psi)
        noise = _ROUNDING * terms / STEP
        expected, total = gradients @ move, np.abs(gradients * move).sum(axis=1)
        far = self._slopes(move, STEP, losses)
        size = np.max([total, noise, *np.abs(far)], axis=0)
        kinks = _ratio(np.abs(far - expected).max(axis=0), size)
        if not (kinks > KINK).any():
            return kinks
        near = self._slopes(move, _CLOSER * STEP, losses)
        size = np.max([total, noise / _CLOSER, *np.abs(far), *np.abs(near)], axis=0)
        left = np.abs(near - expected - _CLOSER * (far - expected)).max(axis=0) / (1 - _CLOSER)
        return np.where(kinks > KINK, _ratio(left, size), kinks)

    def _slopes(self, move: Array, length: float, losses: Array) -> Array:
        """Forward and backward difference quotients (2, B)."""
        count = len(losses)
        evaluate = call_built(_losses, self.problem, self.solver, self.loss, 2 * count)
        psis = np.concatenate([np.tile(self.psi + sign * length * move, count) for sign in (1.0, -1.0)])
        twice = (np.concatenate([array, array]) for array in (self.actions, self.starts, self.contexts, self.observed))
        actions, starts, contexts, observed = twice
        (shifted,) = evaluate(actions, starts, psis, contexts, observed)
        return np.array([[1.0], [-1.0]]) * (shifted.reshape(2, count) - losses) / length


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


def _ratio(part: Array, whole: Array) -> Array:
    """part / whole; 0 where both are 0, and infinite where the whole is not finite."""
    known = (whole > 0) & np.isfinite(whole)
    return np.divide(part, whole, out=np.where((part == 0) & (whole == 0), 0.0, np.inf), where=known)


@lru_cache(maxsize=64)
def _losses(problem: OCP, solver: GradientDescent, loss: Loss, columns: int) -> ca.Function:
    """(U_0, s0, psi, c, Z) -> the losses (1, B) after all steps; shapes as in `unrolled_function`."""
    reduced, (u, s0, psi, context) = ReducedCost(problem, columns), reduced_symbols(problem, columns)
    function = loss(problem)
    observed = ca.MX.sym("Z", function.size1_in(2), columns * (problem.horizon + 1))
    step = gradient_step(problem, solver, columns)
    once = ca.Function("once", step.mx_in(), step.call(step.mx_in())[:1])
    constants = (s0, psi, *reduced.cost.coefficients(psi, context))
    final = once.fold(solver.steps)(regroup(u, problem.horizon), *repeat(constants, solver.steps))
    rollout = reduced.passes.rollout(s0, final, psi)
    states, actions = regroup(rollout.states, columns), regroup(final, columns)
    value = function.map(columns)(states, actions, observed)
    return compiled(ca.Function("losses", [u, s0, psi, context, observed], [ca.densify(value)]))
