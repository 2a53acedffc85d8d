"""Calling a CasADi function on numpy arrays without copies: about 2 us an argument instead of 10 to 20."""

from __future__ import annotations

import casadi as ca
import numpy as np

from kpirl_ocp.types import Array


class Call:
    """A function of dense vectors and matrices, called with flat arrays in column-major order, as CasADi keeps them.

    Holds the memory of one evaluation, so use one object per thread.
    """

    def __init__(self, function: ca.Function) -> None:
        self._buffer, self._evaluate = function.buffer()
        self._sizes_in = [function.nnz_in(i) for i in range(function.n_in())]
        self._sizes_out = [function.nnz_out(i) for i in range(function.n_out())]
        if any(function.sparsity_in(i).nnz() != function.numel_in(i) for i in range(function.n_in())):
            raise ValueError(f"{function} has a sparse input.")
        if any(function.sparsity_out(i).nnz() != function.numel_out(i) for i in range(function.n_out())):
            raise ValueError(f"{function} has a sparse output.")

    def __call__(self, *arguments: Array) -> list[Array]:
        """New flat arrays, one per output."""
        flat = [np.ascontiguousarray(argument, float) for argument in arguments]
        if [len(a) for a in flat] != self._sizes_in:
            raise ValueError(f"arguments have lengths {[len(a) for a in flat]}, expected {self._sizes_in}.")
        for i, array in enumerate(flat):
            self._buffer.set_arg(i, memoryview(array))
        outputs = [np.empty(size) for size in self._sizes_out]
        for i, array in enumerate(outputs):
            self._buffer.set_res(i, memoryview(array))
        self._evaluate()
        return outputs
