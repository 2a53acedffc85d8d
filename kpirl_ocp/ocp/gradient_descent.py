"""Gradient descent on the actions, the paper's inner loop (Algorithm 3):

u <- P(u - alpha grad_u C_psi(rollout(s0, u))),    P the identity, or the projection onto the action bounds.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.kkt import largest
from kpirl_ocp.ocp.native import compiled
from kpirl_ocp.ocp.problem import OCP
from kpirl_ocp.ocp.solver import Guess, guess_actions
from kpirl_ocp.types import Array, KKTResiduals, Multipliers, Solution, Status, Trajectory


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
        if not isinstance(self.steps, int) or self.steps < 1:
            raise ProblemError(f"steps must be a whole number of at least 1, got {self.steps!r}.")
        if not self.step_size > 0:
            raise ProblemError(f"step_size must be positive, got {self.step_size!r}.")

    def solve(
        self, problem: OCP, s0: ArrayLike, psi: ArrayLike = (), context: ArrayLike = (), guess: Guess = None
    ) -> Solution:
        """Take the steps; see `Solver.solve`. ProblemError for state bounds or path constraints."""
        start, psi, context = problem.inputs(s0, psi, context)
        check_constraints(problem, self.project)
        descend, evaluate = _functions(problem, self)
        final, initial_cost = descend(guess_actions(problem, guess).ravel(), start, psi, context)
        point = np.array(evaluate(final, start, psi, context)).ravel()
        return finish(problem, self, float(initial_cost), point)


def check_constraints(problem: OCP, project: bool) -> None:
    """Raise ProblemError if the problem has constraints that gradient descent would ignore."""
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


def gradient_step(problem: OCP, solver: GradientDescent) -> ca.Function:
    """(u (T n_u,), s0, psi, c) -> the next iterate, the point before the projection, and the cost at u."""
    u, s0, psi, context = symbols(problem)
    states = problem.rollout(s0, as_columns(problem, u), psi)
    cost = problem.cost(states, as_columns(problem, u), psi, context)
    free = u - solver.step_size * ca.gradient(cost, u)
    return ca.Function("gradient_step", [u, s0, psi, context], [project(problem, solver, free), free, cost])


def project(problem: OCP, solver: GradientDescent, u: ca.MX) -> ca.MX:
    """P(u): the nearest actions within the bounds, or u itself.

    Written with comparisons, because fmin and fmax would turn NaN into a bound. Infinite bounds become huge ones, so
    that zero times a bound is zero.
    """
    if not solver.project:
        return u
    bounds = (np.clip(bound, -1e300, 1e300) for bound in problem.action_bounds)
    lower, upper = (ca.DM(np.tile(bound, problem.horizon)) for bound in bounds)
    below, above = u < lower, u > upper
    return below * lower + above * upper + (1 - below - above) * u


def terminal_point(problem: OCP) -> ca.Function:
    """(u, s0, psi, c) -> one vector: states, actions, gradient (T n_u,), costates and objective, as `finish` takes it.

    One vector, because handing an array from CasADi to numpy costs as much as a gradient step of a small problem. The
    costate lambda_{t+1} is the derivative of the objective with respect to a disturbance added to s_{t+1}.
    """
    u, s0, psi, context = symbols(problem)
    unknowns = ca.MX.sym("x", problem.horizon * (problem.n_actions + problem.n_states))
    moved, pushed = ca.vertsplit(unknowns, [0, u.numel(), unknowns.numel()])
    s, a, p, d = (
        ca.MX.sym("s", problem.n_states),
        ca.MX.sym("a", problem.n_actions),
        ca.MX.sym("p", problem.n_parameters),
        ca.MX.sym("d", problem.n_states),
    )
    disturbed = ca.Function("disturbed", [s, a, p, d], [problem.dynamics(s, a, p) + d]).mapaccum(problem.horizon)
    actions = as_columns(problem, moved)
    disturbance = ca.reshape(pushed, problem.n_states, problem.horizon)
    states = ca.horzcat(s0, disturbed(s0, actions, ca.repmat(psi, 1, problem.horizon), disturbance))
    objective = problem.cost(states, actions, psi, context)
    outputs = ca.vertcat(ca.vec(states), moved, ca.gradient(objective, unknowns), objective)
    point = ca.Function("point", [unknowns, s0, psi, context], [outputs])
    undisturbed = ca.vertcat(u, ca.MX.zeros(problem.horizon * problem.n_states))
    return ca.Function("terminal_point", [u, s0, psi, context], [point(undisturbed, s0, psi, context)])


def symbols(problem: OCP) -> tuple[ca.MX, ca.MX, ca.MX, ca.MX]:
    """u (T n_u,), s0, psi, c."""
    return (
        ca.MX.sym("u", problem.horizon * problem.n_actions),
        ca.MX.sym("s0", problem.n_states),
        ca.MX.sym("psi", problem.n_parameters),
        ca.MX.sym("c", problem.n_context),
    )


def as_columns(problem: OCP, u: ca.MX) -> ca.MX:
    """Actions (n_u, T) of the vector u (T n_u,)."""
    return ca.reshape(u, problem.n_actions, problem.horizon)


@lru_cache(maxsize=64)
def _functions(problem: OCP, solver: GradientDescent) -> tuple[ca.Function, ca.Function]:
    """(u, s0, psi, c) -> last iterate and the cost of the first; and -> `terminal_point`."""
    u, s0, psi, context = symbols(problem)
    step = gradient_step(problem, solver)
    once = ca.Function("once", [u, s0, psi, context], [step(u, s0, psi, context)[0]])
    repeated = (ca.repmat(value, 1, solver.steps) for value in (s0, psi, context))
    last = once.fold(solver.steps)(u, *repeated)
    descend = ca.Function("descend", [u, s0, psi, context], [last, step(u, s0, psi, context)[2]])
    return compiled(descend), compiled(terminal_point(problem))


def finish(problem: OCP, solver: GradientDescent, initial_cost: float, point: Array) -> Solution:
    """The audited solution from the cost of the guess and the output of `terminal_point`."""
    steps, n_s, n_u = problem.horizon, problem.n_states, problem.n_actions
    ends = np.cumsum([(steps + 1) * n_s, steps * n_u, steps * n_u, steps * n_s])
    states, actions, slope, costates, value = np.split(point, ends)
    trajectory = Trajectory(states.reshape(steps + 1, n_s), actions.reshape(steps, n_u))
    costates, slope, objective = costates.reshape(steps, n_s), slope.reshape(steps, n_u), float(value[0])
    pushing = _bound_multipliers(problem, trajectory.actions, slope)
    scale = float(np.max([1.0, largest(slope), largest(costates)]))
    residuals = KKTResiduals(largest(slope + pushing), 0.0, 0.0, 0.0, scale)
    multipliers = Multipliers(
        dynamics=costates,
        state=np.zeros((steps, n_s)),
        action=pushing,
        path=np.zeros((steps, 0)),
    )
    status = _status(trajectory, initial_cost, objective, residuals.worst, solver.tolerance)
    return Solution(trajectory, multipliers, objective, residuals, status, solver.steps)


def _bound_multipliers(problem: OCP, actions: Array, slope: Array) -> Array:
    """nu = -slope where an action lies on a bound and the slope pushes it outwards, else 0; (T, n_u)."""
    lower, upper = (np.asarray(bound, float) for bound in problem.action_bounds)
    outwards = ((actions >= upper) & (slope < 0)) | ((actions <= lower) & (slope > 0))
    return np.where(outwards, -slope, 0.0)


def _status(trajectory: Trajectory, before: float, objective: float, residual: float, tolerance: float) -> Status:
    values = np.concatenate([trajectory.states.ravel(), trajectory.actions.ravel(), [objective, residual]])
    if not np.isfinite(values).all():
        return Status.DIVERGED if np.isfinite(before) else Status.NOT_FINITE
    if residual <= tolerance:
        return Status.CONVERGED
    return Status.STEPS_TAKEN if objective <= before else Status.DIVERGED
