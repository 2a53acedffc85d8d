"""The linear algebra of a KKT system, in C: `ocp/interior_point/c/kpirl_mpc_system.h`."""

from __future__ import annotations

import ctypes
from functools import cached_property
from typing import Any

import numpy as np

from kpirl_ocp.ocp.interior_point import library as c
from kpirl_ocp.ocp.problem.solver import StageDerivatives
from kpirl_ocp.ocp.sensitivity.rows import Rows
from kpirl_ocp.types import Array, Mask

_KEPT = ("free", "entries", "decisions")


class LinearSystem:
    """H, F and rows at a point, with an active set; and memory for its factors."""

    def __init__(self, rows: Rows, derivatives: StageDerivatives, sizes: Array) -> None:
        """sizes: (n_w,) what the entries of x are measured by."""
        self._library, self._rows, problem, self.sizes = c.library(), rows, rows.problem, sizes
        self._shape = len(sizes), problem.horizon * problem.n_states, len(rows.inequality), problem.n_states
        self._arrays: dict[str, Any] = {
            name: np.ascontiguousarray(array, np.intc)
            for name, array in zip(_KEPT, (rows.free, rows.bounds.entries, rows.decisions), strict=True)
        }
        self._system = c.System(
            horizon=problem.horizon,
            n_states=problem.n_states,
            n_actions=problem.n_actions,
            n_path=problem.n_path,
            n_equality=problem.n_path_equality,
            n_terminal=problem.n_terminal,
            n_terminal_equality=problem.n_terminal_equality,
            n_free=len(rows.free),
            n_bounds=rows.n_bounds,
            n_decisions=len(rows.decisions),
        )
        self._keep(signs=rows.bounds.signs, sizes=sizes)
        self._keep(**{name: getattr(derivatives, name) for name in ("F", "G", "E", "H")})
        self._keep(scratch=np.empty(self._call("system_scratch")))
        for name in _KEPT:
            setattr(self._system, name, self._arrays[name].ctypes.data)

    def select(self, active: Mask, sigma: Array) -> None:
        """Choose the active rows (n_rows,) and the stiffness of smoothed ones (n_rows,)."""
        self._keep(active=active.astype(float), sigma=sigma)

    @property
    def duals(self) -> tuple[int, int]:
        """Numbers of costates and of rows."""
        return self._shape[1:3]

    @property
    def scale(self) -> float:
        """The largest |eigenvalue| of the reduced Hessian, after `factor`."""
        return float(self._system.scale)

    @property
    def pivots(self) -> Array:
        """Of the factors; as many are negative as the reduced Hessian has negative eigenvalues."""
        return np.concatenate([self._arrays["pivots"], self._arrays["free_pivots"]])

    @cached_property
    def row_sizes(self) -> Array:
        """(n_rows,) what a slack is compared with."""
        return self._filled("row_sizes", self._shape[2])

    @cached_property
    def curvature(self) -> Array:
        """(n_w,) an upper bound of what each entry of x has within its own and the next stage."""
        return self._filled("system_curvature", self._shape[0])

    def relative_slacks(self, slack: Array) -> Array:
        """Slacks (n_rows,) over the sizes of what they are made of."""
        size = self.row_sizes
        return np.where(size > 0, slack / np.where(size > 0, size, 1.0), np.where(slack > 0, np.inf, slack))

    def relative_forces(self, forces: Array, costates: Array) -> Array:
        """Forces (n_rows,) over the others on one of the entries of x that they act on."""
        shares = self._filled("force_shares", self._shape[2], costates, self.curvature)
        with np.errstate(invalid="ignore"):
            return np.where(forces == 0, 0.0, forces * shares)

    def times(self, x: Array) -> Array:
        """rows x (n_rows,)."""
        return self._filled("rows_times", self._shape[2], x)

    def transposed_times(self, forces: Array) -> Array:
        """rows' forces (n_w,)."""
        pushed = np.zeros(self._shape[0])
        self._call("rows_push", forces, pushed)
        return pushed

    def balance(self, point: list[Array]) -> Array:
        """(H + C' sigma C) x + A' lambda + C' mu (n_w,) of (x, costates, forces), given entries of s_0 included."""
        triple, _kept = self._triple(point)
        return self._filled("system_balance", self._shape[0], triple)

    def decision_norm(self, x: Array) -> float:
        """Length of the decisions in x (n_w,), by their roots."""
        return float(self._call("decision_norm", x))

    def factor(self, roots: Array, start: Array) -> bool:
        """Factorise with decisions in units (n_decisions,) of 1 / roots; start: (n_decisions,) random numbers.

        Returns whether no decision moves some active row.
        """
        self._keep(roots=roots, lengths=np.ones(self._shape[2]), stiffness=np.zeros(self._shape[2]))
        self._arrays |= self._new_factors()
        return bool(self._call("system_factor", start))

    def solve(self, right: list[Array], enough: float, most: int) -> tuple[list[Array], float]:
        """(x, costates, forces) for (r, d, c, given entries of s_0), and the relative residual."""
        triple, _kept = self._triple(right)
        point = [np.empty(size) for size in self._shape[:3]]
        result, _also_kept = self._triple(point)
        return point, float(self._call("system_solve", triple, enough, most, result))

    def change(self, nearby: LinearSystem, r: Array, point: list[Array]) -> float:
        """Relative change of x, which solves (r, 0, 0) here, for the system nearby; infinite if not found."""
        _, n_c, m, n_s = self._shape
        right, _kept = self._triple([r, np.zeros(n_c), np.zeros(m), np.zeros(n_s)])
        moving, _also_kept = self._triple([array.copy() for array in point])
        nearby._keep(**{name: self._arrays[name] for name in ("lengths", "stiffness", "roots")})
        return float(self._call("system_change", ctypes.addressof(nearby._system), right, moving))

    def softest(self, negative: bool, start: Array) -> tuple[float, Array]:
        """The highest, or lowest negative, eigenvalue of the reduced Hessian's inverse, and its direction (n_w,)."""
        direction = np.empty(self._shape[0])
        return float(self._call("system_softest", int(negative), start, direction)), direction

    def qualification(self, start: Array) -> float:
        """The smallest singular value of the active rows; start: (n_rows,) random numbers."""
        _other = self._new_factors()
        found = float(self._call("system_qualification", start))
        for name in _other:
            setattr(self._system.factors, name, self._arrays[name].ctypes.data)
        return found

    def _new_factors(self) -> dict[str, Array]:
        """Memory that the next factors go to."""
        problem, n_free = self._rows.problem, len(self._rows.free)
        T, n_s, n_u = problem.horizon, problem.n_states, problem.n_actions
        sizes = {"P": (T + 1) * n_s**2, "W": T * n_u**2, "Y": T * n_u * n_s, "pivots": T * n_u}
        sizes |= {"free_W": n_free**2, "free_pivots": n_free}
        arrays = {name: np.empty(size) for name, size in sizes.items()}
        for name, array in arrays.items():
            setattr(self._system.factors, name, array.ctypes.data)
        return arrays

    def _keep(self, **arrays: Array) -> None:
        for name, array in arrays.items():
            self._arrays[name] = np.ascontiguousarray(array, float)
            setattr(self._system, name, self._arrays[name].ctypes.data)

    def _triple(self, arrays: list[Array]) -> tuple[int, Any]:
        """The address of a structure, and what must be kept as long."""
        kept = [np.ascontiguousarray(array, float) for array in arrays]
        triple = c.Triple(*(array.ctypes.data for array in kept))
        return ctypes.addressof(triple), (triple, kept)

    def _filled(self, name: str, size: int, *arguments: Array | int) -> Array:
        result = np.empty(size)
        self._call(name, *arguments, result)
        return result

    def _call(self, name: str, *arguments: Array | float) -> Any:
        given = [a.ctypes.data if isinstance(a, np.ndarray) else a for a in arguments]
        return getattr(self._library, f"kpirl_mpc_{name}")(ctypes.addressof(self._system), *given)
