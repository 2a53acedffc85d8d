"""A solver as C: the functions, sources and settings that an exported folder is made of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca

from kpirl_ocp.ocp.problem.ocp import OCP


@dataclass(frozen=True)
class Target:
    """A solver as C.

    kind: its name in the manifest. functions: to be generated. sources: hand-written files, without prefix.
    workspace: the header among them with the type of the solver's memory. macros: numbers that they are compiled with.
    steps, max_iterations, tolerance, barrier: the settings of a new controller; see `kpirl_mpc_settings`.
    single_tolerance: the tightest tolerance that makes sense in single precision.
    counts: whether it knows its iterations, and why it stopped.
    """

    kind: str
    functions: Sequence[ca.Function]
    sources: Sequence[str]
    workspace: str
    macros: Mapping[str, int | str]
    steps: int
    max_iterations: int
    tolerance: float
    barrier: float
    single_tolerance: float
    counts: bool = True


def dynamics(problem: OCP) -> ca.Function:
    """(s, u, psi) -> f."""
    inputs = [ca.MX.sym(name, problem.transition.size1_in(i)) for i, name in enumerate(("s", "u", "psi"))]
    return ca.Function("dynamics", inputs, [ca.densify(problem.transition(*inputs))])
