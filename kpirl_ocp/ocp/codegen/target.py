"""A solver as C: the functions, sources and settings that an exported folder is made of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.problem.ocp import OCP


@dataclass(frozen=True)
class Target:
    """A solver as C.

    kind: its name in the manifest. functions: to be generated, with named inputs and outputs. interfaces: of those that
    share structures, see `portable_c`. transition: name of the one that gives the successor of a stage.
    sources: hand-written files, without prefix; with_core: those of the interior-point method, too.
    workspace: the header among them with the type of the solver's memory. macros: numbers that they are compiled with.
    data: C to append to the file of constants.
    steps, max_iterations, tolerance, barrier: the settings of a new controller; see `kpirl_mpc_settings`.
    single_tolerance: the tightest tolerance that makes sense in single precision.
    restores: whether it looks for a feasible point where it gets stuck, and may end as INFEASIBLE.
    """

    kind: str
    functions: Sequence[ca.Function]
    interfaces: Mapping[str, str]
    transition: str
    sources: Sequence[str]
    workspace: str
    macros: Mapping[str, int | str]
    steps: int
    max_iterations: int
    tolerance: float
    barrier: float
    single_tolerance: float
    with_core: bool = False
    data: str = ""
    restores: bool = True


def dynamics(problem: OCP) -> ca.Function:
    """(x, psi, context, schedule) -> successor, with the interface of a stage; of dynamics f(s, u, psi)."""
    lengths = {"x": problem.n_states + problem.n_actions, "psi": problem.n_parameters, "context": problem.n_context}
    lengths["schedule"] = np.asarray(problem.schedule).shape[1]
    inputs = {name: ca.MX.sym(name, length) for name, length in lengths.items()}
    x, psi, context, d = inputs.values()
    successor = problem.dynamics(x[: problem.n_states], x[problem.n_states :], psi, context, d)
    return named("dynamics", inputs, {"successor": successor})


def named(name: str, inputs: Mapping[str, ca.MX | ca.SX], outputs: Mapping[str, ca.MX | ca.SX]) -> ca.Function:
    """A function with named inputs and outputs; the outputs are dense."""
    dense = [ca.densify(output) for output in outputs.values()]
    return ca.Function(name, list(inputs.values()), dense, list(inputs), list(outputs))
