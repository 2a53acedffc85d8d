"""All constraints of a problem but its dynamics, as one list of rows.

The order is: finite lower bounds of w = (s_0 .. s_T, u_0 .. u_{T-1}), finite upper bounds, h stage by stage, g_T, e
stage by stage, e_T. Unknowns are in the order of time, x = (s_0, u_0, s_1, .., s_T).
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from kpirl_ocp.ocp.conditions.structure import quadratic_program
from kpirl_ocp.ocp.interior_point import library as c
from kpirl_ocp.ocp.interior_point.core import dimensions_of
from kpirl_ocp.ocp.problem.constraints import BoundRows
from kpirl_ocp.ocp.problem.layout import by_stage, limits, live_equalities, n_inequalities, unpack
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, Indices, Mask


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows of a problem, and which of its unknowns are decisions.

    bounds: of x; their `entries` are indices into x. free: indices of the free entries of s_0.
    inequality: (n_rows,) True for rows that may be active or not. equality: (n_rows,) True for rows that always are.
    Rows that are switched off, and the upper one of two equal bounds, are neither.
    """

    problem: OCP
    bounds: BoundRows
    free: Indices
    inequality: Mask
    equality: Mask

    @property
    def n_bounds(self) -> int:
        """Number of rows that are bounds."""
        return len(self.bounds.entries)

    @property
    def n_x(self) -> int:
        """Number of entries of x at one stage, n_s + n_u."""
        return self.problem.n_states + self.problem.n_actions

    @cached_property
    def decisions(self) -> Indices:
        """(n_decisions,) indices into x of the free entries of s_0, then of the actions."""
        steps, n_s = np.arange(self.problem.horizon)[:, None], self.problem.n_states
        actions = steps * self.n_x + np.arange(n_s, self.n_x)
        return np.concatenate([self.free, actions.ravel()]).astype(np.intp)

    def split(self, values: Array) -> tuple[Array, Array, Array]:
        """Split values (n_rows,) into those of the bounds, those of h and g_T, and those of e and e_T."""
        end = self.n_bounds + self.problem.horizon * self.problem.n_path + self.problem.n_terminal
        return values[: self.n_bounds], values[self.n_bounds : end], values[end:]

    @cached_property
    def largest_bound(self) -> Array:
        """(n_w,) the largest absolute value of finite bounds on each entry of x, zero where there is none."""
        largest = np.zeros(self.problem.horizon * self.n_x + self.problem.n_states)
        np.maximum.at(largest, self.bounds.entries, np.abs(self.bounds.limits))
        return largest

    @cached_property
    def dimensions(self) -> Any:
        """The structure with the dimensions of the problem, for the C code."""
        return dimensions_of(self.problem)

    @cached_property
    def structure(self) -> Any:
        """The structure `kpirl_mpc_rows`. It keeps its arrays alive, and must live as long as its address is used."""
        rows = c.Rows(n_free=len(self.free), n_bounds=self.n_bounds, n_decisions=len(self.decisions))
        rows.quadratic = quadratic_program(self.problem)
        arrays = self._arrays()
        for name, array in arrays.items():
            setattr(rows, name, array.ctypes.data)
        rows.arrays = arrays
        return rows

    def _arrays(self) -> dict[str, Any]:
        """Contents of the structure. The random numbers depend only on the size of the problem."""
        n_w, m, bounds = len(self.largest_bound), len(self.inequality), self.bounds
        longest = max(n_w, m, self.problem.n_parameters, self.problem.n_context)
        integers: dict[str, Any] = {"free": self.free, "entries": bounds.entries, "decisions": self.decisions}
        integers |= {"inequality": self.inequality, "equality": self.equality, "other": bounds.other}
        reals = {"signs": bounds.signs, "limits": bounds.limits, "largest_bound": self.largest_bound}
        normal, uniform, sides = (np.random.default_rng(0) for _ in range(3))
        reals |= {"normal": normal.normal(size=max(n_w, m)), "uniform": uniform.uniform(0.5, 1.0, longest)}
        reals["spread"] = sides.choice([-1.0, 1.0], n_w) * reals["uniform"][:n_w]
        return {name: np.ascontiguousarray(x, np.intc) for name, x in integers.items()} | {
            name: np.ascontiguousarray(x, float) for name, x in reals.items()
        }

    @property
    def uniform(self) -> Array:
        """Random numbers in [1/2, 1), as many as the longest vector of the problem has entries."""
        found: Array = self.structure.arrays["uniform"]
        return found

    def sizes_of(self, x: Array) -> Array:
        """(n_w,) the largest absolute value over the horizon of each entry of x, and of its finite bounds."""
        sizes, given = np.empty(len(x)), np.ascontiguousarray(x, float)
        kept = self.dimensions, self.structure
        addresses = (ctypes.addressof(part) for part in kept)
        c.library().kpirl_mpc_point_sizes(*addresses, given.ctypes.data, sizes.ctypes.data)
        return sizes

    @cached_property
    def n_memory(self) -> int:
        """Length of the array that `kpirl_mpc_kkt_init` takes as memory."""
        kept = c.KKT(), self.dimensions, self.structure
        return int(c.library().kpirl_mpc_kkt_init(*(ctypes.addressof(part) for part in kept), None))


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
