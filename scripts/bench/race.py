"""Contenders for one gradient: each builds and answers once, is compared with ours, and then all take turns."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bench.contenders import NOT_INSTALLED, OURS, Evaluation, find
from bench.part import Numbers
from bench.settings import Preset
from bench.timing import Timing, interleaved
from kpirl_ocp.irl.cases.network_cases import NetworkCase

Skip = Callable[[str], str | None]


@dataclass(frozen=True)
class Result:
    """The timing of one contender, or the reason why it did not take part.

    first: building, compiling and the first call [s]. error: relative difference of loss and gradient from ours.
    """

    timing: Timing | None = None
    first: float = float("nan")
    error: float = float("nan")
    reason: str = ""

    @property
    def numbers(self) -> Numbers:
        """For metrics.json."""
        if self.timing is None:
            return {"left_out": self.reason}
        return {**self.timing.numbers, "first_call_s": self.first, "difference": self.error}

    def __str__(self) -> str:
        return self.reason if self.timing is None else str(self.timing)


def race(data: NetworkCase, names: Sequence[str], preset: Preset, skip: Skip = lambda _: None) -> dict[str, Result]:
    """Time loss and gradient; ours must be among the names. `skip` gives the reason to leave a contender out."""
    reasons, ready, first = {}, {}, {}
    for name in names:
        reason, prepare = skip(name), None
        if reason is None:
            prepare = find(name)
            reason = NOT_INSTALLED
        if prepare is None:
            reasons[name] = reason
            continue
        started = time.perf_counter()
        ready[name] = prepare(data)
        ready[name]()
        first[name] = time.perf_counter() - started
    errors = differences(ready)
    timings = interleaved(ready, preset.budget, preset.most)
    taken = {name: Result(timings[name], first[name], errors[name]) for name in ready}
    return {name: taken[name] if name in taken else Result(reason=reasons[name]) for name in names}


def differences(ready: Mapping[str, Evaluation]) -> dict[str, float]:
    """Relative difference of loss and gradient from ours, the larger of the two."""
    loss, gradient = ready[OURS]()
    found = {}
    for name, evaluate in ready.items():
        other_loss, other = evaluate()
        found[name] = max(
            abs(other_loss - loss) / abs(loss), float(np.abs(other - gradient).max() / np.abs(gradient).max())
        )
    return found


def fastest(results: Mapping[str, Result], names: Sequence[str]) -> str | None:
    """The one of these contenders with the lowest median; None if none took part."""
    timings = {name: results[name].timing for name in names if name in results}
    present = {name: timing.median for name, timing in timings.items() if timing is not None}
    return min(present, key=lambda name: present[name]) if present else None
