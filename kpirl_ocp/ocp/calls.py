"""Calling a CasADi function on numpy arrays without copies: about 2 us an argument instead of 10 to 20."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from functools import lru_cache

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.native import together
from kpirl_ocp.ocp.problem import OCP
from kpirl_ocp.types import Array

Build = Callable[[OCP], ca.Function]

# T n_x^2 from which machine code saves more than the seconds that the compiler takes: smaller problems are solved in
# milliseconds by CasADi's virtual machine.
_WORTH_COMPILING = 15000
_SMALL = 2000  # numbers that are copied


class Call:
    """A function of dense vectors and matrices, called with flat arrays in column-major order, as CasADi keeps them.

    Small arrays are copied to and from memory of its own, which takes a fraction of the time that it takes to tell
    CasADi where they are. It holds the memory of one evaluation, so use one object per thread.
    """

    def __init__(self, function: ca.Function) -> None:
        self._buffer, self._evaluate = function.buffer()
        self._sizes_in, self._sizes_out = _sizes(function)
        self._inputs, self._outputs = (
            [np.empty(size) if size <= _SMALL else None for size in sizes]
            for sizes in (self._sizes_in, self._sizes_out)
        )
        for arrays, tell in ((self._inputs, self._buffer.set_arg), (self._outputs, self._buffer.set_res)):
            for i, array in enumerate(arrays):
                if array is not None:
                    tell(i, array.data)
        self._fixed: list[Array] = []

    def __call__(self, *arguments: Array) -> list[Array]:
        """New flat arrays, one per output."""
        kept = self._hand_over(arguments, len(self._fixed))
        if len(self._fixed) + len(kept) != len(self._sizes_in):
            raise ValueError(f"{len(kept)} arguments were given, expected {len(self._sizes_in) - len(self._fixed)}.")
        large = {i: np.empty(size) for i, size in enumerate(self._sizes_out) if size > _SMALL}
        for i, array in large.items():
            self._buffer.set_res(i, array.data)
        self._evaluate()
        return [large[i] if memory is None else memory.copy() for i, memory in enumerate(self._outputs)]

    def fix(self, *arguments: Array) -> Call:
        """The same object, with its first arguments given for all later calls."""
        self._fixed = self._hand_over(arguments, 0)
        return self

    def _hand_over(self, arguments: Sequence[Array], first: int) -> list[Array]:
        """The arrays that CasADi now reads, which have to be kept until it is done."""
        kept = []
        for i, argument in enumerate(arguments, start=first):
            array, memory = np.asarray(argument, float), self._inputs[i]
            if array.size != self._sizes_in[i]:
                raise ValueError(f"argument {i} has {array.size} numbers, expected {self._sizes_in[i]}.")
            if memory is None:
                memory = np.ascontiguousarray(array)
                self._buffer.set_arg(i, memory.data)
            else:
                memory[:] = array.reshape(-1)
            kept.append(memory)
        return kept


def call(problem: OCP, build: Build) -> Call:
    """The function `build(problem)`, ready to be called: compiled, unless the problem is too small to repay it."""
    return call_one_of(problem, (build,), build)


def call_one_of(problem: OCP, builds: tuple[Build, ...], build: Build) -> Call:
    """The same, compiled together with others that share most of their code."""
    return own(_native(problem, builds)[builds.index(build)])


def own(function: ca.Function) -> Call:
    """This thread's object for a function; its arguments are open again."""
    if not hasattr(_thread, "find"):
        _thread.find = lru_cache(maxsize=512)(Call)
    found: Call = _thread.find(function)
    return found.fix()


_thread = threading.local()


@lru_cache(maxsize=512)
def _native(problem: OCP, builds: tuple[Build, ...]) -> list[ca.Function]:
    functions = [build(problem) for build in builds]
    return together(functions) if worth_compiling(problem) else functions


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
