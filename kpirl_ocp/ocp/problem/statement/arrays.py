"""Arrays of users in the shapes that a problem has."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.ocp.problem.statement.checks import matrix, vector
from kpirl_ocp.ocp.problem.statement.dimensions import Dimensions
from kpirl_ocp.types import Array, Solution, Trajectory


class Arrays(Dimensions):
    """Checks at the edge of an `OCP`; states and actions that a statement has added may be missing."""

    horizon: int

    def inputs(self, s0: ArrayLike, psi: ArrayLike, context: ArrayLike) -> tuple[Array, Array, Array]:
        """The three as float64 vectors; s0 with or without added states. Raises ProblemError when a length is wrong."""
        start = vector("s0", s0, self.n_stated_states, self.n_states)
        missing = self.additions.states[len(start) - self.n_stated_states :]
        return (
            np.concatenate([start, missing]) if len(missing) else start,
            vector("psi", psi, self.n_parameters),
            vector("context", context, self.n_context),
        )

    def as_actions(self, actions: ArrayLike) -> Array:
        """Actions as a float64 array (T, n_u), with added ones zero if they are missing. ProblemError for others."""
        stated, whole = (self.horizon, self.n_stated_actions), (self.horizon, self.n_actions)
        array = matrix("actions", "(T, n_u)", actions, stated, whole)
        if array.shape == whole:
            return array.copy()
        return np.pad(array, ((0, 0), (0, self.n_actions - array.shape[1])))

    def as_states(self, states: ArrayLike) -> Array:
        """States as a float64 array (T+1, n_s), with or without added ones. ProblemError for another shape."""
        stated, whole = (self.horizon + 1, self.n_stated_states), (self.horizon + 1, self.n_states)
        array = matrix("states", "(T+1, n_s)", states, stated, whole)
        if array.shape == whole:
            return array.copy()
        missing = self.additions.states[array.shape[1] - self.n_stated_states :]
        return np.hstack([array, np.tile(missing, (len(array), 1))])

    def stated(self, plan: Solution | Trajectory) -> Trajectory:
        """The trajectory without added states and actions."""
        return Trajectory(plan.states[:, : self.n_stated_states], plan.actions[:, : self.n_stated_actions])

    def static_of(self, plan: Solution | Trajectory) -> Array:
        """The static decisions (n_q,)."""
        return plan.states[0, self.n_stated_states :][: len(self.additions.static)].copy()
