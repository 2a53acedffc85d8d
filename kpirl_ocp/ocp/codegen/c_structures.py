"""The C interface of `kpirl_mpc.h` in ctypes, for the dimensions of one exported folder."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np

from kpirl_ocp.types import Array

INPUT = ("state", "context", "psi", "schedule")
NUMBERS = ("objective", "residual", "stationarity", "feasibility", "complementarity", "scale")
SETTINGS = ("max_iterations", "steps", "tolerance", "barrier", "time_limit", "now", "clock")


def arrays_of(sizes: Mapping[str, int]) -> dict[str, tuple[int, ...]]:
    """Shapes of a solution's arrays, by their names there and in a guess; sizes as in the manifest."""
    steps, n_s, n_u = (sizes[name] for name in ("horizon", "n_states", "n_actions"))
    return {
        "states": (steps + 1, n_s),
        "actions": (steps, n_u),
        "dynamics": (steps, n_s),
        "state_bounds": (steps + 1, n_s),
        "action_bounds": (steps, n_u),
        "path": (steps, sizes["n_path"]),
        "path_equality": (steps, sizes["n_path_equality"]),
        "terminal": (sizes["n_terminal"],),
        "terminal_equality": (sizes["n_terminal_equality"],),
    }


@dataclass(frozen=True)
class Structures:
    """The structures of the header. real: float64 or float32."""

    real: Any
    input: type[ctypes.Structure]
    guess: type[ctypes.Structure]
    solution: type[ctypes.Structure]
    gradients: type[ctypes.Structure]
    settings: type[ctypes.Structure]
    shapes: Mapping[str, tuple[int, ...]]

    @classmethod
    def of(cls, sizes: Mapping[str, int], single: bool = False) -> Structures:
        """For the dimensions of a manifest."""
        number = ctypes.c_float if single else ctypes.c_double
        shapes = arrays_of(sizes)

        def array(length: int) -> Any:
            return number * max(length, 1)

        def structure(name: str, fields: list[tuple[str, Any]]) -> type[ctypes.Structure]:
            return type(name, (ctypes.Structure,), {"_fields_": fields})

        pointer = ctypes.c_void_p
        solution = [(name, array(prod(shape))) for name, shape in shapes.items()]
        solution += [(name, number) for name in NUMBERS]
        solution += [("seconds", ctypes.c_double), ("iterations", ctypes.c_int), ("status", ctypes.c_int)]
        lengths = {"psi": sizes["n_parameters"], "state": sizes["n_states"], "context": sizes["n_context"]}
        gradients = [(name, array(length)) for name, length in lengths.items()]
        kinds = (ctypes.c_int, ctypes.c_int, number, number, ctypes.c_double, pointer, pointer)
        return cls(
            real=np.float32 if single else np.float64,
            input=structure("Input", [(name, pointer) for name in INPUT]),
            guess=structure("Guess", [(name, pointer) for name in shapes]),
            solution=structure("Solution", solution),
            gradients=structure("Gradients", [*gradients, ("residual", number), ("pivot", number)]),
            settings=structure("Settings", list(zip(SETTINGS, kinds, strict=True))),
            shapes=shapes,
        )

    def array(self, value: Any) -> Array:
        """A contiguous array of the library's number type; keep it as long as C reads it."""
        return np.ascontiguousarray(value, self.real)


def address(array: Array) -> int | None:
    """Address of an array's numbers, for a pointer in C; None for an empty array."""
    return array.ctypes.data if array.size else None
