"""The C interface of `kpirl_mpc.h` in ctypes, for the dimensions of one exported folder."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from kpirl_ocp.types import Array

INPUT = ("state", "context", "psi")
GUESS = ("states", "actions", "dynamics", "state_bounds", "action_bounds", "path")
NUMBERS = ("objective", "residual", "stationarity", "feasibility", "complementarity", "scale")
SETTINGS = ("max_iterations", "steps", "tolerance", "barrier", "time_limit", "now", "clock")


@dataclass(frozen=True)
class Structures:
    """The structures of the header. real: float64 or float32."""

    real: Any
    input: type[ctypes.Structure]
    guess: type[ctypes.Structure]
    solution: type[ctypes.Structure]
    gradients: type[ctypes.Structure]
    settings: type[ctypes.Structure]
    shapes: Mapping[str, tuple[int, int]]

    @classmethod
    def of(cls, sizes: Mapping[str, int], single: bool = False) -> Structures:
        """For the dimensions of a manifest."""
        number = ctypes.c_float if single else ctypes.c_double
        steps, n_s, n_u, n_h = (sizes[name] for name in ("horizon", "n_states", "n_actions", "n_path"))
        shapes = dict(
            zip(
                GUESS,
                [(steps + 1, n_s), (steps, n_u), (steps, n_s), (steps, n_s), (steps, n_u), (steps, n_h)],
                strict=True,
            )
        )

        def array(length: int) -> Any:
            return number * max(length, 1)

        def structure(name: str, fields: list[tuple[str, Any]]) -> type[ctypes.Structure]:
            return type(name, (ctypes.Structure,), {"_fields_": fields})

        pointer = ctypes.c_void_p
        solution = [(name, array(rows * columns)) for name, (rows, columns) in shapes.items()]
        solution += [(name, number) for name in NUMBERS]
        solution += [("seconds", ctypes.c_double), ("iterations", ctypes.c_int), ("status", ctypes.c_int)]
        lengths = {"psi": sizes["n_parameters"], "state": n_s, "context": sizes["n_context"]}
        gradients = [(name, array(length)) for name, length in lengths.items()]
        kinds = (ctypes.c_int, ctypes.c_int, number, number, ctypes.c_double, pointer, pointer)
        return cls(
            real=np.float32 if single else np.float64,
            input=structure("Input", [(name, pointer) for name in INPUT]),
            guess=structure("Guess", [(name, pointer) for name in GUESS]),
            solution=structure("Solution", solution),
            gradients=structure("Gradients", [*gradients, ("residual", number), ("pivot", number)]),
            settings=structure("Settings", list(zip(SETTINGS, kinds, strict=True))),
            shapes=shapes,
        )

    def array(self, value: Any) -> Array:
        """A contiguous array of the library's numbers, which must be kept while C reads it."""
        return np.ascontiguousarray(value, self.real)


def address(array: Array) -> int | None:
    """For a pointer; None for an empty array."""
    return array.ctypes.data if array.size else None
