"""Random problems with any features together: what each solver says of them is confirmed independently."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from typing import Any

from bench.part import Part, Table
from test_random_problems import random_case
from test_random_statements import Drawing
from tqdm import tqdm

from kpirl_ocp import SQP, Fatrop, Ipopt, Riccati, Solution, Status
from stress.settings import Profile
from stress.starts.board import MANY, Pairs, Run, solved_quietly, summary
from stress.statuses.whole import Whole

SOLVERS = {"Riccati": Riccati(), "Ipopt": Ipopt(), "Fatrop": Fatrop(), "SQP": SQP()}
COLUMNS = (
    "converged, confirmed",
    "converged, not confirmed",
    "infeasible, confirmed",
    "infeasible, but a feasible point was found",
    "gave up on a feasible one",
    "gave up on an infeasible one",
)
_NOTE = (
    "Confirmed: scipy finds multipliers that balance the gradient at the plan, which is feasible; or Ipopt, minimising "
    "the sum of all violations from four places, finds no feasible point."
)


def measure(profile: Profile) -> Part:
    """Counts of what each solver said, by whether it is so; and iterations of `Riccati` beside Ipopt's."""
    counts, wrong, pairs = count(profile.statuses)
    rows = [[name, *(counts[name][column] for column in COLUMNS)] for name in SOLVERS]
    numbers = {name: dict(tally) for name, tally in counts.items()} | {"wrong": wrong}
    numbers["ratios"] = {name: summary(found) for name, found in pairs.items()}
    title = f"Statuses of {profile.statuses} random problems"
    return Part(numbers, [Table(title, ["solver", *COLUMNS], rows, _NOTE), _iterations(numbers["ratios"])])


def _iterations(ratios: Mapping[str, Mapping[str, Any]]) -> Table:
    header = ["both say", "problems", "mean ratio", f"above {MANY}", "largest"]
    rows = [[name, r["both"], f"{r['mean']:.3f}", r["many"], f"{r['largest']:.2f}"] for name, r in ratios.items()]
    return Table("Iterations on these problems, Riccati / Ipopt", header, rows)


def count(problems: int) -> tuple[dict[str, Counter], list[tuple[str, int]], Pairs]:
    """Columns by solver; the pairs of solver and problem whose status is wrong; runs of equal status, by that."""
    counts: dict[str, Counter] = defaultdict(Counter)
    wrong = []
    pairs: Pairs = {status.name: [] for status in (Status.CONVERGED, Status.INFEASIBLE)}
    for seed in tqdm(range(problems), "statuses", unit="problem"):
        problem, numbers = random_problem(seed)
        whole = Whole(problem, *numbers)
        feasible = _once(lambda whole=whole: whole.least_violation() < 1e-6)
        found = {name: solved_quietly(solver, problem, *numbers) for name, solver in SOLVERS.items()}
        for name, plan in found.items():
            column = _column(plan, whole, feasible)
            counts[name][column] += 1
            if column in (COLUMNS[1], COLUMNS[3]):
                wrong.append((name, seed))
        ours, theirs = found["Riccati"], found["Ipopt"]
        if ours.status is theirs.status and ours.status.name in pairs:
            pairs[ours.status.name].append((Run(ours.iterations, True), Run(theirs.iterations, True)))
    return counts, wrong, pairs


def random_problem(seed: int):
    """Statements with any features; every other time nonlinear dynamics, with constraints that may not be met."""
    if seed % 2 == 0:
        return Drawing(seed).problem()
    problem, demonstration, psi = random_case(seed)
    return problem, (demonstration.s0, psi, demonstration.context)


def _column(found: Solution, whole: Whole, feasible: Callable[[], bool]) -> str:
    if found.status is Status.CONVERGED:
        return COLUMNS[0] if whole.stationary(found.trajectory) else COLUMNS[1]
    if found.status is Status.INFEASIBLE:
        return COLUMNS[3] if feasible() else COLUMNS[2]
    return COLUMNS[4] if feasible() else COLUMNS[5]


def _once(ask: Callable[[], bool]) -> Callable[[], bool]:
    """Asked at most once."""
    answers: list[bool] = []

    def answer() -> bool:
        if not answers:
            answers.append(ask())
        return answers[0]

    return answer
