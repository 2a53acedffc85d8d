"""Differentiate through the gradient steps of the inner loop (the paper's way; Algorithm 1).

With u_{k+1} = Phi(u_k, psi), k = 0..N-1, and the loss L(u_N), reverse accumulation is one pass back over the steps:

    v_N = dL/du,    v_k = (dPhi/du)^T v_{k+1},    dL/dpsi = dL/dpsi|_u + sum_k (dPhi/dpsi)^T v_{k+1}.

`Unrolled` takes all terms. `Truncated` keeps the last k; at a converged point that is the k-term Neumann series of the
implicit gradient (Shaban et al., Truncated Back-propagation for Bilevel Optimization, 2019).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.hypergradients.affine_steps import has_affine_dynamics, has_quadratic_costs
from kpirl_ocp.irl.hypergradients.certificate import HypergradientResult, enforce, nonfinite_failures
from kpirl_ocp.irl.hypergradients.loss import Loss, squared_distance
from kpirl_ocp.irl.hypergradients.own_passes import passes_agree
from kpirl_ocp.irl.hypergradients.smoothness import LossAt, parameter_kinks
from kpirl_ocp.irl.hypergradients.unrolled_code import columns_of, losses_code, outputs_of
from kpirl_ocp.irl.hypergradients.unrolled_slopes import STEP, Descent, direction
from kpirl_ocp.ocp.codegen.numpy_calls import Call, call_built
from kpirl_ocp.ocp.conditions.steepness import nearly_constant_in_psi
from kpirl_ocp.ocp.problem.layout import by_stage
from kpirl_ocp.ocp.problem.linearised_dynamics import depends_on_psi
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Guess
from kpirl_ocp.ocp.sensitivity.certificate import KINK, WRONG_DERIVATIVES, Certificate, Policy, check_policy
from kpirl_ocp.ocp.solvers.gradient_descent import GradientDescent, audited
from kpirl_ocp.pictures import Brief
from kpirl_ocp.types import Array, Demonstration, Solution

# An iterate this close to a bound before projection [units of u] sits on the kink of the projection.
_KINK = 1e-12
# Share of the adjoint that truncation may leave out before the gradient counts as approximate.
_REMAINDER = 1e-9
# One-sided slopes are not computed where the dynamics' derivatives provably stay the same when psi changes by this
# share, times the amplification of differences by the steps.
_CLEAR = 1e-6
# Growth of the adjoint over the reverse pass up to which quadratic costs leave the loss smooth near psi: when psi
# changes by 1e-6, slopes change by about 1e-6 times the growth. Steps that amplify differences more may be chaotic:
# their exact derivatives hold only within, say, 1e-11 of psi, and are of no use.
_STEADY = 100.0
# Growth of the adjoint over the reverse pass, and so of rounding errors in the steps, that leaves under eight digits.
_GROWTH = 1e8
_HEAD = 5  # numbers before the gradient in an output of `unrolled_function`
_STEPS_KINK = (
    "The steps end on a kink or cross one, or they diverge: the loss has other slopes beside psi than this gradient. "
    "Use smooth costs and dynamics (squares, softplus, tanh), smaller steps (`step_size`), or another guess."
)


@dataclass(frozen=True, kw_only=True, repr=False)
class UnrolledCertificate(Certificate):
    """Evidence for a gradient through gradient steps.

    steps: N. differentiated: number of last steps in the reverse pass.
    remainder: |v_{N-k}| / |v_N|, the adjoint at which the reverse pass stopped; it multiplies everything left out. At
        most about one where the steps converge; where they diverge, the factor by which they amplify rounding errors.
    kink_distance: smallest distance of an unprojected iterate to its bound; infinite without projection.
    kink: relative difference between the gradient and one-sided finite differences of the loss along one fixed random
        direction of psi, for which the steps are taken again; differences that curvature explains do not count. It
        also measures what truncation left out. It is set to zero without being measured where nothing can be steep:
        the steps amplify differences (`remainder`) at most 100 times, costs and loss are quadratic with coefficients
        that hardly change near psi, and the dynamics are affine in the same sense, or a network whose weights bound
        the change of its Jacobian, at all iterates, to a thousandth of its terms for moves of the size measured at the
        last one (`allowed_move`). Having no kink would not be enough: a sigmoid may be as steep as a step.
    """

    steps: int
    differentiated: int
    remainder: float
    kink_distance: float
    kink: float


@dataclass(frozen=True, repr=False)
class Unrolled(Brief):
    """The exact gradient of the loss after all N steps.

    It is the derivative of the map that the steps make up, converged or not (`certificate.solution.status`).

    solver: the gradient descent to unroll; no other solver can be.
    loss: IRL loss.
    policy: "raise" or "flag" when the gradient is not certified (NaN, steps that diverge, an iterate on the kink of the
        projection, or slopes of the loss to both sides of psi that differ from it).
    checkpoint: store only every sqrt(N)-th iterate and recompute the steps between: memory O(sqrt N), at the price of
        one more forward pass.
    """

    solver: GradientDescent
    loss: Loss = squared_distance
    policy: Policy = "raise"
    checkpoint: bool = False

    def __post_init__(self) -> None:
        _check(self.solver, self.policy)

    def __call__(
        self, problem: OCP, demonstration: Demonstration, psi: ArrayLike, guess: Guess = None
    ) -> HypergradientResult:
        """Loss, gradient (n_psi,) and certificate at psi (n_psi,); arguments and errors as in `Hypergradient`."""
        return self.batch(problem, [demonstration], psi, [guess])[0]

    def batch(
        self,
        problem: OCP,
        demonstrations: Sequence[Demonstration],
        psi: ArrayLike,
        guesses: Sequence[Guess] | None = None,
    ) -> list[HypergradientResult]:
        """One result per demonstration, up to five computed together, by products of matrices.

        guesses: initial guesses, one per demonstration; None starts all from zero actions.
        """
        steps = self.solver.steps
        results = unrolled_gradients(
            problem, self.solver, self.loss, steps, demonstrations, psi, guesses, self.checkpoint
        )
        return [enforce(self.policy, result) for result in results]


@dataclass(frozen=True, repr=False)
class Truncated(Brief):
    """The gradient through the last steps only: biased on purpose, and not certified unless the remainder vanishes.

    last: k, number of the solver's last steps in the reverse pass.
    policy: "flag" by default, because the caller asked to leave terms out.
    """

    solver: GradientDescent
    last: int
    loss: Loss = squared_distance
    policy: Policy = "flag"

    def __post_init__(self) -> None:
        _check(self.solver, self.policy)
        if not 1 <= self.last <= self.solver.steps:
            raise ProblemError(f"last must be between 1 and the solver's {self.solver.steps} steps, got {self.last}.")

    def __call__(
        self, problem: OCP, demonstration: Demonstration, psi: ArrayLike, guess: Guess = None
    ) -> HypergradientResult:
        """Loss, gradient (n_psi,) and certificate at psi (n_psi,); arguments and errors as in `Hypergradient`."""
        results = unrolled_gradients(problem, self.solver, self.loss, self.last, [demonstration], psi, [guess])
        return enforce(self.policy, results[0])


def _check(solver: GradientDescent, policy: str) -> None:
    if not isinstance(solver, GradientDescent):
        name = type(solver).__name__
        raise ProblemError(f"only GradientDescent can be unrolled, not {name}: use Implicit({name}()).")
    check_policy(policy, ("raise", "flag"))


def unrolled_gradients(
    problem: OCP,
    solver: GradientDescent,
    loss: Loss,
    last: int,
    demonstrations: Sequence[Demonstration],
    psi: ArrayLike,
    guesses: Sequence[Guess] | None = None,
    checkpoint: bool = False,
) -> list[HypergradientResult]:
    """Descend N steps, then accumulate the gradient back through the last ones; demonstrations side by side."""
    descents = [
        Descent.toward(problem, solver, loss, demonstration, psi, guess)
        for demonstration, guess in zip(demonstrations, guesses or [None] * len(demonstrations), strict=True)
    ]
    if not descents:
        return []
    columns = columns_of(len(descents))
    wrong = () if passes_agree(problem, columns) else (WRONG_DERIVATIVES,)
    outputs = outputs_of(descents, last, checkpoint)
    losses = partial(call_built, losses_code, problem, solver, loss, last, checkpoint, columns)
    return [_certified(descent, last, output, wrong, losses) for descent, output in zip(descents, outputs, strict=True)]


def _certified(
    descent: Descent, last: int, output: Array, wrong: tuple[str, ...], losses: Callable[[], Call]
) -> HypergradientResult:
    """The result of one descent, which is taken again beside psi where that could show a kink.

    Quadratic costs whose coefficients hardly change near psi have no kink in psi; constraints there are none.
    wrong: failures that are known already. losses: for `Descent.kink`.
    """
    problem, sweep = descent.problem, _sweep(descent, last, output)
    solution = sweep.certificate.solution
    move = STEP * direction(descent.psi)
    gentle = has_quadratic_costs(problem, descent.loss) and nearly_constant_in_psi(problem, solution, move)
    if gentle and last == descent.solver.steps and sweep.steady and has_affine_dynamics(problem, sweep.clear):
        return sweep.result(0.0, wrong)
    if nonfinite_failures(sweep.loss, sweep.gradient):
        return sweep.result(math.nan, wrong)  # no slopes to compare
    at = LossAt(problem, descent.loss, descent.observed.T, by_stage(solution.states, solution.actions))
    kink = descent.kink(losses(), sweep.loss, sweep.gradient, sweep.terms(at))
    by_psi = [] if gentle and not depends_on_psi(problem.transition) else parameter_kinks(problem, solution)
    return sweep.result(kink, (*wrong, *at.kinks(), *by_psi))


def gradient_alone(method: Unrolled, problem: OCP, demonstration: Demonstration, psi: ArrayLike) -> Array:
    """The gradient (n_psi,) without a certificate, for further losses at a plan of which one was certified."""
    descent = Descent.toward(problem, method.solver, method.loss, demonstration, psi)
    (output,) = outputs_of([descent], method.solver.steps, method.checkpoint)
    return output[_HEAD : _HEAD + problem.n_parameters]


class _Sweep(NamedTuple):
    """The result of one reverse pass, before one-sided slopes are known.

    clear: True if the dynamics are a network whose Jacobians hardly change near all iterates.
    """

    loss: float
    gradient: Array
    certificate: UnrolledCertificate
    clear: bool

    def terms(self, at: LossAt) -> float:
        """The size of the loss's terms, to which its rounding error is relative, times the steps' amplification."""
        solution = self.certificate.solution
        with np.errstate(over="ignore", invalid="ignore"):
            plan = np.concatenate((solution.states, solution.actions), axis=None)
            size = abs(at.value) + np.abs(at.slopes) @ np.abs(plan)
            return float(size * max(1.0, self.certificate.remainder))

    @property
    def steady(self) -> bool:
        """True if the steps amplify differences only moderately."""
        return self.certificate.remainder <= _STEADY

    def result(self, kink: float, wrong: tuple[str, ...]) -> HypergradientResult:
        """The result, with further failures, and one more where the steps are not smooth."""
        found = self.certificate
        failures = *found.failures, *wrong
        if not failures and not kink <= KINK:
            failures = (_STEPS_KINK,)
        if kink != found.kink or failures != found.failures:
            found = replace(found, kink=kink, failures=failures)
        return HypergradientResult(self.loss, self.gradient, found)


def _sweep(descent: Descent, last: int, output: Array) -> _Sweep:
    """The reverse pass of one descent, from one column of `unrolled_function`."""
    problem, solver = descent.problem, descent.solver
    value, remainder, kink, clearance, initial = output[:_HEAD].tolist()
    end = _HEAD + problem.n_parameters
    gradient, point = output[_HEAD:end], output[end:]
    solution = audited(problem, solver, descent.psi, descent.context, initial, point)
    certificate = UnrolledCertificate(
        solution=solution,
        failures=tuple(_failures(solution, value, gradient, remainder, kink, solver.steps - last)),
        steps=solver.steps,
        differentiated=last,
        remainder=remainder,
        kink_distance=kink,
        kink=0.0,  # until it is measured
    )
    return _Sweep(value, gradient, certificate, _CLEAR * max(1.0, remainder) < clearance < np.inf)


def _failures(
    solution: Solution, loss: float, gradient: Array, remainder: float, kink: float, left_out: int
) -> list[str]:
    failures = nonfinite_failures(loss, gradient)
    if not math.isfinite(solution.objective):
        failures.append("The inner cost is NaN or infinite: take smaller steps (`step_size`), or look at the cost.")
    if left_out and not remainder <= _REMAINDER:
        failures.append(f"Truncated: the first {left_out} steps are left out, with {remainder:.1e} of the adjoint.")
    if not left_out and remainder > _GROWTH:
        failures.append(
            f"The steps diverge: they enlarge differences {remainder:.1e} times, rounding among them. "
            "Take smaller steps (`step_size`), or another guess."
        )
    if not kink > _KINK:
        failures.append("An iterate touches an action bound with zero force: the projection has no derivative there.")
    return failures
