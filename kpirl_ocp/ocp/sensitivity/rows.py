"""The constraints of a problem but its dynamics, in one list of rows.

Finite lower bounds of w = (s_0 .. s_T, u_0 .. u_{T-1}), finite upper bounds, h stage by stage, g_T, e stage by stage,
e_T. Unknowns are in the order of time, x = (s_0, u_0, s_1, .., s_T).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from kpirl_ocp.ocp.problem.constraints import BoundRows
from kpirl_ocp.ocp.problem.layout import by_stage, limits, live_equalities, n_inequalities, unpack
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, Indices, Mask


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of a problem, and which of its unknowns are decisions.

    bounds: with entries of x. free: entries of s_0 that are decisions.
    inequality: (n_rows,) True for rows that may be active or not. equality: (n_rows,) True for those that always are.
    Rows that are switched off, and the second side of coinciding bounds, are neither.
    """

    problem: OCP
    bounds: BoundRows
    free: Indices
    inequality: Mask
    equality: Mask

    @property
    def n_bounds(self) -> int:
        """Rows of bounds."""
        return len(self.bounds.entries)

    @property
    def n_x(self) -> int:
        """Entries of x at one stage."""
        return self.problem.n_states + self.problem.n_actions

    @cached_property
    def decisions(self) -> Indices:
        """(n_decisions,) entries of x: free ones of s_0, then actions."""
        steps, n_s = np.arange(self.problem.horizon)[:, None], self.problem.n_states
        actions = steps * self.n_x + np.arange(n_s, self.n_x)
        return np.concatenate([self.free, actions.ravel()]).astype(np.intp)

    def split(self, values: Array) -> tuple[Array, Array, Array]:
        """Of the bounds, of h and g_T, and of e and e_T."""
        end = self.n_bounds + self.problem.horizon * self.problem.n_path + self.problem.n_terminal
        return values[: self.n_bounds], values[self.n_bounds : end], values[end:]

    @cached_property
    def largest_bound(self) -> Array:
        """(n_w,) the largest finite bound of each entry of x, zero where there is none."""
        largest = np.zeros(self.problem.horizon * self.n_x + self.problem.n_states)
        np.maximum.at(largest, self.bounds.entries, np.abs(self.bounds.limits))
        return largest

    def largest_of_kind(self, values: Array) -> Array:
        """(n_w,) of values (n_w,) >= 0 the largest over the horizon, of every state and action."""
        n_s = self.problem.n_states
        stages, last = values[:-n_s].reshape(-1, self.n_x), values[-n_s:]
        largest = stages.max(axis=0, initial=0.0)
        largest[:n_s] = np.maximum(largest[:n_s], last)
        return np.concatenate([np.tile(largest, len(stages)), largest[:n_s]])


@lru_cache(maxsize=64)
def rows_of(problem: OCP) -> Rows:
    """The rows of a problem."""
    listed = BoundRows.of(*limits(problem))
    place = np.empty(len(limits(problem)[0]), np.intp)
    w = unpack(problem, np.arange(len(place), dtype=float))
    place[by_stage(w.states, w.actions).astype(np.intp)] = np.arange(len(place))
    live_e = live_equalities(problem)[problem.horizon * problem.n_states :]
    all_h = np.ones(n_inequalities(problem), bool)
    first_side = np.arange(len(listed.equal)) < listed.n_lower
    return Rows(
        problem=problem,
        bounds=replace(listed, entries=place[listed.entries]),
        free=np.flatnonzero(problem.free_start),
        inequality=np.concatenate([~listed.equal, all_h, np.zeros(len(live_e), bool)]),
        equality=np.concatenate([listed.equal & first_side, ~all_h, live_e]),
    )
