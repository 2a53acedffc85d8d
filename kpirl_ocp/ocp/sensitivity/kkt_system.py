"""The KKT system at a solution, stage by stage.

    H x + A' lambda + C' mu = r,    A x = d,    C x = c

Unknowns are in the order of time, x = (s_0, u_0, s_1, .., s_T). H is the exact Hessian of the Lagrangian, A the
Jacobian of the defects, C that of equalities and active inequalities; products with them go stage by stage.
`factorisation` solves the system.

Smoothed with a barrier parameter tau, every inequality g <= 0 leaves C and adds mu / slack grad g grad g^T to H
instead, with mu = tau / slack; only equalities stay in C.

All comparisons are relative, so that they do not depend on units: each entry of x is compared with its largest absolute
value over the horizon, a multiplier with the forces that it balances, and a decision is scaled by its own curvature.
The arithmetic is in C: `c/kpirl_mpc_kkt.h`.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from kpirl_ocp.ocp.interior_point import library as c
from kpirl_ocp.ocp.interior_point.core import Core
from kpirl_ocp.ocp.interior_point.cores import borrow_core
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import StageDerivatives
from kpirl_ocp.ocp.sensitivity.rows import Rows, rows_of
from kpirl_ocp.ocp.sensitivity.solution_arrays import arrays_of, as_row
from kpirl_ocp.types import Array, Mask, Solution


class Instance(NamedTuple):
    """A problem with values of its parameters: s0 (n_s,), psi (n_psi,), context (n_c,), and barrier tau >= 0."""

    problem: OCP
    s0: Array
    psi: Array
    context: Array
    barrier: float = 0.0

    @classmethod
    def of(cls, problem: OCP, solution: Solution) -> Instance:
        """The instance that a solution solves, which fits the problem (`arrays_of`)."""
        return cls(problem, solution.states[0], solution.psi, solution.context, solution.barrier)

    @property
    def rows(self) -> Rows:
        """All constraints but the dynamics."""
        return rows_of(self.problem)


@dataclass(frozen=True)
class PrimalDual:
    """A primal-dual point: x (n_w,), costates (T n_s,), and multipliers of the rows (n_rows,), called forces."""

    x: Array
    costates: Array
    forces: Array


class Memory:
    """The structure `kpirl_mpc_kkt` for a problem, with the arrays it points to; for one thread at a time.

    sizes_of_parts: lengths n_w, T n_s and n_rows of the parts of a point. x, active: views of these arrays.
    """

    def __init__(self, problem: OCP) -> None:
        rows, self._schedule = rows_of(problem), np.ascontiguousarray(problem.schedule, float)
        self.sizes_of_parts = len(rows.largest_bound), problem.horizon * problem.n_states, len(rows.inequality)
        self._arrays, self._rows, self.structure = np.empty(rows.n_memory), rows.structure, c.KKT()
        self.address, dimensions = ctypes.addressof(self.structure), rows.dimensions
        given = ctypes.addressof(dimensions), ctypes.addressof(self._rows)
        c.library().kpirl_mpc_kkt_init(self.address, *given, self._arrays.ctypes.data)
        self.structure.numbers.schedule = c.address_of(self._schedule)
        self.x = c.view(self.structure.point.x, self.sizes_of_parts[0])
        self.active = c.view(self.structure.system.active, self.sizes_of_parts[2])


class KKTSystem:
    """First and second derivatives at a point, and the active rows; rows are ordered as in `Rows`.

    `at_solution` builds one. Its properties return copies of the arrays.

    finite: True if no derivative holds NaN or infinity.
    """

    def __init__(self, instance: Instance, memory: Memory | None = None) -> None:
        """A system without a point yet, in its own memory or in the given one."""
        self.instance, self._memory, self._library = instance, memory or Memory(instance.problem), c.library()
        self.structure, self.address, self.finite = self._memory.structure, self._memory.address, False
        self.structure.barrier = instance.barrier
        self._kept: Any = None  # arrays that the C code has pointers to

    @property
    def sizes_of_parts(self) -> tuple[int, int, int]:
        """Lengths n_w, T n_s and n_rows of the parts of a point."""
        return self._memory.sizes_of_parts

    @property
    def point(self) -> PrimalDual:
        """The point of linearisation."""
        return self.read(self.structure.point)

    @property
    def x(self) -> Array:
        """(n_w,) of the point."""
        return self._memory.x.copy()

    def read(self, triple: Any) -> PrimalDual:
        """A copy of a structure `kpirl_mpc_triple`."""
        sizes = zip(("x", "costates", "forces"), self.sizes_of_parts, strict=True)
        return PrimalDual(*(c.read(getattr(triple, name), size) for name, size in sizes))

    def set_point(self, point: PrimalDual) -> None:
        """Set the point; the derivatives are not evaluated yet."""
        for name, part in (("x", point.x), ("costates", point.costates), ("forces", point.forces)):
            array = np.ascontiguousarray(part, float)
            ctypes.memmove(getattr(self.structure.point, name), array.ctypes.data, array.nbytes)
        _, s0, psi, context, _ = self.instance
        self._kept = [np.ascontiguousarray(array, float) for array in (s0, psi, context)]
        numbers = self.structure.numbers
        numbers.s0, numbers.psi, numbers.context = map(c.address_of, self._kept)
        self.structure.evaluated = False

    def linearise_at(self, row: bytes, core: Core, derivatives: StageDerivatives | None) -> None:
        """Set numbers, point, derivatives and active rows for a solution of the instance, given as a row (`as_row`).

        Newton steps lead from the solution to a more exact point where that is needed
        (`SensitivityCertificate.distance`). Derivatives that are not given are evaluated by the core; after a short
        step second ones stay those of the solution, until `renew`.
        """
        self._kept = row, derivatives
        known = None if derivatives is None else c.address_of(derivatives.numbers)
        self.finite = bool(self._library.kpirl_mpc_kkt_linearise(self.address, core.address, row, known))

    def renew(self, core: Core) -> None:
        """Evaluate second derivatives where those of a point close by have served."""
        self._library.kpirl_mpc_kkt_renew(self.address, core.address)

    @property
    def active(self) -> Mask:
        """(n_rows,) True for rows of C: equalities and active inequalities."""
        return self._memory.active.astype(bool)

    @property
    def stiffness(self) -> Array:
        """(n_rows,) mu / slack of smoothed rows, zero for the others."""
        return self._of_system("sigma", self.sizes_of_parts[2])

    @property
    def sizes(self) -> Array:
        """(n_w,) the largest absolute value over the horizon of each entry of x, and of its finite bounds."""
        return self._of_system("sizes", self.sizes_of_parts[0])

    @property
    def parameter_tangent(self) -> Array:
        """(n_w,) change of x along the direction of (psi, s_0, c) in which the certificate tested smoothness.

        Zero before a certificate has been measured, with a barrier, and for quadratic programs without psi and context.
        """
        return c.read(self.structure.tangent, self.sizes_of_parts[0])

    @property
    def roots(self) -> Array:
        """(n_decisions,) square root of the curvature of each decision by itself, the largest over the horizon."""
        return self._of_system("roots", len(self.instance.rows.decisions))

    def transposed_times(self, forces: Array) -> Array:
        """The transposed Jacobian of all rows times forces, (n_w,)."""
        pushed = np.zeros(self.sizes_of_parts[0])
        self._library.kpirl_mpc_rows_transposed_times(self.address, forces.ctypes.data, pushed.ctypes.data)
        return pushed

    def _of_system(self, name: str, size: int) -> Array:
        return c.read(getattr(self.structure.system, name), size)


class Triple:
    """The structure `kpirl_mpc_triple` for the C code: a point, or the right-hand side of a system."""

    def __init__(self, point: PrimalDual, start: Array | None = None) -> None:
        """start: (n_s,) given entries of s_0, for a right-hand side."""
        arrays = [point.x, point.costates, point.forces, *([] if start is None else [start])]
        self._kept = [np.ascontiguousarray(array, float) for array in arrays]
        self._structure = c.Triple(*map(c.address_of, self._kept))

    @property
    def address(self) -> int:
        """Address of the structure."""
        return ctypes.addressof(self._structure)

    @property
    def point(self) -> PrimalDual:
        """The arrays as they are now."""
        return PrimalDual(*self._kept[:3])


def at_solution(problem: OCP, solution: Solution) -> KKTSystem:
    """The KKT system at a solution, smoothed with its barrier. Raises ProblemError when it is of another problem."""
    row, system = as_row(arrays_of(problem, solution)), KKTSystem(Instance.of(problem, solution))
    with borrow_core(problem) as core:
        system.linearise_at(row, core, None)
        system.renew(core)
    return system
