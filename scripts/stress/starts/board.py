"""Iterations of `Riccati` and `Ipopt` from the same noisy starts: their ratio, and what one of them loses."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from bench.part import Part, Table
from tqdm import tqdm

from kpirl_ocp import Ipopt, Riccati, Solution, Status
from kpirl_ocp.ocp.problem.solver import Solver
from stress.settings import Profile
from stress.starts.systems import SYSTEMS, Start

REPORTED = 100_000  # seeds from here on are reported; those below are there to develop on
MANY = 1.5  # times as many iterations as Ipopt
_NOTE = (
    "Seeds from {first} on; the solver is developed on others. s_0 is moved by a tenth of the sizes that states have "
    "in the plan, the guess by noise of 0, 0.1, 0.3 and 1 times the sizes of states and actions at every stage. "
    "Ratios are of the starts from which both converge. Lost: only Ipopt does; won: only Riccati."
)


class Run(NamedTuple):
    """Iterations, and whether it converged."""

    iterations: int
    converged: bool


Pairs: TypeAlias = dict[str, list[tuple[Run, Run]]]
"""Runs of `Riccati` and `Ipopt` by system."""


def measure(profile: Profile) -> Part:
    """Ratios of iterations by system, at seeds that are reported."""
    pairs = race({name: build().start for name, build in SYSTEMS.items()}, reported(profile.starts))
    return part("Iterations from noisy starts, Riccati / Ipopt", "system", pairs, _NOTE.format(first=REPORTED))


def reported(count: int) -> range:
    """The first seeds that the solver is not developed on."""
    return range(REPORTED, REPORTED + count)


def race(systems: Mapping[str, Callable[[int], Start]], seeds: Iterable[int]) -> Pairs:
    """Runs of `Riccati` and `Ipopt` from each start of each system, whose starts are drawn by seed."""
    starts = [(name, seed) for name in systems for seed in seeds]
    pairs: Pairs = {name: [] for name in systems}
    for name, seed in tqdm(starts, "starts", unit="start"):
        given = systems[name](seed)
        plans = [solved_quietly(solver, *given) for solver in (Riccati(), Ipopt())]
        runs = [Run(plan.iterations, plan.status is Status.CONVERGED) for plan in plans]
        pairs[name].append((runs[0], runs[1]))
    return pairs


def solved_quietly(solver: Solver, *given: Any) -> Solution:
    """The solution for these arguments of `Solver.solve`, without warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return solver.solve(*given)


def part(title: str, what: str, pairs: Pairs, note: str) -> Part:
    """A row for each system, and one for all."""
    numbers = {name: summary(found) for name, found in pairs.items()}
    numbers["all"] = summary([pair for found in pairs.values() for pair in found])
    header = [what, "starts", "both converge", "mean ratio", f"above {MANY}", "largest", "lost", "won"]
    keys = ["starts", "both", "mean", "many", "largest", "lost", "won"]
    rows = [[name, *(_cell(row[key]) for key in keys)] for name, row in numbers.items()]
    return Part(numbers, [Table(title, header, rows, note)])


def summary(pairs: list[tuple[Run, Run]]) -> Mapping[str, Any]:
    """Counts, and the geometric mean and the largest of the ratios of iterations; NaN where there is none."""
    ratios = [ours.iterations / theirs.iterations for ours, theirs in pairs if ours.converged and theirs.converged]
    return {
        "starts": len(pairs),
        "both": len(ratios),
        "mean": float(np.exp(np.mean(np.log(ratios)))) if ratios else np.nan,
        "largest": max(ratios, default=np.nan),
        "many": sum(ratio > MANY for ratio in ratios),
        "lost": sum(theirs.converged and not ours.converged for ours, theirs in pairs),
        "won": sum(ours.converged and not theirs.converged for ours, theirs in pairs),
    }


def _cell(number: float) -> str:
    return f"{number:.2f}" if isinstance(number, float) else str(number)
