"""Functions of stages as tapes: lists of scalar operations that the core carries out for several stages at once.

CasADi's virtual machine takes about 5 ns for an operation, whatever it is, to find out which comes next; a tape is read
once for sixteen stages. Their results are the same to the last bit. To make a tape takes 0.1 us an operation.
"""

from __future__ import annotations

import ctypes
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

import kpirl_ocp.ocp.interior_point.library as c
from kpirl_ocp.ocp.interior_point.evaluator import member
from kpirl_ocp.ocp.interior_point.stage_functions import stage_functions
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array

# In the order of `c/library/kpirl_mpc_tapes.c`.
KINDS = [
    *(ca.OP_CONST, ca.OP_INPUT, ca.OP_OUTPUT),
    *(ca.OP_ADD, ca.OP_SUB, ca.OP_MUL, ca.OP_DIV, ca.OP_POW, ca.OP_CONSTPOW, ca.OP_FMOD, ca.OP_REMAINDER),
    *(ca.OP_ATAN2, ca.OP_HYPOT, ca.OP_COPYSIGN, ca.OP_FMIN, ca.OP_FMAX),
    *(ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_AND, ca.OP_OR, ca.OP_IF_ELSE_ZERO),
    *(ca.OP_NEG, ca.OP_INV, ca.OP_SQ, ca.OP_TWICE, ca.OP_SQRT, ca.OP_NOT, ca.OP_SIGN, ca.OP_FABS),
    *(ca.OP_FLOOR, ca.OP_CEIL, ca.OP_EXP, ca.OP_EXPM1, ca.OP_LOG, ca.OP_LOG1P, ca.OP_ERF),
    *(ca.OP_SIN, ca.OP_COS, ca.OP_TAN, ca.OP_ASIN, ca.OP_ACOS, ca.OP_ATAN),
    *(ca.OP_SINH, ca.OP_COSH, ca.OP_TANH, ca.OP_ASINH, ca.OP_ACOSH, ca.OP_ATANH),
]
_PLACES = np.full(1 + max(value for name, value in vars(ca).items() if name.startswith("OP_")), -1, np.intc)
_PLACES[KINDS] = np.arange(len(KINDS))  # -1: another kind
_INPUTS = ("x", "actions", *c.STAGE[0][1:])  # x: entries of the state
# Members of casadi::Function, and operator delete, in the order of `library.Members`.
_MEMBERS = (
    *("_ZNK6casadi8Function14instruction_idEx", "_ZNK6casadi8Function20instruction_constantEx"),
    *("_ZNK6casadi8Function18instruction_outputEx", "_ZNK6casadi8Function17instruction_inputEx", "_ZdlPv"),
)


class Tape(NamedTuple):
    """A function: rows (kind, to, from, other), the constants, and how many slots they work on."""

    operations: NDArray[np.intc]
    constants: Array
    slots: int

    @property
    def structure(self) -> Any:
        """For the core."""
        return c.Tape(c.address_of(self.operations), c.address_of(self.constants), len(self.operations))


class Tapes:
    """The functions of one level, of a stage and of the end, with memory for one evaluation."""

    def __init__(self, stage: Tape, last: Tape, dimensions: Any, schedule: Array) -> None:
        """schedule: (T+1, n_d), contiguous."""
        slots = _in_cache_lines(max(stage.slots, last.slots) * c.library().kpirl_mpc_lanes())
        costs = np.zeros(dimensions.horizon + 1)
        self._kept = [stage, last, schedule, slots, costs]
        addresses = [c.address_of(array) for array in (schedule, slots, costs)]
        self._structure = c.Tapes(stage.structure, last.structure, dimensions, *addresses)

    @property
    def pointer(self) -> Any:
        """The function of the whole horizon for the core."""
        return c.Function(c.symbol("kpirl_mpc_evaluate_tapes"), ctypes.addressof(self._structure))


def _in_cache_lines(count: int) -> Array:
    """Zeros (count,) that begin with a cache line, so that no vector of up to eight lies across two."""
    numbers = np.zeros(count + 8)
    return numbers[-(numbers.ctypes.data // 8) % 8 :][:count]


@lru_cache(maxsize=64)
def read_tapes(problem: OCP) -> list[tuple[Tape, Tape]] | None:
    """Of a stage and of the end, for each level; None if a function has operations on matrices, or calls others."""
    if problem.derivatives is not None:
        return None
    functions = stage_functions(problem)
    try:
        pairs = zip(functions.stage, functions.last, strict=True)
        return [(_read(stage, problem.n_states), _read(last, problem.n_states)) for stage, last in pairs]
    except _UnknownOperation:
        return None


class _UnknownOperation(Exception):
    """A function that is no list of operations of `KINDS`."""


def _read(function: ca.Function, n_states: int) -> Tape:
    if not function.is_a("SXFunction"):
        raise _UnknownOperation
    rows, constants = _operations(function)
    kinds, to, entries, given, others = rows.T
    places = _PLACES[kinds]
    if places.min(initial=0) < 0:
        raise _UnknownOperation
    is_constant, is_input, is_output = (kinds == kind for kind in (ca.OP_CONST, ca.OP_INPUT, ca.OP_OUTPUT))
    slots = 1 + to[~is_output].max(initial=0)
    given[is_constant] = np.arange(len(constants))
    given[is_input], others[is_input] = _arguments(function, given[is_input], others[is_input], n_states)
    to[is_output], others[is_output] = _results(function, to[is_output], entries[is_output])
    return Tape(np.column_stack([places, to, given, others]), constants, int(slots))


def _operations(function: ca.Function) -> tuple[NDArray[np.intc], Array]:
    """Rows (kind, first and last entry of what is written, and of what is read), and the constants."""
    count, members = function.n_instructions(), c.Members(*map(member, _MEMBERS))
    rows, constants = np.empty((count, 5), np.intc), np.empty(count)
    ends = ctypes.addressof(members), int(function.this), count, ca.OP_CONST, *map(c.address_of, (rows, constants))
    c.library().kpirl_mpc_read_operations(*ends)
    return rows, constants[: np.count_nonzero(rows[:, 0] == ca.OP_CONST)].copy()


def _arguments(
    function: ca.Function, given: NDArray[np.intc], entries: NDArray[np.intc], n_states: int
) -> tuple[NDArray[np.intc], NDArray[np.intc]]:
    """Which arguments of the core's, and which entries of them; of x, what belongs to actions is one of its own."""
    given = np.array([_INPUTS.index(name) for name in function.name_in()])[given]
    of_actions = (given == _INPUTS.index("x")) & (entries >= n_states)
    return np.where(of_actions, _INPUTS.index("actions"), given), entries - n_states * of_actions


def _results(
    function: ca.Function, to: NDArray[np.intc], nonzeros: NDArray[np.intc]
) -> tuple[NDArray[np.intc], NDArray[np.intc]]:
    """Which results of the core's, and which entries of them."""
    entries = [dense_entries(function.sparsity_out(i)) for i in range(function.n_out())]
    starts = np.cumsum([0, *map(len, entries)])
    places = np.array([c.STAGE[1].index(name) for name in function.name_out()])
    return places[to], np.concatenate(entries)[starts[to] + nonzeros]


def dense_entries(sparsity: ca.Sparsity) -> NDArray[np.intc]:
    """The places of nonzeros in a dense array."""
    return np.array(sparsity.find(), np.intc)
