"""Random problems with any features together: what each solver says of them is confirmed independently."""

from __future__ import annotations

import warnings
from collections import Counter, defaultdict
from collections.abc import Callable

from bench.part import Part, Table
from test_random_problems import random_case
from test_random_statements import Drawing
from tqdm import tqdm

from kpirl_ocp import SQP, Fatrop, Ipopt, Riccati, Solution, Status
from stress.settings import Profile
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
    """Counts of what each solver said, by whether it is so."""
    counts, wrong = count(profile.statuses)
    rows = [[name, *(counts[name][column] for column in COLUMNS)] for name in SOLVERS]
    numbers = {name: dict(tally) for name, tally in counts.items()} | {"wrong": wrong}
    title = f"Statuses of {profile.statuses} random problems"
    return Part(numbers, [Table(title, ["solver", *COLUMNS], rows, _NOTE)])


def count(problems: int) -> tuple[dict[str, Counter], list[tuple[str, int]]]:
    """Columns by solver, and the pairs of solver and problem whose status is wrong."""
    counts: dict[str, Counter] = defaultdict(Counter)
    wrong = []
    for seed in tqdm(range(problems), "statuses", unit="problem"):
        problem, numbers = random_problem(seed)
        whole = Whole(problem, *numbers)
        feasible = _once(lambda whole=whole: whole.least_violation() < 1e-6)
        for name, solver in SOLVERS.items():
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                column = _column(solver.solve(problem, *numbers), whole, feasible)
            counts[name][column] += 1
            if column in (COLUMNS[1], COLUMNS[3]):
                wrong.append((name, seed))
    return counts, wrong


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
