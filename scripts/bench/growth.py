"""Growth of time with the horizon: one iteration of the solver, the whole solve, and the implicit gradient."""

from __future__ import annotations

from bench.part import Numbers, Part, Table
from bench.problem import random_network
from bench.settings import Preset
from bench.timing import interleaved
from kpirl_ocp import Riccati
from kpirl_ocp.irl.hypergradients.implicit import differentiate


def measure(preset: Preset) -> Part:
    """Random tanh weights, bounded, for each T."""
    calls, iterations, status = {}, {}, {}
    for horizon in preset.growing:
        data = random_network(preset.hidden, horizon, 1, "tanh")
        problem, demonstration, psi = data.bounded, data.demonstrations[0], data.psi.ravel()
        arguments = problem, demonstration.s0, psi, demonstration.context
        solution = Riccati().solve(*arguments)
        iterations[horizon], status[horizon] = solution.iterations, solution.status
        calls[horizon, "solve"] = lambda arguments=arguments: Riccati().solve(*arguments)
        calls[horizon, "gradient"] = lambda inputs=(problem, demonstration, solution): differentiate(*inputs)
        calls[horizon, "gradient"]()  # builds and compiles
    timings = interleaved(calls, preset.budget, preset.most)
    numbers: Numbers = {
        str(horizon): {
            "iterations": iterations[horizon],
            "status": status[horizon].name,
            "solve": timings[horizon, "solve"].numbers,
            "iteration_ms": 1e3 * timings[horizon, "solve"].median / max(iterations[horizon], 1),
            "gradient": timings[horizon, "gradient"].numbers,
        }
        for horizon in preset.growing
    }
    rows = [
        [
            horizon,
            timings[horizon, "solve"],
            iterations[horizon],
            f"{numbers[str(horizon)]['iteration_ms']:.3g}",
            timings[horizon, "gradient"],
            status[horizon].name,
        ]
        for horizon in preset.growing
    ]
    header = ["T", "solve [ms]", "iterations", "ms per iteration", "gradient and certificate [ms]", "ended"]
    return Part(numbers, [Table("Growth with the horizon, Riccati to 1e-10, tanh, random weights", header, rows)])
