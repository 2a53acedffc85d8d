"""The gradient from solves at shifted parameters: slow, but independent of derivatives, and checked.

For each parameter, central differences at steps h, h/2, h/4, h/8 are extrapolated to h = 0 (Ridders, Accurate
computation of F'(x) and F'(x) F''(x), 1982). The step balances truncation, O(h^2) before extrapolation, against the
noise of the inner solve divided by h: with solves to 1e-10 the default reaches about eight digits.

Central differences agree with each other even on a kink, so one-sided differences are compared as well: their gap must
vanish with h. They also agree if something changes only between psi and psi + h/8, so differences at h/1000 must agree
with them. No difference tells a saddle point from a minimum, or the derivative of a step from zero; so the solution at
psi and the loss there must also pass the tests of the implicit gradient, whose value is not used.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.irl.hypergradients.certificate import (
    HypergradientResult,
    enforce,
    nonfinite_failures,
)
from kpirl_ocp.irl.hypergradients.implicit import differentiate
from kpirl_ocp.irl.hypergradients.loss import Loss, data_of, squared_distance
from kpirl_ocp.irl.hypergradients.smoothness import kinks_at
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Guess, Solver
from kpirl_ocp.ocp.problem.statement.checks import number
from kpirl_ocp.ocp.sensitivity.certificate import Certificate, Policy, check_policy
from kpirl_ocp.ocp.solvers.gradient_descent import GradientDescent
from kpirl_ocp.ocp.solvers.ipopt import Ipopt
from kpirl_ocp.pictures import Brief
from kpirl_ocp.types import Array, Demonstration, Solution

_LEVELS = 4
_NEARBY = 1e-3  # the much smaller h, relative to the largest
# Largest tolerated disagreement of the extrapolations, and gap of the one-sided differences, relative to the slopes.
DISAGREEMENT = 1e-5
GAP = 1e-3
# Relative noise of a loss, from inner solves to 1e-10; divided by the smallest h it is the noise of a difference.
NOISE = 1e-9


@dataclass(frozen=True, kw_only=True, repr=False)
class FiniteDifferenceCertificate(Certificate):
    """Evidence for a finite-difference gradient.

    disagreement: (n_psi,) difference of the best two extrapolations, an estimate of the error.
    gap: (n_psi,) right minus left one-sided derivative, extrapolated to h = 0.
    """

    disagreement: Array
    gap: Array


@dataclass(frozen=True, repr=False)
class FiniteDifference(Brief):
    """Central differences of the loss with Ridders' extrapolation.

    solver: any solver; of GradientDescent it differentiates the N steps, of others the solution of the OCP.
    step: largest h, relative to max(1, |psi_i|).
    """

    solver: Solver = Ipopt()
    loss: Loss = squared_distance
    step: float = 1e-2
    policy: Policy = "raise"

    def __post_init__(self) -> None:
        check_policy(self.policy, ("raise", "flag"))
        number("step", self.step, "positive", 0)

    def __call__(
        self, problem: OCP, demonstration: Demonstration, psi: ArrayLike, guess: Guess = None
    ) -> HypergradientResult:
        """Loss, gradient (n_psi,) and certificate at psi (n_psi,); arguments and errors as in `Hypergradient`.

        Needs 10 n_psi + 1 solves.
        """
        s0, psi, context = problem.inputs(demonstration.s0, psi, demonstration.context)
        data, loss = data_of(self.loss, problem, demonstration), self.loss(problem)
        solutions: list[Solution] = []

        def evaluate(at: Array) -> float:
            solutions.append(self.solver.solve(problem, s0, at, context, guess))
            return float(loss(solutions[-1].states.T, solutions[-1].actions.T, data))

        value = evaluate(psi)
        rows = [_derivative(evaluate, value, psi, i, self.step * max(1.0, abs(psi[i]))) for i in range(len(psi))]
        gradient, disagreement, gap, slope, change = np.array(rows).reshape(-1, 5).T
        noise = NOISE * abs(value) / self.step
        failures = [
            *nonfinite_failures(value, gradient),
            *_failures(solutions, disagreement, gap, slope, noise * 2 ** (_LEVELS - 1)),
            *_nearby_failures(change, slope, noise / _NEARBY),
            *self._evidence(problem, demonstration, solutions[0]),
        ]
        certificate = FiniteDifferenceCertificate(
            solution=solutions[0], failures=tuple(failures), disagreement=disagreement, gap=gap
        )
        return enforce(self.policy, HypergradientResult(value, gradient, certificate))

    def _evidence(self, problem: OCP, demonstration: Demonstration, solution: Solution) -> Sequence[str]:
        """Failures of the solution at psi and of the loss there, independent of the differences."""
        if not solution.status.ok or not np.isfinite(solution.states).all():
            return ()
        if isinstance(self.solver, GradientDescent):
            return kinks_at(problem, self.loss, data_of(self.loss, problem, demonstration), solution)
        return differentiate(problem, demonstration, solution, self.loss).certificate.failures


def _derivative(
    evaluate: Callable[[Array], float], centre: float, psi: Array, index: int, step: float
) -> tuple[float, float, float, float, float]:
    """Derivative along one parameter, its disagreement, the gap between right and left, the steepest slope, and the
    change of the derivative at far smaller h.

    Errors are relative to the slope: at a minimum of the loss the derivative vanishes, the slopes do not.
    """
    steps = step * np.array([*2.0 ** -np.arange(_LEVELS), _NEARBY])
    direction = np.eye(len(psi))[index]
    right, left = (np.array([evaluate(psi + sign * h * direction) for h in steps]) for sign in (1, -1))
    with np.errstate(over="ignore", invalid="ignore"):  # a diverged loss gives NaN, which is the answer
        *central, nearby = (right - left) / (2 * steps)
        derivative, disagreement = _extrapolate(np.array(central))
        gaps = ((right - 2 * centre + left) / steps)[:_LEVELS]
        slope = np.max(np.abs([right[0] - centre, left[0] - centre])) / step
        change = abs(nearby - derivative)
    return derivative, disagreement, 2 * gaps[-1] - gaps[-2], float(slope), float(change)


def _extrapolate(central: Array) -> tuple[float, float]:
    """Ridders' table over halved steps: the entry that agrees best with the ones it came from."""
    best, error = central[0], np.inf
    column = central
    for order in range(1, len(central)):
        better = (4.0**order * column[1:] - column[:-1]) / (4.0**order - 1)
        errors = np.maximum(np.abs(better - column[1:]), np.abs(better - column[:-1]))
        if not np.isfinite(errors).all():
            return np.nan, np.nan
        if errors.min() < error:
            best, error = better[errors.argmin()], errors.min()
        column = better
    return float(best), float(error)


def _failures(solutions: list[Solution], disagreement: Array, gap: Array, slope: Array, noise: float) -> list[str]:
    failures = []
    failed = [solution.status for solution in solutions if not solution.status.ok]
    if failed:
        failures.append(f"{len(failed)} of {len(solutions)} solves failed, the first with {failed[0].name}.")
    scale = np.max(slope, initial=np.finfo(float).tiny)
    if not (disagreement <= DISAGREEMENT * scale + noise).all():
        failures.append(f"Step sizes disagree by {np.max(disagreement / scale):.1e} of the slope.")
    if not (np.abs(gap) <= GAP * scale + 4 * noise).all():
        failures.append(f"Right and left derivatives differ by {np.max(np.abs(gap)) / scale:.1e} of the slope.")
    return failures


def _nearby_failures(change: Array, slope: Array, noise: float) -> list[str]:
    scale = np.max(slope, initial=np.finfo(float).tiny)
    if (change <= GAP * scale + noise).all():
        return []
    return [f"The derivative changes by {np.max(change) / scale:.1e} of the slope at far smaller steps: lower `step`."]
