"""Calling a CasADi function on numpy arrays without copies: about 2 us an argument instead of 10 to 20."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.native import compiled
from kpirl_ocp.ocp.problem import OCP
from kpirl_ocp.types import Array

# T n_x^2 from which machine code saves more than the seconds that the compiler takes: smaller problems are solved in
# milliseconds by CasADi's virtual machine.
_WORTH_COMPILING = 15000


class Call:
    """A function of dense vectors and matrices, called with flat arrays in column-major order, as CasADi keeps them.

    Holds the memory of one evaluation, so use one object per thread.
    """

    def __init__(self, function: ca.Function) -> None:
        self._buffer, self._evaluate = function.buffer()
        self._sizes_in, self._sizes_out = _sizes(function)

    def __call__(self, *arguments: Array) -> list[Array]:
        """New flat arrays, one per output."""
        flat = [np.ascontiguousarray(argument, float) for argument in arguments]
        if [array.size for array in flat] != self._sizes_in:
            raise ValueError(f"arguments have {[array.size for array in flat]} numbers, expected {self._sizes_in}.")
        for i, array in enumerate(flat):
            self._buffer.set_arg(i, array.data)
        outputs = [np.empty(size) for size in self._sizes_out]
        for i, array in enumerate(outputs):
            self._buffer.set_res(i, array.data)
        self._evaluate()
        return outputs


def call(problem: OCP, build: Callable[[OCP], ca.Function]) -> Call:
    """The function `build(problem)`, ready to be called: compiled, unless the problem is too small to repay it."""
    return Call(_native(problem, build))


@lru_cache(maxsize=512)
def _native(problem: OCP, build: Callable[[OCP], ca.Function]) -> ca.Function:
    return compiled(build(problem)) if worth_compiling(problem) else build(problem)


def worth_compiling(problem: OCP) -> bool:
    """Is the problem large enough for machine code to repay the seconds that the compiler takes?"""
    return problem.horizon * (problem.n_states + problem.n_actions) ** 2 > _WORTH_COMPILING


@lru_cache(maxsize=512)
def _sizes(function: ca.Function) -> tuple[list[int], list[int]]:
    """Lengths of the inputs and outputs, all of which must be dense."""
    for sparsity in (
        *(function.sparsity_in(i) for i in range(function.n_in())),
        *(function.sparsity_out(i) for i in range(function.n_out())),
    ):
        if not sparsity.is_dense():
            raise ValueError(f"{function} has an input or output that is not dense.")
    return (
        [function.numel_in(i) for i in range(function.n_in())],
        [function.numel_out(i) for i in range(function.n_out())],
    )
