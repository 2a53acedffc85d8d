"""The exported controller: time per solve in a closed loop in C, size and memory of the library, time to compile it.

The loop is `test/timing.c` of the exported folder: the plant is the model with a little noise on its keypoints, and the
goal moves on a circle. Python's solvers run the same kind of loop, for fewer steps.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from bench.part import Numbers, Part, Table
from bench.problem import random_network
from bench.real_time import BARRIER, NOISE, RADIUS, moving_goal
from bench.settings import Preset
from kpirl_ocp import Ipopt, Riccati, Solution
from kpirl_ocp.irl.cases.network_cases import N_Z, NetworkCase, placing_case
from kpirl_ocp.ocp.codegen.compiler import EXPORT_FLAGS, EXPORT_FLAGS_NATIVE
from kpirl_ocp.ocp.export import ExportedSolver, export_c
from kpirl_ocp.ocp.problem.solver import Solver
from kpirl_ocp.ocp.solvers.sqp import SQP

REAL_TIME, CONVERGED = "real-time iteration", "converged to 1e-8"
SOLVERS = {REAL_TIME: Riccati(steps=1, barrier=BARRIER), CONVERGED: Riccati(1e-8)}
SETTINGS = {REAL_TIME: ("1", str(BARRIER), "1e-8"), CONVERGED: ("0", "0", "1e-8")}  # steps, barrier, tolerance
FLOAT, NATIVELY = "native, single precision", "native"
SEQUENTIAL = "sqpmethod and qrqp, once"
BUILDS = {"portable": EXPORT_FLAGS, NATIVELY: EXPORT_FLAGS_NATIVE, FLOAT: (*EXPORT_FLAGS_NATIVE, "-DKPIRL_MPC_FLOAT")}

_FEWER = 10  # so many times fewer steps that converge
_SLOW = 5  # steps of Ipopt, which takes a hundred times as long


def measure(preset: Preset) -> Part:
    """Both forms of the interior-point method in every build, then the solvers in Python."""
    numbers: Numbers = {}
    rows: list[list[object]] = []
    for horizon in preset.exported:
        data = placing_case(horizon, 20) if preset.trained else random_network(preset.hidden, horizon, 20, "tanh")
        builds = {name: _with(preset.optimisation, flags) for name, flags in BUILDS.items()}
        found = {
            **_exported(data, builds, preset.exported_steps),
            **_in_python(data, builds[NATIVELY], preset.control_steps),
        }
        if horizon == min(preset.exported):
            found[SEQUENTIAL] = _closed_loop(data, SQP(1e-6, 20), 1, warm=False)
        numbers[str(horizon)] = found
        rows += [[horizon, name, *_cells(result)] for name, result in found.items()]
    header = ["T", "controller", "median [ms]", "least", "99 %", "worst", "iterations", "library [kB]", "memory [kB]"]
    title = f"Exported controller, {preset.exported_steps} warm-started steps in closed loop (converged: a tenth)"
    note = _compile_times(numbers)
    return Part(numbers, [Table(title, [*header], rows, f"{note}.")])


def _compile_times(numbers: Numbers) -> str:
    found = {
        build: [r["compile_s"] for f in numbers.values() for name, r in f.items() if name.endswith(build)]
        for build in BUILDS
    }
    return "Compiling takes " + "; ".join(
        f"{min(times):.1f} to {max(times):.1f} s ({build})" for build, times in found.items()
    )


def _cells(result: Numbers) -> list[str]:
    times = [f"{result[key]:.3g}" for key in ("median_ms", "minimum_ms", "p99_ms", "worst_ms")]
    sizes = [f"{result[key] / 1000:.0f}" if key in result else "" for key in ("library_bytes", "bytes")]
    return [*times, f"{result['iterations']:.1f}", *sizes]


def _with(optimisation: str, flags: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(optimisation if flag.startswith("-O") else flag for flag in flags)


def _exported(data: NetworkCase, builds: dict[str, tuple[str, ...]], steps: int) -> dict[str, Numbers]:
    found = {}
    with tempfile.TemporaryDirectory() as scratch:
        examples = [(data.s0[0], data.goal[0])]
        folder = export_c(data.bounded, SOLVERS[REAL_TIME], Path(scratch), psi=data.psi.ravel(), examples=examples)
        for build, flags in builds.items():
            library, compiled = _compile(folder, flags)
            program = _loop(folder, library, flags)
            for form, settings in SETTINGS.items():
                if build == FLOAT and form == CONVERGED:
                    continue  # 1e-8 is out of reach
                count = steps if form == REAL_TIME else max(steps // _FEWER, 1)
                command = [str(program), str(count), str(NOISE), str(RADIUS), *settings]
                output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
                found[f"C, {form}, {build}"] = json.loads(output) | compiled
    return found


def _compile(folder: Path, flags: tuple[str, ...]) -> tuple[Path, Numbers]:
    """The sources as one library; how long it took, and its size without symbols."""
    library, sources = folder / "controller.so", [str(path) for path in sorted(folder.glob("*.c"))]
    started = time.perf_counter()
    subprocess.run(["cc", *flags, "-fPIC", "-shared", *sources, "-o", str(library), "-lm"], check=True)
    seconds = time.perf_counter() - started
    subprocess.run(["strip", str(library)], check=True)
    return library, {"compile_s": seconds, "library_bytes": library.stat().st_size}


def _loop(folder: Path, library: Path, flags: tuple[str, ...]) -> Path:
    program = folder / "timing"
    linked = [str(folder / "test/timing.c"), str(library), f"-I{folder}", f"-Wl,-rpath,{folder}", "-lm"]
    subprocess.run(["cc", *flags, *linked, "-o", str(program)], check=True)
    return program


def _in_python(data: NetworkCase, flags: tuple[str, ...], steps: int) -> dict[str, Numbers]:
    """The closed loop around solvers that are called from Python, the exported one among them."""
    with tempfile.TemporaryDirectory() as scratch:
        examples = [(data.s0[0], data.goal[0])]
        folder = export_c(data.bounded, SOLVERS[REAL_TIME], scratch, psi=data.psi.ravel(), examples=examples)
        return {
            f"Python, {REAL_TIME}": _closed_loop(data, SOLVERS[REAL_TIME], steps),
            f"ExportedSolver, {REAL_TIME}": _closed_loop(data, ExportedSolver(folder, flags), steps),
            f"Python, {CONVERGED}": _closed_loop(data, SOLVERS[CONVERGED], steps),
            "Ipopt": _closed_loop(data, Ipopt(1e-8), min(steps, _SLOW)),
        }


def _closed_loop(data: NetworkCase, solver: Solver, steps: int, warm: bool = True) -> Numbers:
    """Wall times of warm-started solves."""
    rng, state, psi = np.random.default_rng(0), data.s0[0], data.psi.ravel()
    spent, iterations = [], []
    plan: Solution = Riccati(1e-8, barrier=BARRIER).solve(data.bounded, state, psi, data.goal[0])
    if warm:
        solver.solve(data.bounded, state, psi, data.goal[0], plan)  # builds and compiles
    for step in range(steps):
        goal = moving_goal(data, step)
        started = time.perf_counter()
        plan = solver.solve(data.bounded, state, psi, goal, plan)
        spent.append(1e3 * (time.perf_counter() - started))
        iterations.append(plan.iterations)
        state = np.array(data.bounded.transition(state, plan.actions[0], psi)).ravel()
        state[:N_Z] += NOISE * rng.uniform(-1, 1, N_Z)
    median, high = np.percentile(spent, [50, 99])
    times = {"median_ms": float(median), "minimum_ms": min(spent), "p99_ms": float(high), "worst_ms": max(spent)}
    return times | {"iterations": float(np.mean(iterations)), "steps": steps}
