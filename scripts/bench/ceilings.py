"""Speed of dense products on one thread of this machine (numpy's BLAS), and the share that the gradients reach."""

from __future__ import annotations

from functools import partial
from itertools import pairwise

import numpy as np

from bench.contenders import OURS, find
from bench.flops import products
from bench.part import Numbers, Part, Table
from bench.settings import Preset
from bench.timing import Timing, interleaved
from kpirl_ocp import GradientDescent
from kpirl_ocp.irl.cases.network_cases import N_Q, N_Z, NetworkCase
from kpirl_ocp.irl.hypergradients.loss import squared_distance
from kpirl_ocp.irl.hypergradients.unrolled_graph import unrolled_function

_SQUARES = (64, 128, 192, 256)  # the largest fills half a megabyte
_WORK = 4e6  # operations in one timed call


def measure(preset: Preset) -> Part:
    """Ceilings of matrix times vector and matrix times matrix; then the rates of unrolled gradients."""
    columns = preset.demonstrations
    shapes = [*_layers(preset), *((n, n) for n in _SQUARES)]
    vectors, matrices = ({shape: rate(*shape, width, preset) for shape in shapes} for width in (1, columns))
    squares = {n: rate(n, n, n, preset) for n in _SQUARES}
    ceilings = {
        "matrix-vector": max(vectors.values()),
        "matrix-matrix": max(*matrices.values(), *squares.values()),
    }
    rows = [[f"{m} x {n}", f"{vectors[m, n]:.1f}", f"{matrices[m, n]:.1f}"] for m, n in shapes]
    rows += [[f"{n} x {n} times {n} x {n}", "", f"{value:.1f}"] for n, value in squares.items()]

    achieved, numbers = [], {}
    for data in (*preset.models("relu"), *preset.models("relu", count=columns)):
        count = len(data.s0)
        ceiling = ceilings["matrix-vector" if count == 1 else "matrix-matrix"]
        operations, timing = work(data), _time(data, preset)
        speed = operations / timing.median / 1e9
        numbers[f"{data.name}, {count}"] = {"mflop": operations / 1e6, "gflop_per_s": speed, **timing.numbers}
        share = f"{speed / ceiling:.0%}"
        achieved.append([data.name, count, f"{operations / 1e6:.1f}", timing, f"{speed:.1f}", share])
    results: Numbers = {"ceilings_gflop_per_s": ceilings, "achieved": numbers}
    note = (
        f"Stacks of products in one call of `numpy.matmul`. Ceilings: {ceilings['matrix-vector']:.1f} GFLOP/s "
        f"matrix-vector and {ceilings['matrix-matrix']:.1f} GFLOP/s matrix-matrix."
    )
    return Part(
        results,
        [
            Table("Ceilings of this machine [GFLOP/s], one thread", ["matrix", "x 1", f"x {columns}"], rows, note),
            Table(
                f"Achieved by the unrolled gradient, T = {preset.paper_horizon}, N = {preset.paper_steps}",
                ["weights", "demonstrations", "MFLOP in products", "time [ms]", "GFLOP/s", "of the ceiling"],
                achieved,
                "Counted in the graph of the gradient. The time is that of the public call: element-wise work, the "
                "audit and the certificate, which may take the steps twice more, are in it and not in the count. One "
                "demonstration is held against the matrix-vector ceiling, several against the matrix-matrix ceiling.",
            ),
        ],
    )


def rate(m: int, k: int, n: int, preset: Preset) -> float:
    """GFLOP/s of (m, k) times (k, n), the better of both memory layouts, by the median call."""
    rng, count = np.random.default_rng(0), max(1, round(_WORK / (2 * m * k * n)))
    matrix, vectors = rng.normal(size=(m, k)), rng.normal(size=(count, k, n))
    out = np.empty((count, m, n))
    calls = {order: partial(np.matmul, np.array(matrix, order=order), vectors, out=out) for order in ("C", "F")}
    timings = interleaved(calls, preset.budget / 20, preset.most)
    return 2 * m * k * n * count / min(timing.median for timing in timings.values()) / 1e9


def work(data: NetworkCase) -> int:
    """Operations in the products of our unrolled gradient, for all demonstrations."""
    solver, count = GradientDescent(data.steps, data.step_size), len(data.s0)
    return products(unrolled_function(data.problem, solver, squared_distance, data.steps, False, count))


def _time(data: NetworkCase, preset: Preset) -> Timing:
    evaluate = find(OURS)(data)
    evaluate()
    return interleaved({OURS: evaluate}, preset.budget, preset.most)[OURS]


def _layers(preset: Preset) -> list[tuple[int, int]]:
    widths = (N_Z + 3 * N_Q, *preset.hidden, N_Z)
    return [(m, n) for n, m in pairwise(widths)]
