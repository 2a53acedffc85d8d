"""The implicit gradient, compared with the solve that it follows and with unrolling."""

from __future__ import annotations

from bench.part import Numbers, Part, Table
from bench.settings import Preset
from bench.timing import interleaved
from kpirl_ocp import GradientDescent, Implicit, Riccati, Unrolled
from kpirl_ocp.irl.cases.network_cases import NetworkCase
from kpirl_ocp.irl.hypergradients.implicit import differentiate

SOLVE, GRADIENT, BOTH = "solve to 1e-10", "gradient and certificate", "Implicit(Riccati())"


def measure(preset: Preset) -> Part:
    """Random tanh weights and the trained model, bounded."""
    numbers: Numbers = {}
    rows = []
    for data in preset.models("tanh", steps=preset.long_steps):
        numbers[data.name] = _measure(data, preset)
        rows += [[data.name, name, value] for name, value in numbers[data.name].pop("text").items()]
    note = "The solve hands over its derivatives to the gradient. Unrolled takes the same model without bounds."
    title = f"Implicit gradient, T = {preset.paper_horizon}"
    return Part(numbers, [Table(title, ["weights", "", "time [ms]"], rows, note)])


def _measure(data: NetworkCase, preset: Preset) -> Numbers:
    problem, demonstration, psi = data.bounded, data.demonstrations[0], data.psi.ravel()
    solver, method = Riccati(), Implicit(Riccati(), policy="flag")
    unrolled = Unrolled(GradientDescent(data.steps, data.step_size))
    arguments = demonstration.s0, psi, demonstration.context
    unrolling = f"Unrolled, N = {data.steps}"
    solution, derivatives = solver.solve_and_linearise(problem, *arguments)
    calls = {
        SOLVE: lambda: solver.solve(problem, *arguments),
        GRADIENT: lambda: differentiate(problem, demonstration, solution, derivatives=derivatives),
        BOTH: lambda: method(problem, demonstration, psi),
        unrolling: lambda: unrolled(data.problem, demonstration, psi),
    }
    results = {name: call() for name, call in calls.items()}  # builds and compiles
    timings = interleaved(calls, preset.budget, preset.most)
    certificate = results[BOTH].certificate
    text = {name: str(timing) for name, timing in timings.items()}
    text["certificate"] = "certified" if certificate.certified else f"not certified: {' '.join(certificate.failures)}"
    return {
        "text": text,
        "N": data.steps,
        "certified": certificate.certified,
        "iterations": solution.iterations,
        "unrolled": timings[unrolling].numbers,
        **{name: timings[name].numbers for name in (SOLVE, GRADIENT, BOTH)},
    }
