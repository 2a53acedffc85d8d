"""CasADi functions as C function pointers: evaluated by CasADi's virtual machine, or as machine code."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache, lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from kpirl_ocp.ocp.codegen.numpy_calls import Build, native
from kpirl_ocp.ocp.interior_point.library import Buffered, CompiledFunction, Function, address_in, symbol
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array

# Members of casadi::FunctionBuffer, as compilers for Linux and macOS spell them.
_EVALUATE, _STATUS = "_ZN6casadi14FunctionBuffer5_evalEv", "_ZN6casadi14FunctionBuffer3retEv"


Names = tuple[tuple[str, ...], tuple[str, ...]]
"""Of the arguments and results that the core calls a function with: `library.STAGE` or `library.HORIZON`."""


class VirtualMachine:
    """A function evaluated by CasADi's virtual machine, with memory for one evaluation."""

    def __init__(self, function: ca.Function, names: Names) -> None:
        self._buffer, _ = function.buffer()
        self._places = _places(function, names)
        n_in, n_out = function.n_in(), function.n_out()
        sizes = [function.nnz_in(i) for i in range(n_in)], [function.nnz_out(i) for i in range(n_out)]
        self._arrays = [[np.zeros(max(size, 1)) for size in side] for side in sizes]
        for tell, side in zip((self._buffer.set_arg, self._buffer.set_res), self._arrays, strict=True):
            for i, array in enumerate(side):
                tell(i, array.data)
        self._sizes = [np.array(side, np.intc) for side in sizes]
        self._pointers = [np.array([array.ctypes.data for array in side], np.uintp) for side in self._arrays]
        addresses = [array.ctypes.data for side in (self._places, self._sizes, self._pointers) for array in side]
        members = member(_EVALUATE), member(_STATUS)
        self._structure = Buffered(*members, _address_of(self._buffer), n_in, n_out, *addresses)

    @property
    def pointer(self) -> Any:
        """The function for the core."""
        return Function(symbol("kpirl_mpc_evaluate_buffered"), ctypes.addressof(self._structure))


class Compiled:
    """A function of a shared library that CasADi's code generator wrote, with memory for one evaluation."""

    def __init__(self, function: ca.Function, names: Names, code: int) -> None:
        """code: address of the function in the library."""
        self._places = _places(function, names)
        self._memory: list[Array] = [
            np.zeros(max(size, 1), kind)
            for size, kind in (
                (function.sz_arg(), np.uintp),
                (function.sz_res(), np.uintp),
                (function.sz_iw(), np.int64),
                (function.sz_w(), np.float64),
            )
        ]
        addresses = [array.ctypes.data for array in self._places] + [array.ctypes.data for array in self._memory]
        self._structure = CompiledFunction(code, function.n_in(), function.n_out(), *addresses)

    @property
    def pointer(self) -> Any:
        """The function for the core."""
        return Function(symbol("kpirl_mpc_evaluate_compiled"), ctypes.addressof(self._structure))


class Pointer:
    """A C function pointer to a function of a problem, called with its arguments and results in their order.

    uses: by those who asked for it.
    """

    def __init__(self, function: ca.Function) -> None:
        self._function, self.uses, self.compiled = function, 0, False
        self._names = tuple(function.name_in()), tuple(function.name_out())
        self._evaluator: VirtualMachine | Compiled = VirtualMachine(function, self._names)
        self._pointer = self._evaluator.pointer

    @property
    def address(self) -> int:
        """Of the structure."""
        return ctypes.addressof(self._pointer)

    def take(self, code: int) -> None:
        """Use machine code at this address from now on."""
        self._evaluator, self.compiled = Compiled(self._function, self._names, code), True
        self._pointer = self._evaluator.pointer


@lru_cache(maxsize=256)
def pointer_to(build: Build) -> Callable[[OCP], Pointer]:
    """problem -> a pointer to `build(problem)`."""
    return lambda problem: Pointer(native(problem, build))


def _places(function: ca.Function, names: Names) -> list[NDArray[np.intc]]:
    """Where every argument and every result stands among the pointers that the function is called with."""
    sides = zip(names, (function.name_in(), function.name_out()), strict=True)
    return [np.array([known.index(name) for name in own], np.intc) for known, own in sides]


@cache
def member(name: str) -> int:
    """The address of a function of CasADi, or of the libraries that it uses, by its mangled name."""
    return address_in(ctypes.CDLL(ca._casadi.__file__), name)  # loaded already, so that this only finds it


def _address_of(buffer: ca.FunctionBuffer) -> int | None:
    get = ctypes.pythonapi.PyCapsule_GetPointer
    get.restype, get.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    address: int | None = get(buffer._self(), None)
    return address
