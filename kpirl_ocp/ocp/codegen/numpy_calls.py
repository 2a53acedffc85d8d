"""Calling a CasADi function on numpy arrays without copies: about 2 us an argument instead of 10 to 20."""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, Sequence
from functools import lru_cache
from itertools import pairwise

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.codegen.compiler import compile_all
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array

Build = Callable[[OCP], ca.Function]

# T n_x^2 from which machine code saves more than the seconds that the compiler takes: smaller problems are solved in
# milliseconds by CasADi's virtual machine.
_WORTH_COMPILING = 15000
_SMALL = 2000  # numbers that are copied


class Call:
    """A function of dense vectors and matrices, called with flat arrays in column-major order, as CasADi keeps them.

    Small arrays are copied to and from memory of its own, which takes a fraction of the time that it takes to tell
    CasADi their address. It holds the memory of one evaluation, so use one object per thread.
    """

    def __init__(self, function: ca.Function) -> None:
        self._buffer, self._evaluate = function.buffer()
        self._sizes_in, self._sizes_out = _sizes(function)
        block, places = _small(self._sizes_in)
        self._inputs = [None if place is None else block[place] for place in places]
        self._results, self._places = _small(self._sizes_out)
        outputs = [None if place is None else self._results[place] for place in self._places]
        for arrays, tell in ((self._inputs, self._buffer.set_arg), (outputs, self._buffer.set_res)):
            for i, array in enumerate(arrays):
                if array is not None:
                    tell(i, array.data)
        self._large = [i for i, place in enumerate(self._places) if place is None]
        self._fixed: list[Array] = []

    def __call__(self, *arguments: Array) -> list[Array]:
        """New flat arrays, one per output; the small ones share one block of memory."""
        kept = self._set_arguments(arguments, len(self._fixed))
        if len(self._fixed) + len(kept) != len(self._sizes_in):
            raise ValueError(f"{len(kept)} arguments were given, expected {len(self._sizes_in) - len(self._fixed)}.")
        large = {i: np.empty(self._sizes_out[i]) for i in self._large}
        for i, array in large.items():
            self._buffer.set_res(i, array.data)
        self._evaluate()
        block = self._results.copy()
        return [large[i] if place is None else block[place] for i, place in enumerate(self._places)]

    def fix(self, *arguments: Array) -> Call:
        """Fix the first arguments for all later calls; returns the object itself."""
        self._fixed = self._set_arguments(arguments, 0)
        return self

    def _set_arguments(self, arguments: Sequence[Array], first: int) -> list[Array]:
        """Set arguments from number `first` on; returns the arrays that CasADi reads, to be kept until it is done."""
        kept = []
        for i, argument in enumerate(arguments, start=first):
            array, memory = np.asarray(argument, float), self._inputs[i]
            if array.size != self._sizes_in[i]:
                raise ValueError(f"argument {i} has {array.size} numbers, expected {self._sizes_in[i]}.")
            if memory is None:
                memory = np.ascontiguousarray(array)
                self._buffer.set_arg(i, memory.data)
            else:
                memory[:] = array if array.ndim == 1 else array.ravel()
            kept.append(memory)
        return kept


def call(problem: OCP, build: Build) -> Call:
    """This thread's `Call` of the function `build(problem)`; compiled, unless the problem is too small to repay it.

    All its arguments are open, whatever an earlier user has fixed.
    """
    return call_one_of(problem, (build,), build)


def call_one_of(problem: OCP, builds: tuple[Build, ...], build: Build) -> Call:
    """`call`, with the function compiled together with others that share most of their code."""
    return _per_thread("builds", _built)(problem, builds, build).fix()


def call_built(build: Callable[..., ca.Function], *arguments: Hashable) -> Call:
    """This thread's `Call` of the function `build(*arguments)`, with all its arguments open.

    It is found by these arguments, which takes a fraction of the time that it takes CasADi to tell functions apart.
    """
    return _per_thread("built", _call_built)(build, *arguments).fix()


def _call_built(build: Callable[..., ca.Function], *arguments: Hashable) -> Call:
    return Call(build(*arguments))


_thread = threading.local()


def _per_thread(name: str, make: Callable[..., Call]) -> Callable[..., Call]:
    """`make` with a cache for this thread alone."""
    cached: Callable[..., Call] | None = getattr(_thread, name, None)
    if cached is None:
        cached = lru_cache(maxsize=512)(make)
        setattr(_thread, name, cached)
    return cached


def _built(problem: OCP, builds: tuple[Build, ...], build: Build) -> Call:
    return Call(_native(problem, builds)[builds.index(build)])


def native(problem: OCP, build: Build) -> ca.Function:
    """The function `build(problem)`; compiled, unless the problem is too small to repay it."""
    return _native(problem, (build,))[0]


@lru_cache(maxsize=512)
def _native(problem: OCP, builds: tuple[Build, ...]) -> list[ca.Function]:
    functions = [build(problem) for build in builds]
    return compile_all(functions) if worth_compiling(problem) else functions


def worth_compiling(problem: OCP) -> bool:
    """True if machine code repays the seconds that the compiler takes, because the problem is large enough."""
    return problem.horizon * (problem.n_states + problem.n_actions) ** 2 > _WORTH_COMPILING


def _small(sizes: Sequence[int]) -> tuple[Array, list[slice | None]]:
    """One block of memory for all arrays that are small, and the place of each in it; None for a large one."""
    lengths = [size if size <= _SMALL else 0 for size in sizes]
    ends = np.cumsum([0, *lengths]).tolist()
    places = [slice(*pair) if size <= _SMALL else None for pair, size in zip(pairwise(ends), sizes, strict=True)]
    return np.empty(ends[-1]), places


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
