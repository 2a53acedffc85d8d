"""The contest: every case is differentiated once, and its certificate is judged."""

from __future__ import annotations

import warnings
from collections import Counter, defaultdict

from bench.part import Part, Table
from tqdm import tqdm

from stress.certificates.families import draw
from stress.certificates.verdicts import METHODS, Verdict, healthy, judge, stated
from stress.settings import Profile

_NOTE = (
    "Half of the cases are in units drawn over twelve orders of magnitude of the cost, and six of states, actions and "
    "parameters each. Right: every entry within 1e-3 of the known gradient, relative to its terms. "
    "A certificate is due where the problem is smooth within a distance of 1e-2 and the solver is given what it needs; "
    "a flag there counts as 'though right', and the last column is the share of these that were certified."
)
_OTHERS = (
    "Those in units that are not drawn. Unrolled: 100 steps of gradient descent, which takes no constraints but "
    "constant bounds of actions; others are not counted. Its derivative is right if it is that of the minimiser or the "
    "slope to both sides of what the steps make of psi. A certificate is due where the steps end below where they "
    "began, and what they make of psi is smooth within a hundredth of it: its Chebyshev series ends, measured without "
    "derivatives."
)


def measure(profile: Profile) -> Part:
    """Counts of verdicts for every family and in all, and the numbers of those that are wrong."""
    counts, wrong = count(range(profile.cases))
    total = sum(counts.values(), Counter())
    rows = [_row(name, counts[name]) for name in sorted(counts)] + [_row("**all**", total)]
    header = ["cases", "counted", *(verdict.value for verdict in Verdict), "of those due"]
    numbers = {name: {verdict.name: tally[verdict] for verdict in Verdict} for name, tally in counts.items()}
    results = {"families": numbers, "wrong": wrong, "healthy": healthy(total)}
    others = {name: count(range(0, 2 * profile.others, 2), name) for name in METHODS if name != "Implicit"}
    for name, (tally, bad) in others.items():
        results[name] = {verdict.name: sum(tally.values(), Counter())[verdict] for verdict in Verdict} | {"wrong": bad}
        results["wrong"] = results["wrong"] + bad
    tables = [
        Table(f"Certificates of {profile.cases} generated cases", header, rows, _NOTE),
        Table(
            f"Other methods, of {profile.others} cases each",
            header,
            [_row(name, sum(tally.values(), Counter())) for name, (tally, _) in others.items()],
            _OTHERS,
        ),
    ]
    return Part(results, tables)


def count(indices, method: str = "Implicit") -> tuple[dict[str, Counter], list[int]]:
    """Verdicts by family, and the numbers of cases that are certified and wrong."""
    counts: dict[str, Counter] = defaultdict(Counter)
    wrong = []
    for index in tqdm(indices, f"certificates, {method}", unit="case"):
        case = draw(index)
        if not stated(case, method):
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            verdict = judge(case, method)
        counts[case.family][verdict] += 1
        if verdict is Verdict.WRONG:
            wrong.append(index)
    return counts, wrong


def _row(name: str, tally: Counter) -> list:
    share = f"{100 * healthy(tally):.1f} %" if tally[Verdict.RIGHT] + tally[Verdict.WRONGLY_FLAGGED] else "-"
    return [name, tally.total(), *(tally[verdict] for verdict in Verdict), share]
