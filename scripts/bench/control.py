"""Ordinary control problems: `Riccati` with default settings, compiled Ipopt, and QP solvers for QPs.

Every solver starts from no action. First solves are those of a problem that nobody has solved before.
"""

from __future__ import annotations

import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np

from bench.control_problems import ControlProblem, problems
from bench.part import Numbers, Part, Table
from bench.qp_peers import NAMES as QP_PEERS
from bench.qp_peers import qp_peers
from bench.settings import Preset
from bench.timing import interleaved
from kpirl_ocp import OCP, Ipopt, Riccati
from kpirl_ocp.ocp.codegen.compiler import EXPORT_FLAGS_NATIVE, find_compiler
from kpirl_ocp.ocp.export import ExportedSolver, export_c
from kpirl_ocp.ocp.sensitivity import sensitivity
from kpirl_ocp.ocp.solvers.instance import Instance, nonlinear_program

OURS, WITHOUT, PEER = "Riccati", "Riccati, no compiler", "Ipopt, compiled functions"
EXPORTED, GRADIENT = "exported controller", "gradient and certificate"
FIRST, FIRST_PEER = "first_riccati_ms", "first_ipopt_ms"
PEERS = (PEER, *QP_PEERS)
COLUMNS = (OURS, WITHOUT, EXPORTED, *PEERS, GRADIENT)
TOLERANCE = 1e-8


def measure(preset: Preset) -> Part:
    """Milliseconds warm and of the first solve, and iterations."""
    numbers: Numbers = {}
    rows = []
    for case in problems(tiny=not preset.trained):
        found = _case(case, preset)
        numbers[case.name] = found
        rows.append([case.name, *(_cell(found.get(name)) for name in COLUMNS), *_firsts(found)])
    header = ["problem", *COLUMNS, "first solve: Riccati", "first solve: Ipopt"]
    note = f"Times [ms] of a cold start to a tolerance of {TOLERANCE:.0e}, medians, with iterations in brackets."
    return Part(numbers, [Table("Control problems", header, rows, note)])


def _cell(found: Numbers | None) -> str:
    if found is None:
        return ""
    iterations = f" ({found['iterations']})" if "iterations" in found else ""
    return f"{found['median_ms']:.3g}{iterations}"


def _firsts(found: Numbers) -> list[str]:
    return [f"{found[name]:.3g}" for name in (FIRST, FIRST_PEER)]


def _case(case: ControlProblem, preset: Preset) -> Numbers:
    first, second = replace(case.problem), replace(case.problem)  # equal, and new to every cache
    firsts = {FIRST: _first(Riccati(tolerance=TOLERANCE), first, case)}
    firsts[FIRST_PEER] = _first(Ipopt(tolerance=TOLERANCE), second, case)
    ours, without = (Riccati(tolerance=TOLERANCE, compile=wish) for wish in (True, False))
    calls: dict[str, Callable[[], object]] = {
        OURS: lambda: ours.solve(*case.arguments),
        WITHOUT: lambda: without.solve(*case.arguments),
        GRADIENT: _gradient(case),
    }
    iterations = dict.fromkeys((OURS, WITHOUT), ours.solve(*case.arguments).iterations)
    with tempfile.TemporaryDirectory() as folder:
        peers = {PEER: _compiled_ipopt(case, Path(folder))}
        if case.name.startswith("LQR"):
            peers |= qp_peers(case, TOLERANCE)
        calls[EXPORTED] = _exported(case, Path(folder), preset)
        for name, (call, count) in peers.items():
            if call is not None:
                calls[name], iterations[name] = call, count
        timings = interleaved(calls, preset.budget, preset.most)
    return firsts | {name: timing.numbers | _count(iterations, name) for name, timing in timings.items()}


def _count(iterations: Mapping[str, int], name: str) -> Numbers:
    return {"iterations": iterations[name]} if name in iterations else {}


def _gradient(case: ControlProblem) -> Callable[[], object]:
    """Of a linear function of the plan, after a solve that hands over its derivatives.

    Gradients run on what the last solve of their problem ran on: machine code, for which an equal problem is needed
    that nobody solves without.
    """
    problem, rng = replace(case.problem), np.random.default_rng(0)
    solver = Riccati(tolerance=TOLERANCE, compile=True)
    solution, derivatives = solver.solve_and_linearise(problem, *case.arguments[1:])
    slopes = [rng.normal(size=part.shape) for part in (solution.states, solution.actions)]
    return lambda: sensitivity(problem, solution, "flag", derivatives).pull(*slopes)


def _exported(case: ControlProblem, folder: Path, preset: Preset) -> Callable[[], object]:
    """The exported controller from the same cold start, called from Python."""
    problem, s0, psi, context = case.arguments
    solver, examples = Riccati(tolerance=TOLERANCE), [(s0, context)]
    written = export_c(problem, solver, folder / "exported", psi=psi, examples=examples)
    flags = tuple(preset.exported_control if flag.startswith("-O") else flag for flag in EXPORT_FLAGS_NATIVE)
    controller = ExportedSolver(written, flags)
    return lambda: controller.solve(*case.arguments)


def _first(solver: Riccati | Ipopt, problem: OCP, case: ControlProblem) -> float:
    started = time.perf_counter()
    solver.solve(problem, *case.arguments[1:])
    return 1e3 * (time.perf_counter() - started)


def _compiled_ipopt(case: ControlProblem, folder: Path) -> tuple[Callable[[], object] | None, int]:
    """Ipopt on the same program, with its functions as machine code."""
    problem, command = case.problem, find_compiler()
    if command is None:
        return None, 0
    settings = {"tol": TOLERANCE, "print_level": 0, "sb": "yes", "nlp_scaling_method": "none"}
    options = {"ipopt": settings, "print_time": False}
    own = ca.nlpsol("peer", "ipopt", nonlinear_program(problem), options)
    own.generate_dependencies("peer.c", {"with_header": False})
    source, library = Path("peer.c"), folder / "peer.so"
    source.rename(folder / "peer.c")
    subprocess.run(
        [command, "-O1", "-Wno-int-conversion", "-fPIC", "-shared", str(folder / "peer.c"), "-o", str(library), "-lm"],
        check=True,
    )
    solver = ca.nlpsol("peer", "ipopt", str(library), options)
    given = Instance.of(*case.arguments, None).arguments(None)
    solver(**given)
    return (lambda: solver(**given)), int(solver.stats()["iter_count"])
