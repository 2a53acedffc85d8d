"""The unrolled hypergradient, one demonstration: torch, JAX, plain CasADi and ours over N and T."""

from __future__ import annotations

from dataclasses import dataclass, field

from bench.contenders import ALONE, JAX, NAMES
from bench.part import Numbers, Part, Table
from bench.problem import random_network
from bench.race import Result, fastest, race
from bench.settings import Preset
from kpirl_ocp.irl.cases.network_cases import N_Q, N_Z, NetworkCase


@dataclass
class _Patience:
    """Leaves out what would take longer than the patience, judged by the longest case that each one has done."""

    limit: float
    done: dict[str, tuple[int, float]] = field(default_factory=dict)

    def reason(self, name: str, size: int) -> str | None:
        """Why a case of size N T is left out, or None."""
        smaller, spent = self.done.get(name, (size, 0.0))
        if spent * size / smaller <= self.limit:
            return None
        return f"left out: N T = {smaller} took {spent:.3g} s, this is {size / smaller:.3g} times that"

    def remember(self, name: str, size: int, result: Result) -> None:
        """A call's time, which grows at least like N T."""
        if result.timing is not None and size >= self.done.get(name, (0, 0.0))[0]:
            self.done[name] = size, result.timing.median


def measure(preset: Preset) -> Part:
    """The grid of N and T on random ReLU weights; then all models at the paper's N and T."""
    numbers: Numbers = {"grid": {}, "paper": {}}
    grid, paper = [], []
    patience = _Patience(preset.patience)
    for horizon in preset.horizons:
        for steps in preset.steps:
            results = _race(random_network(preset.hidden, horizon, steps), preset, patience)
            numbers["grid"][f"T = {horizon}, N = {steps}"] = {name: r.numbers for name, r in results.items()}
            grid.append([horizon, steps, *_cells(results)])
    for data in preset.models("relu", "tanh"):
        results = race(data, (*NAMES, ALONE), preset)
        numbers["paper"][data.name] = {name: r.numbers for name, r in results.items()}
        paper += [[data.name, name, r, f"{r.first:.2f}", f"{r.error:.0e}"] for name, r in results.items()]
    at_paper = f"T = {preset.paper_horizon}, N = {preset.paper_steps}"
    return Part(
        numbers,
        [
            Table(
                f"Unrolled hypergradient [ms], {_layers(preset)}, ReLU, random weights, one demonstration",
                ["T", "N", *NAMES],
                grid,
                "Median (10 - 90 %) of calls taken in turns, float64. Ours is the public call with its certificate. "
                "All agree with ours; the largest difference is in metrics.json.",
            ),
            Table(
                f"Unrolled hypergradient at {at_paper}",
                ["weights", "", "time [ms]", "first call [s]", "difference from ours"],
                paper,
                "The first call builds and compiles, with an empty cache.",
            ),
        ],
    )


def _race(data: NetworkCase, preset: Preset, patience: _Patience) -> dict[str, Result]:
    size = data.steps * data.horizon
    results = race(data, NAMES, preset, lambda name: patience.reason(name, size))
    for name, result in results.items():
        patience.remember(name, size, result)
    return results


def _cells(results: dict[str, Result]) -> list[str]:
    """The faster of the two JAX variants in bold."""
    best = fastest(results, JAX)
    return [f"**{r}**" if name == best else str(r) for name, r in results.items()]


def _layers(preset: Preset) -> str:
    return "-".join(map(str, (N_Z + 3 * N_Q, *preset.hidden, N_Z)))
