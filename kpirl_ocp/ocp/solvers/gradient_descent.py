"""Gradient descent on the actions, the paper's inner loop (Algorithm 3):

u <- P(u - alpha grad_u C_psi(rollout(s0, u))),    P the identity, or the projection onto the action bounds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.codegen.compiler import compiled
from kpirl_ocp.ocp.interior_point.library import all_finite
from kpirl_ocp.ocp.problem.columns import by_trajectory, repeat, symbols_like
from kpirl_ocp.ocp.problem.guards import dense
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.reduced_cost import Linearisation, ReducedCost, reduced_symbols
from kpirl_ocp.ocp.problem.scope import constant_bounds, refuse_features
from kpirl_ocp.ocp.problem.solver import Guess, guess_actions, numbers_of
from kpirl_ocp.ocp.problem.statement.checks import check_settings
from kpirl_ocp.ocp.problem.trajectory_cost import Coefficients
from kpirl_ocp.sizes import LONGEST
from kpirl_ocp.types import (
    Array,
    KKTResiduals,
    Multipliers,
    Solution,
    Status,
    Trajectory,
    largest,
    max_or_nan,
    record,
)


@dataclass(frozen=True)
class GradientDescent:
    """A fixed number of gradient steps.

    steps: N.
    step_size: alpha; the paper's learning rate for the actions is the default.
    project: project every step onto the action bounds.
    tolerance: KKT residual below which the result counts as converged.
    """

    steps: int = 20
    step_size: float = 1e-2
    project: bool = False
    tolerance: float = 1e-6

    def __post_init__(self) -> None:
        if not isinstance(self.steps, int) or not 1 <= self.steps <= LONGEST:
            raise ProblemError(f"steps must be a whole number from 1 to {LONGEST}, got {self.steps!r}.")
        check_settings(self, "step_size", "tolerance")
        for name in ("step_size", "tolerance"):
            if not getattr(self, name) > 0:
                raise ProblemError(f"{name} must be positive, got {getattr(self, name)!r}.")

    def solve(
        self, problem: OCP, s0: ArrayLike, psi: ArrayLike = (), context: ArrayLike = (), guess: Guess = None
    ) -> Solution:
        """Take the steps; see `Solver.solve`. ProblemError for state bounds or path constraints."""
        start, psi, context = numbers_of(problem, s0, psi, context)
        check_constraints(problem, self.project)
        output = dense(_descent(problem, self)(guess_actions(problem, guess).T, start, psi, context)).ravel()
        return audited(problem, self, psi, context, float(output[0]), output[1:])


@lru_cache(maxsize=64)
def check_constraints(problem: OCP, project: bool) -> None:
    """Raise ProblemError if the problem has constraints that gradient descent would ignore."""
    refuse_features(problem, "gradient descent")
    if problem.has_state_constraints:
        raise ProblemError(
            "gradient descent cannot honour state bounds or path constraints: use Ipopt, "
            "or problem.unconstrained() to leave them out on purpose."
        )
    if problem.has_action_bounds and not project:
        raise ProblemError(
            "the problem has action bounds: use GradientDescent(..., project=True), "
            "or problem.unconstrained() to leave them out on purpose."
        )


def gradient_step(problem: OCP, solver: GradientDescent, columns: int = 1) -> ca.Function:
    """(U (n_u, T B), s0, psi, theta) -> next U, J (1, B), extremes, U before the projection, states, memories.

    theta stands for the two arrays of `Coefficients`; the memories of rollout and adjoint are for `hessian_product`.
    """
    reduced, (u, s0, psi, context) = ReducedCost(problem, columns), reduced_symbols(problem, columns)
    theta = symbols_like("theta", reduced.cost.coefficients(psi, context))
    at = reduced.linearise(s0, u, psi, Coefficients(*theta))
    free = u - solver.step_size * at.gradient
    outputs = [
        project(problem, solver, free),
        at.value,
        extremes(at),
        free,
        at.rollout.states,
        *at.rollout.memory,
        *at.adjoint.memory,
    ]
    return ca.Function("gradient_step", [u, s0, psi, *theta], outputs)


def next_actions(problem: OCP, solver: GradientDescent, columns: int = 1) -> ca.Function:
    """The first output of `gradient_step` alone."""
    step = gradient_step(problem, solver, columns)
    always_inline, never_inline = True, False  # so that what nobody asks for is not computed
    outputs = step.call(step.mx_in(), always_inline, never_inline)
    return ca.Function("next_actions", step.mx_in(), outputs[:1])


def extremes(at: Linearisation) -> ca.MX:
    """Those of the rollout (n, B); nothing where they are not known."""
    return ca.MX(0, at.value.size2()) if at.rollout.extremes is None else at.rollout.extremes


def project(problem: OCP, solver: GradientDescent, u: ca.MX) -> ca.MX:
    """P(U): the nearest actions within the bounds, or U itself.

    Written with comparisons, because fmin and fmax would turn NaN into a bound. Infinite bounds become huge ones, so
    that zero times a bound is zero.
    """
    if not solver.project:
        return u
    lower, upper = (ca.repmat(np.clip(bound, -1e300, 1e300), 1, u.size2()) for bound in constant_bounds(problem)[2:])
    below, above = u < lower, u > upper
    return below * lower + above * upper + (1 - below - above) * u


def projection_slope(problem: OCP, solver: GradientDescent, u: ca.MX) -> ca.MX | float:
    """The derivative of P(U): one where an action is within its bounds, zero elsewhere."""
    if not solver.project:
        return 1.0
    lower, upper = (ca.repmat(ca.DM(bound), 1, u.size2()) for bound in constant_bounds(problem)[2:])
    return 1 - (u < lower) - (u > upper)


def terminal_point(at: Linearisation, columns: int = 1) -> ca.MX:
    """One column per trajectory: states, actions, gradient, costates and objective, as `audited` takes them.

    One array, because handing an array from CasADi to numpy costs as much as a gradient step of a small problem. The
    costate lambda_{t+1} is the derivative of the objective with respect to a disturbance added to s_{t+1}.
    """
    parts = (at.rollout.states, at.rollout.actions, at.gradient, at.adjoint.costates)
    return ca.vertcat(*(by_trajectory(part, columns) for part in parts), at.value)


@lru_cache(maxsize=64)
def _descent(problem: OCP, solver: GradientDescent) -> ca.Function:
    """(U, s0, psi, c) -> the cost of the guess, then `terminal_point`."""
    reduced, (u, s0, psi, context) = ReducedCost(problem), reduced_symbols(problem)
    theta = reduced.cost.coefficients(psi, context)
    final = next_actions(problem, solver).fold(solver.steps)(u, *repeat((s0, psi, *theta), solver.steps))
    before, after = (reduced.linearise(s0, actions, psi, theta) for actions in (u, final))
    output = ca.vertcat(before.value, terminal_point(after))
    return compiled(ca.Function("descent", [u, s0, psi, context], [output]))


def audited(
    problem: OCP, solver: GradientDescent, psi: Array, context: Array, initial_cost: float, point: Array
) -> Solution:
    """The solution with its residuals, from the cost of the guess and one column of `terminal_point`.

    Residuals are those of the reduced problem: costates make the gradient by the states vanish, the rollout defects.
    """
    steps, n_s, n_u = problem.horizon, problem.n_states, problem.n_actions
    of_states, of_actions = (steps + 1) * n_s, steps * n_u
    plan, duals, objective = point[: of_states + of_actions], point[of_states + of_actions : -1], float(point[-1])
    states, actions = plan[:of_states].reshape(-1, n_s), plan[of_states:].reshape(-1, n_u)
    slope, costates = duals[:of_actions].reshape(-1, n_u), duals[of_actions:].reshape(-1, n_s)
    pushing = _bound_multipliers(problem, actions, slope)
    residuals = KKTResiduals(largest(slope + pushing), 0.0, 0.0, 0.0, max_or_nan(1.0, largest(duals)))
    none = np.zeros(0)
    multipliers = {
        "dynamics": costates,
        "state": np.zeros((steps + 1, n_s)),
        "action": pushing,
        "path": none.reshape(steps, 0),
        "path_equality": none.reshape(steps, 0),
        "terminal": none,
        "terminal_equality": none,
    }
    fields = {
        "trajectory": record(Trajectory, {"states": states, "actions": actions}),
        "multipliers": record(Multipliers, multipliers),
        "objective": objective,
        "residuals": residuals,
        "status": _status(plan, initial_cost, objective, residuals.worst, solver.tolerance),
        "iterations": solver.steps,
        "psi": psi,
        "context": context,
        "barrier": 0.0,
        "message": "",
    }
    return record(Solution, fields)


def _bound_multipliers(problem: OCP, actions: Array, slope: Array) -> Array:
    """nu = -slope where an action lies on a bound and the slope pushes it outwards, else 0; (T, n_u)."""
    if not problem.has_action_bounds:
        return np.zeros(slope.shape)
    lower, upper = (np.asarray(bound, float) for bound in problem.action_bounds)
    outwards = ((actions >= upper) & (slope < 0)) | ((actions <= lower) & (slope > 0))
    return np.where(outwards, -slope, 0.0)


def _status(plan: Array, before: float, objective: float, residual: float, tolerance: float) -> Status:
    if not (math.isfinite(objective) and math.isfinite(residual) and all_finite(plan)):
        return Status.DIVERGED if math.isfinite(before) else Status.NOT_FINITE
    if residual <= tolerance:
        return Status.CONVERGED
    return Status.STEPS_TAKEN if objective <= before else Status.DIVERGED
