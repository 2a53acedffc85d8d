"""The bounded OCP solved to the end: ours, Fatrop, Ipopt on the plain MX graph, and Ipopt with our derivatives.

Gradients differ in size from model to model, and a tolerance that is relative to them says little about the objective.
So every solver's objective is compared with that of a reference solved to 1e-10.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bench.part import Numbers, Part, Table
from bench.problem import single
from bench.settings import Preset
from bench.stage_ipopt import StageIpopt
from bench.timing import Timing, interleaved
from kpirl_ocp import Fatrop, Ipopt, Riccati, Solution
from kpirl_ocp.irl.cases.network_cases import NetworkCase
from kpirl_ocp.ocp.problem.solver import Solver
from kpirl_ocp.types import Trajectory

TOLERANCE = 1e-6
SAME = 1e-4  # relative difference of objectives up to which two points count as the same optimum
PLAIN, STAGES, FATROP = "Ipopt, plain MX", "Ipopt, our stage functions", "Fatrop"
RICCATI = {tolerance: f"Riccati, {tolerance:.0e}" for tolerance in (1e-6, 1e-8, 1e-10)}


@dataclass(frozen=True)
class Outcome:
    """The solution of one solver from one start."""

    objective: float
    trajectory: Trajectory
    iterations: int
    word: str
    ok: bool


Solve = Callable[[], Outcome]


def measure(preset: Preset) -> Part:
    """From several starts, with random tanh weights and with the trained model."""
    count = preset.starts
    numbers: Numbers = {}
    rows = []
    for data in preset.models("tanh", count=count):
        found = [_from_start(single(data, index), preset) for index in range(count)]
        numbers[data.name] = {name: [start[name] for start in found] for name in found[0]}
        rows += [[data.name, name, *_row([start[name] for start in found])] for name in found[0]]
    note = (
        f"Means over {count} start(s). Tolerance 1e-6 unless said otherwise. The gap is that of the objective to a "
        "reference solved to 1e-10, relative, the largest over the starts."
    )
    header = ["weights", "solver", "time [ms]", "iterations", "ms per iteration", "gap", "ended"]
    return Part(numbers, [Table(f"Bounded OCP, tanh, T = {preset.paper_horizon}", header, rows, note)])


def _from_start(data: NetworkCase, preset: Preset) -> dict[str, Numbers]:
    arguments = data.s0[0], data.psi.ravel(), data.goal[0]
    stage_ipopt = StageIpopt(data.bounded, TOLERANCE)

    def ours(solver: Solver) -> Solve:
        return lambda: _outcome(solver.solve(data.bounded, *arguments))

    def assembled() -> Outcome:
        objective, trajectory, iterations, word = stage_ipopt.solve(*arguments)
        return Outcome(objective, trajectory, iterations, word, word == "Solve_Succeeded")

    calls = {name: ours(Riccati(tolerance)) for tolerance, name in RICCATI.items()}
    calls |= {FATROP: ours(Fatrop(TOLERANCE, time_limit=None)), STAGES: assembled, PLAIN: ours(Ipopt(TOLERANCE))}
    outcomes = {name: call() for name, call in calls.items()}
    timings = interleaved(calls, preset.budget / preset.starts, preset.most)
    exact = ours(Ipopt())()
    return {name: _numbers(outcomes[name], exact, timings[name]) for name in calls}


def _outcome(solution: Solution) -> Outcome:
    word = solution.status.name
    return Outcome(solution.objective, solution.trajectory, solution.iterations, word, solution.status.ok)


def _numbers(found: Outcome, exact: Outcome, timing: Timing) -> Numbers:
    return {
        **timing.numbers,
        "iterations": found.iterations,
        "status": found.word,
        "ok": found.ok,
        "objective": found.objective,
        "gap": (found.objective - exact.objective) / abs(exact.objective),
        "distance": float(np.abs(found.trajectory.actions - exact.trajectory.actions).max()),
        "reference_ok": exact.ok,
    }


def _row(starts: list[Numbers]) -> list[str]:
    time, iterations = (float(np.mean([start[key] for start in starts])) for key in ("median_ms", "iterations"))
    gap = max((start["gap"] for start in starts), key=abs)
    words = sorted({start["status"] for start in starts})
    return [f"{time:.3g}", f"{iterations:.3g}", f"{time / max(iterations, 1):.3g}", f"{gap:.0e}", ", ".join(words)]


def same_optimum(starts: list[Numbers]) -> bool:
    """Did the solver end well, at the reference's objective, from every start?"""
    return all(start["ok"] and start["reference_ok"] and abs(start["gap"]) <= SAME for start in starts)
