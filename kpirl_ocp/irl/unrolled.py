"""Differentiate through the gradient steps of the inner loop (the paper's way; Algorithm 1).

With u_{k+1} = Phi(u_k, psi), k = 0..N-1, and the loss L(u_N), reverse accumulation is one sweep over the steps:

    v_N = dL/du,    v_k = (dPhi/du)^T v_{k+1},    dL/dpsi = dL/dpsi|_u + sum_k (dPhi/dpsi)^T v_{k+1}.

`Unrolled` takes all terms. `Truncated` keeps the last k; at a converged point that is the k-term Neumann series of the
implicit gradient (Shaban et al., Truncated Back-propagation for Bilevel Optimization, 2019).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.hypergradient import (
    Certificate,
    HypergradientResult,
    Policy,
    check_policy,
    enforce,
    not_finite,
    seen,
)
from kpirl_ocp.irl.loss import Loss, squared_distance
from kpirl_ocp.ocp.gradient_descent import (
    GradientDescent,
    as_columns,
    check_constraints,
    finish,
    gradient_step,
    symbols,
    terminal_point,
)
from kpirl_ocp.ocp.native import compiled
from kpirl_ocp.ocp.problem import OCP
from kpirl_ocp.ocp.solver import Guess, guess_actions
from kpirl_ocp.types import Array, Demonstration, Solution

# An iterate this close to a bound before projection [units of u] sits on the kink of the projection.
_KINK = 1e-12
# Share of the adjoint that truncation may leave out before the gradient counts as approximate.
_REMAINDER = 1e-9


@dataclass(frozen=True, kw_only=True)
class UnrolledCertificate(Certificate):
    """Evidence for a gradient through gradient steps.

    steps: N. differentiated: how many of the last steps the sweep went through.
    remainder: |v_{N-k}| / |v_N|, the adjoint that the sweep stopped with; it multiplies everything left out.
    kink_distance: smallest distance of an unprojected iterate to its bound; infinite without projection.
    """

    steps: int
    differentiated: int
    remainder: float
    kink_distance: float


@dataclass(frozen=True)
class Unrolled:
    """The exact gradient of the loss after all N steps.

    It is the derivative of what the steps do, whether or not they converge: `certificate.solution.status` says that.

    solver: the gradient descent to unroll; no other solver can be.
    loss: IRL loss.
    policy: "raise" or "flag" when the gradient is not certified (NaN, or an iterate on the kink of the projection).
    """

    solver: GradientDescent
    loss: Loss = squared_distance
    policy: Policy = "raise"

    def __post_init__(self) -> None:
        _check(self.solver, self.policy)

    def __call__(
        self, problem: OCP, demonstration: Demonstration, psi: ArrayLike, guess: Guess = None
    ) -> HypergradientResult:
        """See `Hypergradient`."""
        result = sweep(problem, self.solver, self.loss, self.solver.steps, demonstration, psi, guess)
        return enforce(self.policy, result)


@dataclass(frozen=True)
class Truncated:
    """The gradient through the last steps only: biased on purpose, and flagged unless the remainder vanishes.

    last: k, how many of the solver's steps to go back.
    policy: "flag" by default, because leaving terms out is what the caller asked for.
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
        """See `Hypergradient`."""
        result = sweep(problem, self.solver, self.loss, self.last, demonstration, psi, guess)
        return enforce(self.policy, result)


def _check(solver: GradientDescent, policy: str) -> None:
    if not isinstance(solver, GradientDescent):
        name = type(solver).__name__
        raise ProblemError(f"only GradientDescent can be unrolled, not {name}: use Implicit({name}()).")
    check_policy(policy, ("raise", "flag"))


def sweep(
    problem: OCP,
    solver: GradientDescent,
    loss: Loss,
    last: int,
    demonstration: Demonstration,
    psi: ArrayLike,
    guess: Guess,
) -> HypergradientResult:
    """Descend N steps, then accumulate the gradient back through the last ones."""
    check_constraints(problem, solver.project)
    s0, psi, context = problem.inputs(demonstration.s0, psi, demonstration.context)
    start = guess_actions(problem, guess).ravel()
    function = _function(problem, solver, loss, last)
    output = np.array(function(start, s0, psi, context, seen(problem, demonstration))).ravel()
    value, remainder, kink, initial = output[:4].tolist()
    gradient, point = np.split(output[4:], [len(psi)])
    solution = finish(problem, solver, initial, point)
    certificate = UnrolledCertificate(
        solution=solution,
        failures=tuple(_failures(solution, value, gradient, remainder, kink, solver.steps - last)),
        steps=solver.steps,
        differentiated=last,
        remainder=remainder,
        kink_distance=kink,
    )
    return HypergradientResult(value, gradient, certificate)


def _failures(
    solution: Solution, loss: float, gradient: Array, remainder: float, kink: float, left_out: int
) -> list[str]:
    failures = not_finite(loss, gradient)
    if not np.isfinite(solution.objective):
        failures.append("The inner cost is NaN or infinite: look at the solution's status and the cost.")
    if left_out and not remainder <= _REMAINDER:
        failures.append(f"Truncated: the first {left_out} steps are left out, with {remainder:.1e} of the adjoint.")
    if not kink > _KINK:
        failures.append("An iterate touches an action bound with zero force: the projection has no derivative there.")
    return failures


@lru_cache(maxsize=64)
def _function(problem: OCP, solver: GradientDescent, loss: Loss, last: int) -> ca.Function:
    """(u_0, s0, psi, c, Z) -> one vector: loss, remainder, kink distance, initial cost, gradient, `terminal_point`."""
    u, s0, psi, context = symbols(problem)
    observed = ca.MX.sym("Z", problem.n_observations, problem.horizon + 1)
    step, adjoint = gradient_step(problem, solver), _adjoint_step(problem, solver)

    def repeat(count: int) -> list[ca.MX]:
        return [ca.repmat(value, 1, count) for value in (s0, psi, context)]

    iterates, free, costs = step.mapaccum(solver.steps)(u, *repeat(solver.steps))  # u_1 .. u_N
    before = ca.horzcat(u, iterates)[:, solver.steps - last : solver.steps]  # u_{N-k} .. u_{N-1}
    point = terminal_point(problem)(iterates[:, -1], s0, psi, context)

    value, slope, direct = _loss_and_gradients(problem, loss)(iterates[:, -1], s0, psi, observed)
    backwards = adjoint.mapaccum(last)(slope, before[:, ::-1], *repeat(last))
    gradient = direct + ca.sum2(backwards[1])
    remainder = ca.norm_2(backwards[0][:, -1]) / ca.fmax(ca.norm_2(slope), np.finfo(float).tiny)
    output = ca.vertcat(value, remainder, _kink_distance(problem, solver, free), costs[0], gradient, point)
    return compiled(ca.Function("unrolled", [u, s0, psi, context, observed], [output]))


def _adjoint_step(problem: OCP, solver: GradientDescent) -> ca.Function:
    """(v, u, s0, psi, c) -> (dPhi/du)^T v and (dPhi/dpsi)^T v: one Hessian-vector product."""
    u, s0, psi, context = symbols(problem)
    v = ca.MX.sym("v", u.numel())
    moved = ca.dot(v, gradient_step(problem, solver)(u, s0, psi, context)[0])
    return ca.Function("adjoint", [v, u, s0, psi, context], [ca.gradient(moved, u), ca.gradient(moved, psi)])


def _loss_and_gradients(problem: OCP, loss: Loss) -> ca.Function:
    """(u, s0, psi, Z) -> L, dL/du and, through the dynamics, dL/dpsi."""
    u, s0, psi, _ = symbols(problem)
    observed = ca.MX.sym("Z", problem.n_observations, problem.horizon + 1)
    actions = as_columns(problem, u)
    value = loss(problem)(problem.rollout(s0, actions, psi), actions, observed)
    return ca.Function("loss", [u, s0, psi, observed], [value, ca.gradient(value, u), ca.gradient(value, psi)])


def _kink_distance(problem: OCP, solver: GradientDescent, free: ca.MX) -> ca.MX:
    """Smallest distance of the unprojected iterates (T n_u, N) to an action bound."""
    bounds = [np.tile(bound, problem.horizon) for bound in problem.action_bounds]
    finite = [(bound, np.flatnonzero(np.isfinite(bound))) for bound in bounds]
    distances = [
        ca.fabs(free[rows.tolist(), :] - ca.repmat(ca.DM(bound[rows]), 1, solver.steps))
        for bound, rows in finite
        if solver.project and len(rows)
    ]
    return ca.mmin(ca.vertcat(*map(ca.vec, distances))) if distances else ca.MX(np.inf)
