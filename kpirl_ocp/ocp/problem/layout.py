"""The order of unknowns and multipliers in flat vectors. In arrays time comes first, as everywhere outside CasADi.

    w      = (s_0 .. s_T, u_0 .. u_{T-1})
    lambda = (dynamics, path_equality, terminal_equality)      of the equalities
    mu     = (path, terminal)                                  of the inequalities, each row <= 0
    nu     = (state, action)                                   of the bounds on w, in the order of w

Functions of stages take the unknowns in the order of time, x = (s_0, u_0, s_1, .., u_{T-1}, s_T), see `by_stage`.

s_0 is part of w whether it is given or not: a given entry has both bounds at its value.
"""

from __future__ import annotations

from itertools import accumulate

import numpy as np

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, Mask, Multipliers, Trajectory


def pack(trajectory: Trajectory) -> Array:
    """A trajectory as the flat vector w (n_w,)."""
    return np.concatenate([trajectory.states.ravel(), trajectory.actions.ravel()])


def unpack(problem: OCP, w: Array) -> Trajectory:
    """The flat vector w (n_w,) as a trajectory."""
    return Trajectory(*_split(w, (problem.horizon + 1, problem.n_states), (problem.horizon, problem.n_actions)))


def limits(problem: OCP) -> tuple[Array, Array]:
    """Lower and upper bounds (n_w,) of w; infinite for the entries of s_0 that are given."""
    pairs = zip(problem.limits, problem.action_bounds, strict=True)
    lower, upper = (np.concatenate([states.ravel(), np.asarray(actions).ravel()]) for states, actions in pairs)
    return lower, upper


def given(problem: OCP) -> Mask:
    """(n_w,) True for the entries of s_0 that are given."""
    mask = np.zeros((problem.horizon + 1) * problem.n_states + problem.horizon * problem.n_actions, bool)
    mask[: problem.n_states] = ~problem.free_start
    return mask


def equality_multipliers(multipliers: Multipliers) -> Array:
    """Multipliers of equalities as the flat vector lambda (n_eq,)."""
    parts = (multipliers.dynamics, multipliers.path_equality, multipliers.terminal_equality)
    return np.concatenate([part.ravel() for part in parts])


def inequality_multipliers(multipliers: Multipliers) -> Array:
    """Multipliers of inequalities as the flat vector mu (n_ineq,)."""
    return np.concatenate([multipliers.path.ravel(), multipliers.terminal.ravel()])


def bound_multipliers(multipliers: Multipliers) -> Array:
    """Multipliers of bounds as the flat vector nu (n_w,)."""
    return np.concatenate([multipliers.state.ravel(), multipliers.action.ravel()])


def unpack_multipliers(problem: OCP, nu: Array, lam: Array, mu: Array) -> Multipliers:
    """The multipliers of bounds, equalities and inequalities as named arrays.

    Zero for given entries of s_0. lam may hold the multipliers of live rows alone; then those of the others are zero.
    """
    lam = _spread(lam, live_equalities(problem))
    steps = problem.horizon
    bounds = unpack(problem, np.where(given(problem), 0.0, nu))
    dynamics, path_equality, terminal_equality = _split(
        lam, (steps, problem.n_states), (steps, problem.n_path_equality), (problem.n_terminal_equality,)
    )
    path, terminal = _split(mu, (steps, problem.n_path), (problem.n_terminal,))
    return Multipliers(
        dynamics=dynamics,
        state=bounds.states,
        action=bounds.actions,
        path=path,
        path_equality=path_equality,
        terminal=terminal,
        terminal_equality=terminal_equality,
    )


def multiplier_shapes(problem: OCP) -> dict[str, tuple[int, ...]]:
    """Shapes of the arrays of `Multipliers`, by name."""
    steps = problem.horizon
    return {
        "dynamics": (steps, problem.n_states),
        "state": (steps + 1, problem.n_states),
        "action": (steps, problem.n_actions),
        "path": (steps, problem.n_path),
        "terminal": (problem.n_terminal,),
        "path_equality": (steps, problem.n_path_equality),
        "terminal_equality": (problem.n_terminal_equality,),
    }


def check_multipliers(problem: OCP, multipliers: Multipliers, of: str = "guess") -> None:
    """Raise ProblemError when the shapes of multipliers, such as those of a guess, do not fit the problem."""
    for name, shape in multiplier_shapes(problem).items():
        given = np.shape(getattr(multipliers, name))
        if given != shape:
            raise ProblemError(f"the {of}'s multipliers.{name} must be {shape}, got {given}: it is of another problem.")


def live_equalities(problem: OCP) -> Mask:
    """(n_eq,) True for the entries of lambda whose rows the schedule does not switch off, see `OCP.live`."""
    dynamics = np.ones(problem.horizon * problem.n_states, bool)
    return np.concatenate([dynamics, problem.live.path_equality.ravel(), problem.live.terminal_equality])


def n_inequalities(problem: OCP) -> int:
    """n_ineq, the length of mu."""
    return problem.horizon * problem.n_path + problem.n_terminal


def lengths(problem: OCP) -> tuple[int, int, int]:
    """The lengths n_w, n_eq and n_ineq of w, lambda and mu."""
    return len(given(problem)), len(live_equalities(problem)), n_inequalities(problem)


def by_stage(states: Array, actions: Array) -> Array:
    """States (.., T+1, n_s) and actions (.., T, n_u) as vectors (.., n_w) = (s_0, u_0, s_1, .., u_{T-1}, s_T)."""
    (*many, T, n_u), n_s = actions.shape, states.shape[-1]
    x = np.empty((*many, T + 1, n_s + n_u))
    x[..., :n_s], x[..., :-1, n_s:] = states, actions
    return np.ascontiguousarray(x.reshape(*many, (T + 1) * (n_s + n_u))[..., : T * (n_s + n_u) + n_s])


def split(x: Array, steps: int, n_s: int, n_u: int) -> tuple[Array, Array]:
    """The inverse of `by_stage`: states (T+1, n_s) and actions (T, n_u)."""
    rows, states = x[: steps * (n_s + n_u)].reshape(steps, n_s + n_u), np.empty((steps + 1, n_s))
    states[:-1], states[-1] = rows[:, :n_s], x[steps * (n_s + n_u) :]
    return states, rows[:, n_s:].copy()


def _spread(values: Array, live: Mask) -> Array:
    """Values (n,) or those of the live rows, as (n,)."""
    if len(values) == len(live):
        return values
    spread = np.zeros(len(live))
    spread[live] = values
    return spread


def _split(vector: Array, *shapes: tuple[int, ...]) -> list[Array]:
    ends = list(accumulate(int(np.prod(shape)) for shape in shapes))
    return [vector[end - int(np.prod(shape)) : end].reshape(shape) for shape, end in zip(shapes, ends, strict=True)]
