"""Fatrop on the stage-ordered program (Vanroye, Sathya, De Schutter and Decre, 2023): another structured solver.

Unknowns x = (s_0, u_0, s_1, u_1, .. s_T); constraints stage by stage, in the order that CasADi's interface asks for:
s_{t+1} - f(s_t, u_t) = 0, at t = 0 the given s_0, then h(s_t, u_t) <= 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.conditions.audit import audit
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.scope import refuse_features
from kpirl_ocp.ocp.problem.solver import Guess, guess_actions
from kpirl_ocp.types import Array, Mask, Multipliers, Solution, Status, Trajectory

_STATUS = {
    "SOLVER_RET_SUCCESS": Status.CONVERGED,
    "SOLVER_RET_LIMITED": Status.ITERATION_LIMIT,
    "SOLVER_RET_INFEASIBLE": Status.INFEASIBLE,
    "SOLVER_RET_NAN": Status.NOT_FINITE,
}


@dataclass(frozen=True)
class Fatrop:
    """Interior-point solver with exact Hessian on the stage structure; bounds and path constraints.

    A guess hands over its states and actions; Fatrop does not take multipliers. It moves every bound outwards by 1e-8
    (a setting that CasADi does not pass on), and the residuals show that: `Riccati` and `Ipopt` are more accurate.

    tolerance: Fatrop's own.
    max_iterations: before it gives up.
    """

    tolerance: float = 1e-8
    max_iterations: int = 500

    def __post_init__(self) -> None:
        if not self.tolerance > 0 or self.max_iterations < 1:
            raise ProblemError("Fatrop needs tolerance > 0 and max_iterations >= 1.")

    def solve(
        self, problem: OCP, s0: ArrayLike, psi: ArrayLike = (), context: ArrayLike = (), guess: Guess = None
    ) -> Solution:
        """Solve; see `Solver.solve`."""
        start, psi, context = problem.inputs(s0, psi, context)
        refuse_features(problem, "Fatrop")
        solver, equality = _build(problem, self)
        if guess is None:
            guess = problem.simulate(start, guess_actions(problem, None), psi)
        lower, upper = (_in_stages(np.vstack([free, side[0]]), side[1]) for free, side in _bounds(problem))
        result = solver(
            x0=_in_stages(problem.as_states(guess.states), problem.as_actions(guess.actions)),
            p=np.concatenate([start, psi, context]),
            lbx=lower,
            ubx=upper,
            lbg=np.where(equality, 0.0, -np.inf),
            ubg=0.0,
        )
        return self._solution(problem, start, psi, context, result, solver.stats(), equality)

    def _solution(
        self,
        problem: OCP,
        s0: Array,
        psi: Array,
        context: Array,
        result: dict[str, ca.DM],
        stats: dict[str, object],
        equality: Mask,
    ) -> Solution:
        states, actions = _by_kind(problem, np.array(result["x"]).ravel())
        trajectory = Trajectory(np.vstack([s0, states[1:]]), actions)
        on_states, on_actions = _by_kind(problem, np.array(result["lam_x"]).ravel())
        forces = np.array(result["lam_g"]).ravel()
        rows = np.where(equality)[0].reshape(problem.horizon + 1, problem.n_states)  # of stage 0 twice: f, then s_0
        multipliers = Multipliers.of_given_start(
            dynamics=-forces[np.delete(rows, 1, axis=0)],  # the constraint is s_next - f
            state=on_states[1:],
            action=on_actions,
            path=forces[~equality].reshape(problem.horizon, problem.n_path),
        )
        residuals = audit(problem, psi, context, trajectory, multipliers)
        word = str(stats.get("unified_return_status", "SOLVER_RET_UNKNOWN"))
        limited = int(str(stats.get("iter_count", 0))) >= self.max_iterations and not stats["success"]
        status = Status.ITERATION_LIMIT if limited else _STATUS.get(word, Status.FAILED)
        if not np.isfinite(residuals.worst):
            status = Status.NOT_FINITE
        return Solution(
            trajectory=trajectory,
            multipliers=multipliers,
            objective=float(result["f"]),
            residuals=residuals,
            status=status,
            iterations=int(str(stats.get("iter_count", 0))),
            psi=psi,
            context=context,
            message=f"Fatrop: {word}",
        )


def _bounds(problem: OCP) -> list[tuple[Array, tuple[Array, Array]]]:
    """Lower, then upper: infinite for s_0, and the bounds of s_1 .. s_T and of the actions."""
    pairs = zip(problem.limits, problem.action_bounds, strict=True)
    sides = [(states[1:], np.asarray(actions)) for states, actions in pairs]
    return [(np.full(problem.n_states, sign * np.inf), side) for sign, side in zip((-1, 1), sides, strict=True)]


def _in_stages(states: Array, actions: Array) -> Array:
    """x = (s_0, u_0, .. s_T) of (T+1, n_s) and (T, n_u)."""
    return np.concatenate([np.hstack([states[:-1], actions]).ravel(), states[-1]])


def _by_kind(problem: OCP, x: Array) -> tuple[Array, Array]:
    """The inverse of `_in_stages`."""
    n_s = problem.n_states
    stages = x[:-n_s].reshape(problem.horizon, -1)
    return np.vstack([stages[:, :n_s], x[-n_s:]]), stages[:, n_s:]


@lru_cache(maxsize=64)
def _build(problem: OCP, solver: Fatrop) -> tuple[ca.Function, Mask]:
    """The solver, and which constraints are equalities."""
    steps, n_s, n_u = problem.horizon, problem.n_states, problem.n_actions
    x = ca.MX.sym("x", steps * (n_s + n_u) + n_s)
    stages = ca.reshape(x[: steps * (n_s + n_u)], n_s + n_u, steps)
    states, actions = ca.horzcat(stages[:n_s, :], x[steps * (n_s + n_u) :]), stages[n_s:, :]
    s0, psi = ca.MX.sym("s0", n_s), ca.MX.sym("psi", problem.n_parameters)
    context = ca.MX.sym("c", problem.n_context)
    gaps = states[:, 1:] - problem.transition.map(steps)(states[:, :steps], actions, ca.repmat(psi, 1, steps))
    path = problem.path(states, actions, psi, context)
    start = [states[:, 0] - s0]
    rows = [ca.vertcat(gaps[:, t], *(start if t == 0 else []), path[:, t]) for t in range(steps)]
    equality = np.concatenate(
        [np.repeat([True, False], [n_s * (2 if t == 0 else 1), problem.n_path]) for t in range(steps)]
    )
    program = {
        "x": x,
        "p": ca.vertcat(s0, psi, context),
        "f": problem.cost(states, actions, psi, context),
        "g": ca.vertcat(*rows),
    }
    options = {
        "structure_detection": "auto",
        "equality": equality.tolist(),
        "fatrop": {"tol": solver.tolerance, "max_iter": solver.max_iterations, "print_level": 0},
        "print_time": False,
        "show_eval_warnings": False,
    }
    return ca.nlpsol("fatrop", "fatrop", program, options), equality
