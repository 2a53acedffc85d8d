"""The program of a problem with a given s_0, bounds and path constraints alone, for the conditions stage by stage.

    w = (s_1 .. s_T, u_0 .. u_{T-1}),   Lagrangian(w) = J + lambda . (f(s, u) - s_next) + mu . h + nu . w

with bounds on w whose multipliers nu are positive at an upper and negative at a lower bound. `program` has the one of
any problem.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, Indices, Mask, Multipliers, Trajectory


@dataclass(frozen=True, eq=False)
class NLP:
    """The program of an OCP in CasADi functions of (w, s0, psi, c).

    n_w = T n_s + T n_u. values: -> objective, defects (T n_s,), path constraints (T n_h,).
    first: also (lambda, mu) -> gradient of J, gradient of J + lambda.defects + mu.path with respect to w.
    """

    symbols: dict[str, ca.MX]
    values: ca.Function
    first: ca.Function
    lower: Array
    upper: Array
    n_defects: int

    @cached_property
    def bounded(self) -> Bounds:
        """All finite bounds of w."""
        low, high = np.flatnonzero(np.isfinite(self.lower)), np.flatnonzero(np.isfinite(self.upper))
        entries, limits = np.concatenate([low, high]), np.concatenate([self.lower[low], self.upper[high]])
        signs = np.repeat([-1.0, 1.0], [len(low), len(high)])
        twice = np.bincount(entries, minlength=len(self.lower))[entries] > 1
        return Bounds(entries, signs, limits, twice, (self.lower == self.upper)[entries], len(low))


@dataclass(frozen=True, eq=False)
class Bounds:
    """Finite lower bounds, then finite upper bounds, as signs * (limits - w[entries]) >= 0; all (n_bounds,).

    twice: True where the other side is bounded, too. equal: where it coincides. n_lower: how many are lower bounds.
    """

    entries: Indices
    signs: Array
    limits: Array
    twice: Mask
    equal: Mask
    n_lower: int

    def slack(self, w: Array) -> Array:
        """What is left (n_bounds,) at w (n_w,)."""
        return self.signs * (self.limits - w[self.entries])


@lru_cache(maxsize=64)
def transcribe(problem: OCP) -> NLP:
    """Write the problem as a nonlinear program; cached per problem."""
    steps, n_s, n_u = problem.horizon, problem.n_states, problem.n_actions
    w = ca.MX.sym("w", steps * (n_s + n_u))
    s0, psi, context = (
        ca.MX.sym("s0", n_s),
        ca.MX.sym("psi", problem.n_parameters),
        ca.MX.sym("c", problem.n_context),
    )
    states = ca.horzcat(s0, ca.reshape(w[: steps * n_s], n_s, steps))
    actions = ca.reshape(w[steps * n_s :], n_u, steps)

    objective = problem.cost(states, actions, psi, context)
    successors = problem.transition.map(steps)(states[:, :steps], actions, ca.repmat(psi, 1, steps))
    defects = ca.vec(successors - states[:, 1:])
    path = ca.vec(problem.path(states, actions, psi, context))

    lam, mu = ca.MX.sym("lam", defects.numel()), ca.MX.sym("mu", path.numel())
    lagrangian = objective + ca.dot(lam, defects) + ca.dot(mu, path)
    point = [w, s0, psi, context]
    bounds = [np.concatenate([s[1:].ravel(), u.ravel()]) for s, u in _bound_pairs(problem)]
    return NLP(
        symbols={"w": w, "p": ca.vertcat(s0, psi, context), "s0": s0, "psi": psi, "c": context},
        values=ca.Function("values", point, [objective, defects, path]),
        first=ca.Function("first", [*point, lam, mu], [ca.gradient(objective, w), ca.gradient(lagrangian, w)]),
        lower=bounds[0],
        upper=bounds[1],
        n_defects=defects.numel(),
    )


def _bound_pairs(problem: OCP) -> list[tuple[Array, Array]]:
    return [(np.asarray(s), np.asarray(u)) for s, u in zip(problem.state_bounds, problem.action_bounds, strict=True)]


def pack(trajectory: Trajectory) -> Array:
    """w (n_w,) of a trajectory."""
    return np.concatenate([trajectory.states[1:].ravel(), trajectory.actions.ravel()])


def unpack(problem: OCP, s0: Array, w: Array) -> Trajectory:
    """The trajectory of w (n_w,), with s0 in front."""
    split = problem.horizon * problem.n_states
    states = np.vstack([s0, w[:split].reshape(problem.horizon, problem.n_states)])
    return Trajectory(states, w[split:].reshape(problem.horizon, problem.n_actions))


def unpack_multipliers(problem: OCP, lam_w: Array, lam_g: Array) -> Multipliers:
    """Multipliers of bounds (n_w,) and of defects followed by path constraints, as named arrays."""
    steps, split = problem.horizon, problem.horizon * problem.n_states
    return Multipliers.of_given_start(
        dynamics=lam_g[:split].reshape(steps, problem.n_states),
        state=lam_w[:split].reshape(steps, problem.n_states),
        action=lam_w[split:].reshape(steps, problem.n_actions),
        path=lam_g[split:].reshape(steps, problem.n_path),
    )


def bound_multipliers(multipliers: Multipliers) -> Array:
    """nu (n_w,): multipliers of the bounds in the order of w."""
    return np.concatenate([multipliers.state[1:].ravel(), multipliers.action.ravel()])


@dataclass(frozen=True)
class Inequalities:
    """All inequalities in one list, each as slack >= 0: finite lower bounds, finite upper bounds, path constraints.

    slack: (n_ineq,). equal: (n_ineq,) True where lower and upper bound coincide, so that the row is an equality.
    """

    bounds: Bounds
    slack: Array
    equal: Mask

    @classmethod
    def at(cls, nlp: NLP, w: Array, path: Array) -> Inequalities:
        """The inequalities at w (n_w,), with path constraints (T n_h,) evaluated there."""
        bounds = nlp.bounded
        equal = np.concatenate([bounds.equal, np.zeros(len(path), bool)])
        return cls(bounds, np.concatenate([bounds.slack(w), -path]), equal)

    def forces(self, multipliers: Multipliers, barrier: float) -> Array:
        """Multipliers (n_ineq,), not negative at a solution: each signed bound multiplier split into its two sides.

        With a barrier both sides of a bound push, and only their difference is known: there they follow from the
        slack, tau / slack, and a disagreement shows up in the stationarity.
        """
        at = self.bounds
        forces = at.signs * bound_multipliers(multipliers)[at.entries]
        forces = np.where(at.twice, np.maximum(forces, 0.0), forces)
        if barrier > 0:
            with np.errstate(divide="ignore"):
                forces = np.where(at.equal, forces, barrier / self.slack[: len(forces)])
        return np.concatenate([forces, multipliers.path.ravel()])

    def push(self, forces: Array, n_w: int) -> Array:
        """Net force (n_w,) of the bounds: upper minus lower."""
        at = self.bounds
        return np.bincount(at.entries, at.signs * forces[: len(at.entries)], n_w).astype(float)


def bounded_entries(problem: OCP) -> tuple[Indices, Array]:
    """The entries of w (n_bounds,) that have a finite lower bound, then a finite upper one, and signs -1 and 1."""
    bounds = transcribe(problem).bounded
    return bounds.entries, bounds.signs
