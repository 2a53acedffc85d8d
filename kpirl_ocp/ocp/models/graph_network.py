"""A network of any architecture in the CasADi graph, with derivatives by AD.

Slower than `kpirl_ocp.ocp.models.mlp.MLP`, whose derivatives are arranged by hand.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.models.mlp import stacked


@dataclass(frozen=True, eq=False)
class GraphNetwork:
    """y = f(x_1, ..., x_k), one CasADi function.

    function: (x_1 (n_1,), ..., x_k (n_k,)) -> y (n_out,).

    Raises ProblemError when an input or the output is no column.
    """

    function: ca.Function

    def __post_init__(self) -> None:
        columns = [self.function.size2_in(i) for i in range(self.function.n_in())] + [self.function.size2_out(0)]
        if self.function.n_in() < 1 or self.function.n_out() != 1 or set(columns) != {1}:
            raise ProblemError(f"a network maps columns to one column; it is {self.function}.")

    @property
    def sizes(self) -> tuple[int, ...]:
        """Lengths n_1, ..., n_k of the inputs."""
        return tuple(self.function.size1_in(i) for i in range(self.function.n_in()))

    @property
    def n_in(self) -> int:
        """n_1 + ... + n_k."""
        return sum(self.sizes)

    @property
    def n_out(self) -> int:
        """Length of y."""
        return int(self.function.size1_out(0))

    def __call__(self, *inputs: ca.MX) -> ca.MX:
        """y (n_out, B) of the inputs, each (n_i, B), or of all of them below one another, (n_in, B).

        Raises ProblemError for what are no CasADi columns, and for other lengths.
        """
        x = stacked(inputs, self.sizes)
        parts = ca.vertsplit(x, [0, *map(int, np.cumsum(self.sizes))])
        function = self.function if x.size2() == 1 else self.function.map(x.size2())
        return function(*parts)
