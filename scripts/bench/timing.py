"""Wall times of several contenders, taken in turns, so that whatever else the machine does hits all of them alike.

Processor time is measured, too: on one thread and a quiet machine it is the same.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

Call = Callable[[], object]
Sample = tuple[float, float]
_BLOCK = 5e-3  # of calls in a row per contender and round [s]
_COLD = 0.05  # a contender whose calls are shorter is called once before its block, to fill the caches [s]


@dataclass(frozen=True)
class Timing:
    """Quantiles of the wall time of `calls` timed calls [s], and the median of their processor time [s]."""

    median: float
    minimum: float
    low: float
    high: float
    processor: float
    calls: int

    @classmethod
    def of(cls, samples: list[Sample]) -> Timing:
        """Minimum, median, and the 10 and 90 % quantiles."""
        wall = [sample[0] for sample in samples]
        low, median, high = map(float, np.percentile(wall, [10, 50, 90]))
        return cls(median, min(wall), low, high, float(np.median([sample[1] for sample in samples])), len(samples))

    @property
    def numbers(self) -> dict[str, float]:
        """For metrics.json [ms]."""
        values = {"median_ms": self.median, "minimum_ms": self.minimum, "p10_ms": self.low, "p90_ms": self.high}
        values["processor_ms"] = self.processor
        return {name: 1e3 * value for name, value in values.items()} | {"calls": self.calls}

    def __str__(self) -> str:
        """Median with the spread from the 10th to the 90th percentile [ms]."""
        if self.calls == 1:
            return f"{1e3 * self.median:.3g} (once)"
        return f"{1e3 * self.median:.3g} ({1e3 * self.low:.3g} - {1e3 * self.high:.3g})"


def seconds(call: Call) -> Sample:
    """Wall and processor time of one call [s]."""
    started, before = time.perf_counter(), time.process_time()
    call()
    return time.perf_counter() - started, time.process_time() - before


def interleaved(calls: Mapping[str, Call], budget: float, most: int) -> dict[str, Timing]:
    """Time warm calls in turns, A B C A B C .., each until its `budget` [s] is spent or `most` calls are timed."""
    samples: dict[str, list[Sample]] = {name: [] for name in calls}
    running = dict(calls)
    while running:
        for name, call in list(running.items()):
            _block(call, samples[name])
            if sum(wall for wall, _ in samples[name]) >= budget or len(samples[name]) >= most:
                del running[name]
    return {name: Timing.of(found) for name, found in samples.items()}


def _block(call: Call, samples: list[Sample]) -> None:
    if samples and samples[-1][0] < _COLD:
        call()
    spent = 0.0
    while spent < _BLOCK:
        samples.append(seconds(call))
        spent += samples[-1][0]
