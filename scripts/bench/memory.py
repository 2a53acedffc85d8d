"""Peak memory of a fresh process while one gradient is built, compiled and evaluated.

Every entry is a process of its own; a C compiler that it starts is not counted. The peak is read from /proc, which
only Linux has.
"""

from __future__ import annotations

import importlib.util
import multiprocessing
from concurrent.futures import ProcessPoolExecutor

from bench.contenders import NOT_INSTALLED, find
from bench.part import Numbers, Part, Table
from bench.problem import random_network
from bench.real_time import BARRIER
from bench.settings import Preset
from kpirl_ocp import GradientDescent, Implicit, Riccati, Unrolled
from kpirl_ocp.irl.learning.comparison import peak_memory, reset_peak_memory

UNROLLED, CHECKPOINTS, IMPLICIT = "Unrolled", "Unrolled, checkpoints", "Implicit(Riccati)"


def measure(preset: Preset) -> Part:
    """Contenders at the paper's N and T; then ours against the number of inner iterations."""
    contenders = {name: _apart(_contender, preset, name) for name in preset.remembered}
    by_count = {
        method: {str(count): _apart(_iterations, preset, method, count) for count in preset.counts}
        for method in (UNROLLED, CHECKPOINTS, IMPLICIT)
    }
    numbers: Numbers = {"contenders": contenders, "iterations": by_count}
    rows = [[name, NOT_INSTALLED if value is None else f"{value:.1f}"] for name, value in contenders.items()]
    at_paper = f"T = {preset.paper_horizon}, N = {preset.paper_steps}"
    return Part(
        numbers,
        [
            Table(
                f"Peak memory of one unrolled hypergradient, {at_paper}",
                ["", "[MB]"],
                rows,
                "Beyond what the process holds after its imports; building, compiling and the call included.",
            ),
            Table(
                f"Peak memory of ours over the number of inner iterations [MB], T = {preset.paper_horizon}",
                ["", *(f"{count} iterations" for count in preset.counts)],
                [[method, *(f"{value:.1f}" for value in row.values())] for method, row in by_count.items()],
                "Iterations are gradient steps for Unrolled and Newton steps for Implicit.",
            ),
        ],
    )


def _apart(task, *arguments: object) -> float | None:
    """The task's peak [MB] in a process of its own."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(task, *arguments).result()


def _contender(preset: Preset, name: str) -> float | None:
    data = random_network(preset.hidden, preset.paper_horizon, preset.paper_steps)
    prepare = find(name)
    if prepare is None:
        return None
    if name.startswith("JAX") and importlib.util.find_spec("jax"):
        import jax

        jax.block_until_ready(jax.numpy.zeros(1) + 1)  # JAX starts at its first use
    before = reset_peak_memory()
    prepare(data)()
    return (peak_memory() - before) / 2**20


def _iterations(preset: Preset, method: str, count: int) -> float:
    data = random_network(preset.hidden, preset.paper_horizon, count, "tanh")
    demonstration, psi = data.demonstrations[0], data.psi.ravel()
    before = reset_peak_memory()
    if method == IMPLICIT:  # the steps go on at the solution
        problem, solver = data.bounded, Riccati(barrier=BARRIER)
        guess = solver.solve(problem, demonstration.s0, psi, demonstration.context)
        implicit = Implicit(Riccati(steps=count, barrier=BARRIER), policy="flag")
        implicit(problem, demonstration, psi, guess)
    else:
        solver = GradientDescent(count, data.step_size * min(1.0, 20 / count))
        Unrolled(solver, policy="flag", checkpoint=method == CHECKPOINTS)(data.problem, demonstration, psi)
    return (peak_memory() - before) / 2**20
