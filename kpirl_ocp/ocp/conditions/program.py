"""The problem as one nonlinear program (multiple shooting).

    min J(w)   subject to   g_E(w) = 0,  g_I(w) <= 0,  lower <= w <= upper

with w and the order of the rows as in `layout`: g_E are the defects f(s, u) - s_next, path equalities and terminal
equalities, g_I are path and terminal inequalities. Ipopt, SQP and the audit of a solution read it from here;
`kpirl_ocp.ocp.conditions.stage_derivatives` has the conditions stage by stage.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.problem.layout import (
    check_multipliers,
    equality_multipliers,
    given,
    inequality_multipliers,
    lengths,
    limits,
    live_equalities,
    unpack,
    unpack_multipliers,
)
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Guess, check_guess
from kpirl_ocp.types import Array, KKTResiduals, Mask, Multipliers, Solution, Status, Trajectory


@dataclass(frozen=True, eq=False)
class Program:
    """The nonlinear program of a problem, as CasADi functions of (w (n_w,), psi, c).

    symbols: w, psi, c.
    values: -> J, g_E (n_eq,), g_I (n_ineq,).
    first: also of (lambda (n_eq,), mu (n_ineq,)) -> gradient of J, and of J + lambda.g_E + mu.g_I, by w.
    live: (n_eq,) True for equalities that the schedule does not switch off.
    """

    symbols: list[ca.MX]
    values: ca.Function
    first: ca.Function
    live: Mask
    n_inequalities: int

    @property
    def n_equalities(self) -> int:
        """Number of live equalities."""
        return int(self.live.sum())

    @property
    def rows(self) -> ca.MX:
        """g, the live rows of g_E and then g_I: an expression of the symbols."""
        _, equalities, inequalities = self.values(*self.symbols)
        return ca.vertcat(selected(equalities, self.live), inequalities)

    @property
    def lower(self) -> Array:
        """Lower bounds of g, zero or minus infinity; the upper ones are all zero."""
        return np.repeat([0.0, -np.inf], [self.n_equalities, self.n_inequalities])

    def multipliers(self, known: Multipliers) -> Array:
        """(lambda, mu) of g."""
        return np.concatenate([equality_multipliers(known)[self.live], inequality_multipliers(known)])


@lru_cache(maxsize=64)
def transcribe(problem: OCP) -> Program:
    """Write the problem as a nonlinear program; cached per problem."""
    shape = (problem.n_states, problem.horizon + 1), (problem.n_actions, problem.horizon)
    w = ca.MX.sym("w", sum(rows * columns for rows, columns in shape))
    parts = ca.vertsplit(w, [0, shape[0][0] * shape[0][1], w.numel()])
    states, actions = (ca.reshape(part, *size) for part, size in zip(parts, shape, strict=True))
    psi, context = problem.symbols()[2:]
    point = states, actions, psi, context

    defects = problem.at_stages(problem.dynamics, *point) - states[:, 1:]
    equalities = [defects, problem.at_stages(problem.path_equality, *point)]
    inequalities = [problem.path(*point), problem.at_end(problem.terminal_inequality, *point)]
    equalities.append(problem.at_end(problem.terminal_equality, *point))
    g_E, g_I = (ca.vertcat(*map(ca.vec, rows)) for rows in (equalities, inequalities))
    objective = problem.cost(*point)

    lam, mu = ca.MX.sym("lambda", g_E.numel()), ca.MX.sym("mu", g_I.numel())
    lagrangian = objective + ca.dot(lam, g_E) + ca.dot(mu, g_I)
    slopes = [ca.densify(ca.gradient(value, w)) for value in (objective, lagrangian)]
    symbols = [w, psi, context]
    return Program(
        symbols=symbols,
        values=ca.Function("values", symbols, [ca.densify(x) for x in (objective, g_E, g_I)]),
        first=ca.Function("first", [*symbols, lam, mu], slopes),
        live=live_equalities(problem),
        n_inequalities=g_I.numel(),
    )


def selected(column: ca.MX, rows: Mask) -> ca.MX:
    """The rows of a column that a mask (n,) selects; (0, 1) if there are none."""
    return column[np.flatnonzero(rows).tolist()] if rows.any() else ca.MX(0, 1)


def limits_from(problem: OCP, s0: Array) -> tuple[Array, Array]:
    """Lower and upper bounds (n_w,) of w; for given entries of s_0 both equal s0 (n_s,)."""
    start = np.concatenate([s0, np.zeros(problem.horizon * (problem.n_states + problem.n_actions))])
    fixed = given(problem)
    lower, upper = (np.where(fixed, start, bound) for bound in limits(problem))
    return lower, upper


def starting_point(problem: OCP, s0: Array, psi: Array, context: Array, guess: Guess) -> Array:
    """w (n_w,) to start from: the guess, with given entries of s_0 replaced, or a rollout with zero actions.

    Raises ProblemError for a guess that is no trajectory of this problem, or has multipliers of other shapes.
    """
    check_guess(guess)
    if guess is None:
        start = problem.simulate(s0, np.zeros((problem.horizon, problem.n_actions)), psi, context)
    else:
        start = Trajectory(problem.as_states(guess.states), problem.as_actions(guess.actions))
    if isinstance(guess, Solution):
        check_multipliers(problem, guess.multipliers)
    first = np.where(problem.free_start, start.states[0], s0)
    return np.concatenate([first, start.states[1:].ravel(), start.actions.ravel()])


def not_started(
    problem: OCP, w: Array, psi: Array, context: Array, why: str, status: Status = Status.NOT_FINITE
) -> Solution:
    """The result of a solve that could not start from w (n_w,): the point itself, with NaN residuals."""
    multipliers = unpack_multipliers(problem, *(np.zeros(n) for n in lengths(problem)))
    unknown = KKTResiduals(np.nan, np.nan, np.nan, np.nan, 1.0)
    return Solution(unpack(problem, w), multipliers, np.nan, unknown, status, 0, psi, context, message=why)


def trajectory_of(problem: OCP, w: Array, s0: Array) -> Trajectory:
    """The trajectory of w (n_w,), with given entries of s_0 set exactly to s0."""
    trajectory = unpack(problem, w)
    trajectory.states[0] = np.where(problem.free_start, trajectory.states[0], s0)
    return trajectory
