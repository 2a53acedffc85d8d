"""The program of a problem with a given s_0, bounds and path constraints alone, for the conditions stage by stage.

    w = (s_1 .. s_T, u_0 .. u_{T-1}),   Lagrangian(w) = J + lambda . (f(s, u) - s_next) + mu . h + nu . w

with bounds on w whose multipliers nu are positive at an upper and negative at a lower bound. `program` has the one of
any problem.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.problem import layout
from kpirl_ocp.ocp.problem.constraints import BoundRows
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, Multipliers, Trajectory


@dataclass(frozen=True, eq=False)
class NLP:
    """The program of an OCP in CasADi functions of (w, s0, psi, c).

    n_w = T n_s + T n_u. values: -> objective, defects (T n_s,), path constraints (T n_h,).
    lower, upper: bounds (n_w,). n_defects: T n_s.
    """

    symbols: dict[str, ca.MX]
    values: ca.Function
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
    successors = problem.transition.map(steps)(states[:, :steps], actions, ca.repmat(psi, 1, steps))
    defects = ca.vec(successors - states[:, 1:])
    path = ca.vec(problem.path(states, actions, psi, context))

    point = [w, s0, psi, context]
    lower, upper = (bound[n_s:] for bound in layout.limits(problem))
    return NLP(
        symbols={"w": w, "p": ca.vertcat(s0, psi, context), "s0": s0, "psi": psi, "c": context},
        values=ca.Function("values", point, [objective, defects, path]),
        lower=lower,
        upper=upper,
        n_defects=defects.numel(),
    )


def pack(trajectory: Trajectory) -> Array:
    """w (n_w,) of a trajectory."""
    return layout.pack(trajectory)[trajectory.states.shape[1] :]


def unpack(problem: OCP, s0: Array, w: Array) -> Trajectory:
    """The trajectory of w (n_w,), with s0 in front."""
    return layout.unpack(problem, np.concatenate([s0, w]))


def bound_multipliers(multipliers: Multipliers) -> Array:
    """nu (n_w,): multipliers of the bounds in the order of w."""
    return layout.bound_multipliers(multipliers)[multipliers.state.shape[1] :]


@lru_cache(maxsize=64)
def bound_rows(problem: OCP) -> BoundRows:
    """The finite bounds of w (n_w,)."""
    return BoundRows.of(*(bound[problem.n_states :] for bound in layout.limits(problem)))
