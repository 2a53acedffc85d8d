"""Hypergradients side by side on one problem: error, time, memory, certificate; and learning with each."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kpirl_ocp.irl.cases.examples import CASES, Case, converging_descent, unconstrained
from kpirl_ocp.irl.hypergradients.certificate import Hypergradient
from kpirl_ocp.irl.hypergradients.finite_difference import FiniteDifference
from kpirl_ocp.irl.hypergradients.implicit import Implicit
from kpirl_ocp.irl.hypergradients.unrolled import Truncated, Unrolled
from kpirl_ocp.irl.learning.learn import learn
from kpirl_ocp.irl.learning.optimisers import Adam
from kpirl_ocp.irl.learning.result import LearningResult
from kpirl_ocp.ocp.solvers.ipopt import Ipopt
from kpirl_ocp.types import Array

TRUNCATION = 10  # steps that Truncated goes back


@dataclass(frozen=True)
class Measurement:
    """One method on one problem.

    steps: N of the inner gradient descent, 0 if it converges. error: relative to the reference. seconds: median of a
        call.
    memory: by how much the resident memory of a fresh process peaks while it builds and calls the method [bytes].
    certificate: what it says.
    """

    method: str
    steps: int
    error: float
    seconds: float
    memory: int
    certificate: str


def methods(case: Case, steps: list[int]) -> Iterator[tuple[str, int, Hypergradient]]:
    """Name, N and hypergradient of everything that is compared; all flag, none raises."""
    for n in steps:
        yield "unrolled", n, Unrolled(converging_descent(case, n), policy="flag")
        yield f"truncated to {TRUNCATION}", n, Truncated(converging_descent(case, n), min(n, TRUNCATION))
        yield "implicit (descent)", n, Implicit(converging_descent(case, n), policy="flag")
    yield "implicit (Riccati)", 0, Implicit(policy="flag")
    yield "finite difference", 0, FiniteDifference(policy="flag")


def reference(case: Case) -> tuple[Array, float]:
    """The gradient at a solution to 1e-12, certified, and how far finite differences are from it, relatively."""
    exact = Implicit(Ipopt(tolerance=1e-12))(case.problem, case.demonstration, case.psi).gradient
    independent = FiniteDifference(Ipopt(tolerance=1e-12))(case.problem, case.demonstration, case.psi).gradient
    return exact, relative_error(independent, exact)


def relative_error(gradient: Array, exact: Array) -> float:
    """|g - g*| / |g*|."""
    return float(np.linalg.norm(gradient - exact) / np.linalg.norm(exact))


def measure_all(name: str, steps: list[int], done: Callable[[Measurement], None]) -> list[Measurement]:
    """Measure every method on the example `name` without its constraints, each in a process of its own."""
    exact, _ = reference(unconstrained(CASES[name]()))
    count = len(list(methods(unconstrained(CASES[name]()), steps)))
    results = []
    for index in range(count):
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
            results.append(pool.submit(_measure, name, steps, index, exact).result())
        done(results[-1])
    return results


def _measure(name: str, steps: list[int], index: int, exact: Array) -> Measurement:
    case = unconstrained(CASES[name]())
    label, n, method = list(methods(case, steps))[index]
    case.problem.simulate(case.demonstration.s0, np.zeros((case.problem.horizon, case.problem.n_actions)), case.psi)
    before = _reset_peak_memory()
    result = method(case.problem, case.demonstration, case.psi)
    memory = _memory("VmHWM") - before
    seconds = median_seconds(lambda: method(case.problem, case.demonstration, case.psi))
    error = relative_error(result.gradient, exact)
    return Measurement(label, n, error, seconds, memory, str(result.certificate))


def _reset_peak_memory() -> int:
    """Forget the peak of importing and building (Linux), and give what is resident now [bytes]."""
    Path("/proc/self/clear_refs").write_text("5")
    return _memory("VmRSS")


def _memory(field: str) -> int:
    """A field of /proc/self/status [bytes]."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(field))


def median_seconds(call: Callable[[], object], budget: float = 1.0, most: int = 200) -> float:
    """Median wall time of a call, repeated within a time budget [s] after one call to warm up."""
    call()
    times: list[float] = []
    while len(times) < 3 or (sum(times) < budget and len(times) < most):
        started = time.perf_counter()
        call()
        times.append(time.perf_counter() - started)
    return float(np.median(times))


def learn_with_each(name: str, steps: list[int], iterations: int, learning_rate: float) -> dict[str, LearningResult]:
    """Learn psi on the example `name` without its constraints: unrolled for each N, and implicit."""
    case = unconstrained(CASES[name]())
    contenders: dict[str, Hypergradient] = {f"unrolled, N = {n}": Unrolled(converging_descent(case, n)) for n in steps}
    contenders["implicit (Riccati)"] = Implicit()
    results = {}
    for label, method in contenders.items():
        method(case.problem, case.demonstration, case.psi)  # build outside the clock
        arguments = (case.problem, [case.demonstration], case.psi, method, Adam(learning_rate), iterations)
        results[label] = learn(*arguments, progress=False)
    return results
