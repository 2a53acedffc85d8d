"""The problem as one nonlinear program (multiple shooting) and its first- and second-order conditions.

    w = (s_1 .. s_T, u_0 .. u_{T-1}),   Lagrangian(w) = J + lambda . (f(s, u) - s_next) + mu . h + nu . w

with bounds on w whose multipliers nu are positive at an upper and negative at a lower bound. Everything that needs the
optimality conditions (Ipopt, the audit of a solution, the implicit gradient) reads them from here.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.problem import OCP
from kpirl_ocp.types import Array, Indices, KKTResiduals, Mask, Multipliers, Trajectory


@dataclass(frozen=True, eq=False)
class NLP:
    """The program of an OCP in CasADi functions of (w, s0, psi, c).

    n_w = T n_s + T n_u. values: -> objective, defects (T n_s,), path constraints (T n_h,).
    first: also (lambda, mu) -> gradient of J, gradient of J + lambda.defects + mu.path with respect to w.
    second: also (lambda, mu) -> Hessian of that Lagrangian, Jacobian of the defects, Jacobian of the path constraints.
    cross: also (lambda, mu, dw, dlambda, dmu) -> gradient with respect to psi of
        dw . grad_w Lagrangian + dlambda . defects + dmu . path.
    """

    symbols: dict[str, ca.MX]
    values: ca.Function
    first: ca.Function
    second: ca.Function
    cross: ca.Function
    lower: Array
    upper: Array
    n_defects: int


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
    successors = problem.dynamics.map(steps)(states[:, :steps], actions, ca.repmat(psi, 1, steps))
    defects = ca.vec(successors - states[:, 1:])
    path = ca.vec(problem.path(states, actions, psi, context))

    lam, mu = ca.MX.sym("lam", defects.numel()), ca.MX.sym("mu", path.numel())
    lagrangian = objective + ca.dot(lam, defects) + ca.dot(mu, path)
    hessian, gradient = ca.hessian(lagrangian, w)
    dw, dlam, dmu = ca.MX.sym("dw", w.numel()), ca.MX.sym("dlam", lam.numel()), ca.MX.sym("dmu", mu.numel())
    moved = ca.dot(dw, gradient) + ca.dot(dlam, defects) + ca.dot(dmu, path)

    point = [w, s0, psi, context]
    bounds = [np.concatenate([np.tile(s, steps), np.tile(u, steps)]) for s, u in _bound_pairs(problem)]
    return NLP(
        symbols={"w": w, "p": ca.vertcat(s0, psi, context), "s0": s0, "psi": psi, "c": context},
        values=ca.Function("values", point, [objective, defects, path]),
        first=ca.Function("first", [*point, lam, mu], [ca.gradient(objective, w), gradient]),
        second=ca.Function("second", [*point, lam, mu], [hessian, ca.jacobian(defects, w), ca.jacobian(path, w)]),
        cross=ca.Function("cross", [*point, lam, mu, dw, dlam, dmu], [ca.gradient(moved, psi)]),
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
    return Multipliers(
        dynamics=lam_g[:split].reshape(steps, problem.n_states),
        state=lam_w[:split].reshape(steps, problem.n_states),
        action=lam_w[split:].reshape(steps, problem.n_actions),
        path=lam_g[split:].reshape(steps, problem.n_path),
    )


def bound_multipliers(multipliers: Multipliers) -> Array:
    """nu (n_w,): multipliers of the bounds in the order of w."""
    return np.concatenate([multipliers.state.ravel(), multipliers.action.ravel()])


@dataclass(frozen=True)
class Inequalities:
    """All inequalities in one list, each as slack >= 0: finite lower bounds, finite upper bounds, path constraints.

    rows_lower, rows_upper: indices into w. slack, multiplier: (n_ineq,), multipliers >= 0 at a solution.
    equal: (n_ineq,) True where lower and upper bound coincide, so that the row is an equality.
    """

    rows_lower: Indices
    rows_upper: Indices
    slack: Array
    multiplier: Array
    equal: Mask

    @classmethod
    def at(cls, nlp: NLP, w: Array, path: Array, multipliers: Multipliers, barrier: float) -> Inequalities:
        """Evaluate slacks, and split each signed bound multiplier into one for either side.

        With a barrier both sides of a bound push, and only their difference is known: there they follow from the
        slack, z = tau / slack, and a disagreement shows up in the stationarity.
        """
        low, high = np.flatnonzero(np.isfinite(nlp.lower)), np.flatnonzero(np.isfinite(nlp.upper))
        nu, fixed = bound_multipliers(multipliers), nlp.lower == nlp.upper
        slack_low, slack_high = w[low] - nlp.lower[low], nlp.upper[high] - w[high]
        push_low = np.where(np.isfinite(nlp.upper[low]), np.maximum(-nu[low], 0.0), -nu[low])
        push_high = np.where(np.isfinite(nlp.lower[high]), np.maximum(nu[high], 0.0), nu[high])
        if barrier > 0:
            with np.errstate(divide="ignore"):
                push_low = np.where(fixed[low], push_low, barrier / slack_low)
                push_high = np.where(fixed[high], push_high, barrier / slack_high)
        return cls(
            rows_lower=low,
            rows_upper=high,
            slack=np.concatenate([slack_low, slack_high, -path]),
            multiplier=np.concatenate([push_low, push_high, multipliers.path.ravel()]),
            equal=np.concatenate([fixed[low], fixed[high], np.zeros(len(path), bool)]),
        )

    def push(self, n_w: int) -> Array:
        """Net multiplier (n_w,) of the bounds: upper minus lower."""
        force, split = np.zeros(n_w), len(self.rows_lower)
        force[self.rows_lower] -= self.multiplier[:split]
        force[self.rows_upper] += self.multiplier[split : split + len(self.rows_upper)]
        return force

    def jacobian(self, path_jacobian: Array) -> Array:
        """Jacobian (n_ineq, n_w) of the constraint values -slack, from that of the path constraints (T n_h, n_w)."""
        identity = np.eye(path_jacobian.shape[1])
        return np.vstack([-identity[self.rows_lower], identity[self.rows_upper], path_jacobian])


def audit(
    problem: OCP, psi: Array, context: Array, trajectory: Trajectory, multipliers: Multipliers, barrier: float = 0.0
) -> KKTResiduals:
    """Measure the first-order conditions at a point; NaN in any function gives NaN residuals."""
    nlp = transcribe(problem)
    w, s0 = pack(trajectory), trajectory.states[0]
    lam, mu = multipliers.dynamics.ravel(), multipliers.path.ravel()
    _, defects, path = (np.array(value).ravel() for value in nlp.values(w, s0, psi, context))
    cost_gradient, gradient = (np.array(value).ravel() for value in nlp.first(w, s0, psi, context, lam, mu))
    rows = Inequalities.at(nlp, w, path, multipliers, barrier)
    products = np.where(rows.equal, 0.0, rows.multiplier * rows.slack - barrier)
    return KKTResiduals(
        stationarity=largest(gradient + rows.push(len(w))),
        feasibility=max(largest(defects), largest(np.minimum(rows.slack, 0.0))),
        complementarity=largest(products),
        sign=largest(np.where(rows.equal, 0.0, np.minimum(rows.multiplier, 0.0))),
        scale=float(np.max([1.0, largest(cost_gradient), largest(lam), largest(mu)])),
    )


def largest(values: Array) -> float:
    """Largest absolute value, 0 for an empty array, NaN if there is one."""
    return float(np.max(np.abs(values), initial=0.0))
