"""Functions of stages as tapes: lists of scalar operations that the core carries out for several stages at once.

CasADi's virtual machine takes about 5 ns for an operation, whatever it is, to find out which comes next; a tape is read
once for eight stages. Their results are the same to the last bit.
"""

from __future__ import annotations

import ctypes
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

import kpirl_ocp.ocp.interior_point.library as c
from kpirl_ocp.ocp.interior_point.stage_functions import stage_functions
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array

REPAID = 1_000  # evaluations of a stage after which reading its operations has taken less time than it saves
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
_INPUTS = ("x", "actions", *c.STAGE[0][1:])  # x: entries of the state


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
        slots = np.zeros((max(stage.slots, last.slots), c.library().kpirl_mpc_lanes()))
        costs = np.zeros(dimensions.horizon + 1)
        self._kept = [stage, last, schedule, slots, costs]
        addresses = [c.address_of(array) for array in (schedule, slots, costs)]
        self._structure = c.Tapes(stage.structure, last.structure, dimensions, *addresses)

    @property
    def pointer(self) -> Any:
        """The function of the whole horizon for the core."""
        return c.Function(c.symbol("kpirl_mpc_evaluate_tapes"), ctypes.addressof(self._structure))


@lru_cache(maxsize=64)
def read_tapes(problem: OCP) -> list[tuple[Tape, Tape]] | None:
    """Of a stage and of the end, for each level; None if a function has operations on matrices, or calls others."""
    functions = stage_functions(problem)
    if problem.derivatives is not None or not all(map(_is_list_of_operations, functions.all)):
        return None
    pairs = zip(functions.stage, functions.last, strict=True)
    return [(_read(stage, problem.n_states), _read(last, problem.n_states)) for stage, last in pairs]


def _is_list_of_operations(function: ca.Function) -> bool:
    known = set(KINDS)
    return function.is_a("SXFunction") and all(
        function.instruction_id(i) in known for i in range(function.n_instructions())
    )


def _read(function: ca.Function, n_states: int) -> Tape:
    inputs = [_INPUTS.index(name) for name in function.name_in()]
    outputs = [c.STAGE[1].index(name) for name in function.name_out()]
    places = [_dense(function.sparsity_out(i)) for i in range(function.n_out())]
    kinds = {kind: place for place, kind in enumerate(KINDS)}
    rows, constants, slots = [], [], 1
    for i in range(function.n_instructions()):
        kind, to, given = function.instruction_id(i), function.instruction_output(i), function.instruction_input(i)
        if kind == ca.OP_CONST:
            constants.append(function.instruction_constant(i))
            operands = to[0], len(constants) - 1, 0
        elif kind == ca.OP_INPUT:
            operands = to[0], *_argument(inputs[given[0]], given[1], n_states)
        elif kind == ca.OP_OUTPUT:
            operands = outputs[to[0]], given[0], places[to[0]][to[1]]
        else:
            operands = to[0], given[0], given[-1]
        if kind != ca.OP_OUTPUT:
            slots = max(slots, to[0] + 1)
        rows.append((kinds[kind], *operands))
    return Tape(np.array(rows, np.intc).reshape(-1, 4), np.array(constants, float), slots)


def _argument(place: int, entry: int, n_states: int) -> tuple[int, int]:
    """Of x, what belongs to actions is an argument of its own."""
    return (1, entry - n_states) if place == 0 and entry >= n_states else (place, entry)


def _dense(sparsity: ca.Sparsity) -> list[int]:
    """The places of nonzeros in a dense array."""
    rows, columns = sparsity.get_triplet()
    return [row + column * sparsity.size1() for row, column in zip(rows, columns, strict=True)]
