"""All results of a run, and the questions that tables, figures and claims ask of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kpirl_ocp.irl.visual.learning import InnerLoop
from kpirl_ocp.reporting import digits
from kpirl_ocp.types import Array
from reproduction import axes, placing, reaching, repeated, robustness
from reproduction.choice import Tried
from reproduction.contenders import (
    APPRENTICE,
    DEFAULT,
    DEFAULT_MORE_STEPS,
    IMPLICIT,
    LITERAL,
    MORE_STEPS,
    SMALL_START,
    UNROLLED,
    Contender,
)
from reproduction.settings import STARTS, Preset
from reproduction.sweep import Result
from reproduction.tables import demonstrations, restlessness

# An inner loop's name, what was learned with it, and what that is compared with.
_LOOPS = (
    ("one step", UNROLLED, (DEFAULT, APPRENTICE)),
    ("more steps", MORE_STEPS, (DEFAULT_MORE_STEPS,)),
    ("converged", IMPLICIT, (DEFAULT_MORE_STEPS,)),
)
_UNSTABLE = 0.05  # share of iterations in which the loss rises


@dataclass(frozen=True, eq=False)
class Outcome:
    """Settings and results by the names of jobs.

    chosen: per task, the inner loop that was chosen. tried: per task, the scores of every candidate.
    """

    preset: Preset
    seeds: Sequence[int]
    chosen: dict[str, InnerLoop]
    tried: dict[str, list[Tried]]
    results: dict[str, Result]

    def reaching(self, contender: Contender, count: int, key: str) -> list[Array]:
        """A result of experiment 1 from every seed in which the cost was learned."""
        found = [self.results[reaching.name_of(contender, count, seed)] for seed in self.seeds]
        return [result[key] for result in found if not result["failure"]]

    def without_axis(self, contender: Contender, count: int, key: str) -> Array:
        """A result of `axes`, (seeds,)."""
        names = [axes.name_of(reaching.name_of(contender, count, seed)) for seed in self.seeds]
        return np.array([self.results[name][key] for name in names if name in self.results])

    def placing(self, contender: Contender, key: str) -> list[Array]:
        """A result of learning in experiment 2 from every seed in which the cost was learned."""
        found = [self.results[placing.name_of(contender, seed)] for seed in self.seeds]
        return [result[key] for result in found if not result["failure"]]

    def executed(self, contender: Contender, start: int, closed: bool, key: str) -> Array:
        """A result of playing it, (seeds, ...); seeds in which the cost was not learned are left out."""
        names = [placing.executed_name(contender, seed, start, closed) for seed in self.seeds]
        return np.array([self.results[name][key] for name in names if name in self.results])

    def repeated(self, contender: Contender, start: int) -> Array:
        """Squared distances (executions,) of one cost, executed several times; empty if it was not learned."""
        found = self.results.get(repeated.job_name(contender, start), {"squared": np.zeros(0)})
        return np.asarray(found["squared"])

    def failures(self) -> dict[str, str]:
        """The costs that could not be learned, and why."""
        return {name: str(found["failure"]) for name, found in self.results.items() if found.get("failure")}

    @property
    def robust_runs(self) -> dict[str, tuple[Contender, bool]]:
        """The runs of the robustness study whose costs were all learned, by label."""
        first = next(iter(robustness.CONDITIONS))
        able = [run for run in robustness.RUNS if robustness.name(first, *run) in self.results]
        return {robustness.label(*run): run for run in able}

    def robust(self, condition: str, contender: Contender, closed: bool, key: str) -> Array:
        """A result of the robustness study."""
        return np.asarray(self.results[robustness.name(condition, contender, closed)][key])


@dataclass(frozen=True)
class Claim:
    """A finding of the paper, and whether it holds here."""

    text: str
    holds: bool
    numbers: str


def claims(outcome: Outcome) -> list[Claim]:
    """The paper's findings, tested."""
    counts = outcome.preset.demonstrations
    found = [_nearer(outcome, count, *loop) for loop in _LOOPS for count in counts]
    if len(counts) > 1:
        found.append(_one_is_enough(outcome, min(counts), max(counts)))
    learned = (*UNROLLED, *LITERAL, *SMALL_START, APPRENTICE, *MORE_STEPS)
    found += [_y_is_small(outcome, contender, count) for contender in learned for count in counts]
    found.append(_unstable(outcome, max(counts)))
    found += [_converges(outcome, contender) for contender in UNROLLED]
    for loop in _LOOPS:
        found += [_better_placing(outcome, start, *loop) for start in STARTS]
        found.append(_weighted_placing(outcome, *loop))
    found += [_x_then_y(outcome, contender) for contender in (*UNROLLED, *MORE_STEPS) if contender.cost != "Weighted"]
    return found


def _nearer(
    outcome: Outcome, count: int, loop: str, learned: Sequence[Contender], others: Sequence[Contender]
) -> Claim:
    ours, theirs = (
        {c.label: _mean(outcome.reaching(c, count, "distance")) for c in group} for group in (learned, others)
    )
    names = " and ".join(theirs)
    text = f"Reaching, {demonstrations(count)}, {loop}: all learned costs end nearer to the goal than {names}."
    numbers = f"{_list(ours)}; {_list(theirs)} (relative distance)"
    return Claim(text, max(ours.values()) < min(theirs.values()), numbers)


def axis_weights(weights: Array) -> tuple[float, float]:
    """Mean weight of x and of y coordinates in W (T, n_z)."""
    return float(weights[:, 0::2].mean()), float(weights[:, 1::2].mean())


def _y_is_small(outcome: Outcome, contender: Contender, count: int) -> Claim:
    pairs = [axis_weights(weights) for weights in outcome.reaching(contender, count, "weights")]
    x, y = np.mean(pairs, axis=0)
    text = f"Reaching: {contender.label} gives y less weight than x, {demonstrations(count)}."
    return Claim(text, bool(abs(y) < x), f"x {x:.3g}, y {y:.3g} (mean weight)")


def _one_is_enough(outcome: Outcome, few: int, many: int) -> Claim:
    pairs = {c.label: [_mean(outcome.reaching(c, count, "distance")) for count in (few, many)] for c in UNROLLED}
    text = f"Reaching, one step: one demonstration does about as well as {many} (relative distance within a fifth)."
    numbers = ", ".join(f"{name} {one:.3g} and {more:.3g}" for name, (one, more) in pairs.items())
    return Claim(text, all(one <= 1.2 * more for one, more in pairs.values()), numbers)


def settled(losses: Array, share: float = 0.05) -> int:
    """The outer iteration at which the lowest loss so far is within this share of the whole descent from its end."""
    lowest = np.minimum.accumulate(losses)
    return int(np.argmax(lowest - lowest[-1] <= share * (lowest[0] - lowest[-1])))


def _converges(outcome: Outcome, contender: Contender) -> Claim:
    found = [settled(losses) for losses in outcome.placing(contender, "losses")]
    text = (
        f"Placing: the loss converges around iteration 2000, {contender.label} (95 % of its descent by 1000 to 3000)."
    )
    return Claim(text, 1000 <= np.mean(found) <= 3000, f"95 % after {', '.join(map(str, found))} iterations")


def _unstable(outcome: Outcome, count: int) -> Claim:
    baseline = restlessness(outcome.reaching(APPRENTICE, count, "losses"))
    ours = {c.label: restlessness(outcome.reaching(c, count, "losses")) for c in UNROLLED}
    text = "Reaching: apprenticeship learning is unstable, the gradient-based method is not."
    numbers = f"training loss rises by > 1 % in {100 * baseline:.0f} % of iterations; ours " + ", ".join(
        f"{name} {100 * share:.0f} %" for name, share in ours.items()
    )
    return Claim(text, baseline > max(_UNSTABLE, 2 * max(ours.values())), numbers)


def _better_placing(
    outcome: Outcome, start: int, loop: str, learned: Sequence[Contender], others: Sequence[Contender]
) -> Claim:
    """The least factor in the paper's Table 1 is 3.6."""
    timed = [c for c in learned if c.cost != "Weighted"]
    errors = {c.label: _mean(outcome.executed(c, start, False, "squared")) for c in (*timed, others[0])}
    factor = errors[others[0].label] / max(errors[c.label] for c in timed)
    text = f"Placing from start {start}, {loop}: time-dependent costs beat Default by a factor of three or more."
    return Claim(text, factor >= 3.0, f"{_list(errors)} px²; factor {digits(factor, 3)}")


def _weighted_placing(outcome: Outcome, loop: str, learned: Sequence[Contender], others: Sequence[Contender]) -> Claim:
    weighted, default = learned[0], others[0]
    pairs = {s: [_mean(outcome.executed(c, s, False, "squared")) for c in (weighted, default)] for s in STARTS}
    text = f"Placing, {loop}: Weighted beats Default from start 2, and not from start 1."
    numbers = "; ".join(f"start {s}: {digits(w, 3)} and {digits(d, 3)}" for s, (w, d) in pairs.items())
    return Claim(text, pairs[2][0] < pairs[2][1] and not pairs[1][0] < pairs[1][1], f"{numbers} px²")


def _x_then_y(outcome: Outcome, contender: Contender) -> Claim:
    early = np.mean([axis_weights(weights[:5]) for weights in outcome.placing(contender, "weights")], axis=0)
    late = np.mean([axis_weights(weights[-5:]) for weights in outcome.placing(contender, "weights")], axis=0)
    text = f"Placing: {contender.label} stresses x early and y late."
    numbers = f"first five steps x {early[0]:.3g}, y {early[1]:.3g}; last five x {late[0]:.3g}, y {late[1]:.3g}"
    return Claim(text, bool(early[0] > early[1] and late[1] > late[0]), numbers)


def _mean(values: Sequence[Array] | Array) -> float:
    return float(np.mean(values))


def _list(values: dict[str, float]) -> str:
    return ", ".join(f"{name} {digits(value, 3)}" for name, value in values.items())
