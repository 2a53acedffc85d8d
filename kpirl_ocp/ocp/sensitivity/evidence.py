"""Measurements for certificates, from evaluations near the solution.

The arithmetic is in C: `kpirl_mpc_certify.c` and `kpirl_mpc_kinks.c`.
"""

from __future__ import annotations

import ctypes
from itertools import accumulate

import numpy as np

from kpirl_ocp.ocp.codegen.numpy_calls import Build
from kpirl_ocp.ocp.conditions import parameter_derivatives
from kpirl_ocp.ocp.interior_point import library as c
from kpirl_ocp.ocp.interior_point.core import Core
from kpirl_ocp.ocp.interior_point.cores import borrow_core
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.sensitivity.implicit_function import ByParameters
from kpirl_ocp.ocp.sensitivity.kkt_system import Instance, KKTSystem, Memory, PrimalDual, Triple
from kpirl_ocp.ocp.sensitivity.rows import rows_of
from kpirl_ocp.types import Array

MEASURED = tuple(name for name, *_ in c.Evidence._fields_)
"""Fields of a `SensitivityCertificate`, in the order of the structure `kpirl_mpc_evidence` of numbers."""


class AnswerLayout:
    """An answer of the C code: gradients by psi, s_0 and the context, then the fields `MEASURED`, one behind the other.

    size: how many numbers. psi, s0, context, measured: which of them.
    """

    def __init__(self, problem: OCP) -> None:
        sizes = (problem.n_parameters, problem.n_states, problem.n_context, len(MEASURED))
        ends = list(accumulate(sizes))
        self.size = ends[-1]
        self.psi, self.s0, self.context, self.measured = map(slice, [0, *ends], ends)


def measure(
    core: Core, system: KKTSystem, nearby: Memory, slopes: bytes, direction: Array | None = None
) -> tuple[ByParameters, dict[str, float], bool]:
    """Gradients of a function of the plan, and the measured fields of a `SensitivityCertificate`.

    The third result is whether the slopes are finite.

    Args:
        core: evaluates the problem's functions.
        system: the KKT system at the solution.
        nearby: memory for a second system, which will hold the one after a further Newton step.
        slopes: of the function by S (T+1, n_s), then by U (T, n_u), as float64.
        direction: (n_w,) direction along which smoothness is tested; by default the adjoint.
    """
    part, along = core.kept(AnswerLayout), None if direction is None else c.address_of(direction)
    answer, function = np.empty(part.size), core.function(parameter_derivatives.pull)
    given = system.address, nearby.address, core.address, function, slopes, along, c.address_of(answer)
    finite = bool(core.library.kpirl_mpc_certify(*given))
    found = ByParameters(answer[part.psi], answer[part.s0], answer[part.context])
    return found, dict(zip(MEASURED, answer[part.measured].tolist(), strict=True)), finite


def parameter_jump(problem: OCP, x: Array, psi: Array, context: Array) -> float:
    """The relative deviation from smoothness in psi of the conditions at a plan x (n_w,); infinite if not finite there.

    Derivatives of a randomly weighted sum of the conditions are compared with finite differences along psi, and with
    derivatives to either side. The plan need not be a solution.
    """
    rows, n_s = rows_of(problem), problem.n_states
    numbers = len(x), problem.horizon * n_s, len(rows.equality)
    one, costates, forces = (rows.uniform[:n] for n in numbers)
    system = KKTSystem(Instance(problem, x[:n_s], psi, context))
    system.set_point(PrimalDual(x, costates, forces))
    weights, by = Triple(PrimalDual(one * rows.sizes_of(x), costates, forces)), ByParameters.empty(problem)
    structure = by.structure
    with borrow_core(problem) as core:
        function = core.function(parameter_derivatives.pull)
        at = system.structure.numbers.psi, system.structure.numbers.context
        to = structure.psi, structure.context
        if core.library.kpirl_mpc_weigh(system.address, function, weights.address, *at, *to):
            return float(np.inf)
        structure.s0 = None
        given = system.address, core.address, function, weights.address, ctypes.addressof(structure)
        return float(core.library.kpirl_mpc_kink_in_parameters(*given))


class LossOfPlan:
    """A loss at x (n_w,).

    value: of the loss. slopes: (n_w,) its gradient by S, then by U. kink: relative deviation from smoothness in a
        random direction.
    """

    def __init__(self, problem: OCP, build: Build, data: Array, x: Array) -> None:
        """
        build: problem -> function (S, U, data) -> L, dL/dS, dL/dU, all dense.
        data: argument of the function, in column-major order.
        """
        rows, n_w, self._problem, self._build = rows_of(problem), len(x), problem, build
        value, self.slopes = c.REAL(), np.empty(n_w)
        self._kept = rows.dimensions, rows.structure, value, np.ascontiguousarray(data, float), x, np.empty(8 * n_w)
        *structures, data, x, work = self._kept
        self._sizes = [ctypes.addressof(structure) for structure in structures]
        self._arrays = [c.address_of(array) for array in (data, x, self.slopes, work)]
        self.kink = self.kink_along(None)
        self.value = value.value

    def kink_along(self, move: Array | None) -> float:
        """Relative deviation of the gradient from finite differences, and from the gradients to either side.

        move: (n_w,) the differences go a millionth of this vector to either side; None: of a random one.
        """
        (*sizes, value), (data, x, slopes, work) = self._sizes, self._arrays
        along = None if move is None else c.address_of(move)
        with borrow_core(self._problem) as core:
            at = *sizes, core.function(self._build), data, x, along, value, slopes, work
            return float(core.library.kpirl_mpc_kink_of_loss(*at))
