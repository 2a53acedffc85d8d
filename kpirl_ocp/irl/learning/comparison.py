"""Hypergradients side by side on one problem: error, time, memory, certificate; and learning with each."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Set
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from threading import Thread

import casadi as ca
import numpy as np
from joblib.externals.loky import ProcessPoolExecutor

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.cases.examples import CASES, Case, converging_descent, unconstrained
from kpirl_ocp.irl.cases.own import load_own
from kpirl_ocp.irl.hypergradients.certificate import Hypergradient
from kpirl_ocp.irl.hypergradients.finite_difference import FiniteDifference
from kpirl_ocp.irl.hypergradients.implicit import Implicit
from kpirl_ocp.irl.hypergradients.unrolled import Truncated, Unrolled
from kpirl_ocp.irl.learning.learn import learn
from kpirl_ocp.irl.learning.optimisers import Adam
from kpirl_ocp.irl.learning.result import LearningResult
from kpirl_ocp.ocp.problem.guards import dense
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.solvers.ipopt import Ipopt
from kpirl_ocp.reporting import deaf_pool, feeders, pool_ending
from kpirl_ocp.types import Array, Demonstration

TRUNCATION = 10  # steps that Truncated goes back
_PRODUCTS = 30  # of the power iteration


@dataclass(frozen=True)
class Measurement:
    """One method on one problem.

    steps: N of the inner gradient descent, 0 if it converges. error: relative to the reference. seconds: CPU time of a
        call, the median.
    memory: by how much the resident memory of a fresh process peaks while it builds and calls the method [bytes].
    certificate: what it says.
    """

    method: str
    steps: int
    error: float
    seconds: float
    memory: int
    certificate: str


@lru_cache
def case_of(source: str) -> Case:
    """An example by name, or a user's own problem by FILE.py:FUNCTION, without its constraints.

    Raises:
        ProblemError: the own problem comes without observations or parameters, or has no solution.
    """
    if source in CASES:
        return unconstrained(CASES[source]())
    own = load_own(source)
    problem = own.problem.unconstrained()
    if own.observations is None or own.psi.size == 0:
        raise ProblemError(f"{source}: a hypergradient needs parameters psi, and the observations of a demonstration.")
    demonstration = Demonstration(own.s0, own.context, own.observations)
    step_size = own.step_size or 1 / largest_curvature(problem, demonstration, own.psi)
    return Case(problem, demonstration, own.psi, step_size, steps=0)


def largest_curvature(problem: OCP, demonstration: Demonstration, psi: Array) -> float:
    """The largest eigenvalue of the Hessian of the cost by the actions, at the solution; by power iteration."""
    solution = Ipopt().solve(problem, demonstration.s0, psi, demonstration.context).raise_if_failed()
    u, v = ca.MX.sym("u", solution.actions.size), ca.MX.sym("v", solution.actions.size)
    actions = ca.reshape(u, problem.n_actions, problem.horizon)
    states = problem.rollout(demonstration.s0, actions, psi, demonstration.context)
    slope = ca.gradient(problem.cost(states, actions, psi, demonstration.context), u)
    product = ca.Function("product", [u, v], [ca.jtimes(slope, u, v)])
    direction, value = np.random.default_rng(0).normal(size=solution.actions.size), 0.0
    for _ in range(_PRODUCTS):
        direction = dense(product(solution.actions.ravel(), direction / np.linalg.norm(direction))).ravel()
        value = float(np.linalg.norm(direction))
    return value


def methods(case: Case, steps: list[int]) -> Iterator[tuple[str, int, Hypergradient]]:
    """Name, N and hypergradient of everything that is compared; all flag, none raises."""
    for n in steps:
        yield "unrolled", n, Unrolled(converging_descent(case, n), policy="flag")
        yield f"truncated to {TRUNCATION}", n, Truncated(converging_descent(case, n), min(n, TRUNCATION))
        yield "implicit (descent)", n, Implicit(converging_descent(case, n), policy="flag")
    yield "implicit (Riccati)", 0, Implicit(policy="flag")
    yield "finite difference", 0, FiniteDifference(policy="flag")


def reference(case: Case) -> tuple[Array, float]:
    """The gradient at a solution to 1e-12, certified, and how far finite differences are from it, relatively.

    Raises ProblemError for a gradient of zero, to which nothing can be compared.
    """
    exact, quotients = Implicit(Ipopt(tolerance=1e-12)), FiniteDifference(Ipopt(tolerance=1e-12), policy="flag")
    gradient = exact(case.problem, case.demonstration, case.psi).gradient
    if not gradient.any():
        raise ProblemError("the gradient is zero, as psi explains the observations: give another psi, or others.")
    independent = quotients(case.problem, case.demonstration, case.psi).gradient
    return gradient, relative_error(independent, gradient)


def relative_error(gradient: Array, exact: Array) -> float:
    """|g - g*| / |g*|."""
    return float(np.linalg.norm(gradient - exact) / np.linalg.norm(exact))


def measure_all(source: str, steps: list[int], exact: Array) -> Iterator[Measurement]:
    """Measure every method on a problem (see `case_of`), each in a process of its own; exact: the reference."""
    for index in range(len(list(methods(case_of(source), steps)))):
        with ExitStack() as stack:
            with deaf_pool():
                pool = ProcessPoolExecutor(1)
                stack.callback(_kill, pool, feeders())  # its own begins with the first task
                measured = pool.submit(_measure, source, steps, index, exact)
            yield measured.result()


def _kill(pool: ProcessPoolExecutor, others: Set[Thread]) -> None:
    with pool_ending(others):
        pool.shutdown(kill_workers=True)


def _measure(source: str, steps: list[int], index: int, exact: Array) -> Measurement:
    case = case_of(source)
    label, n, method = list(methods(case, steps))[index]
    case.problem.simulate(case.demonstration.s0, np.zeros((case.problem.horizon, case.problem.n_actions)), case.psi)
    before = reset_peak_memory()
    result = method(case.problem, case.demonstration, case.psi)
    memory = peak_memory() - before
    seconds = median_seconds(lambda: method(case.problem, case.demonstration, case.psi))
    error = relative_error(result.gradient, exact)
    return Measurement(label, n, error, seconds, memory, str(result.certificate))


def reset_peak_memory() -> int:
    """Forget the peak of this process so far (Linux), and give what is resident now [bytes]."""
    Path("/proc/self/clear_refs").write_text("5")
    return _memory("VmRSS")


def peak_memory() -> int:
    """The largest resident memory of this process since `reset_peak_memory` [bytes]."""
    return _memory("VmHWM")


def _memory(field: str) -> int:
    """A field of /proc/self/status [bytes]."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(field))


def median_seconds(call: Callable[[], object], budget: float = 0.5, most: int = 200) -> float:
    """Median CPU time of a call, repeated within a time budget [s] after one call to warm up.

    Other work on the machine counts less in it than in wall time.
    """
    call()
    times: list[float] = []
    while len(times) < 3 or (sum(times) < budget and len(times) < most):
        started = time.process_time()
        call()
        times.append(time.process_time() - started)
    return float(np.median(times))


def _learn(case: Case, method: Hypergradient, optimiser: Adam, iterations: int) -> LearningResult:
    times = [time.process_time()]

    def note(_: object) -> None:
        times.append(time.process_time())

    arguments = (case.problem, [case.demonstration], case.psi, method, optimiser, iterations)
    result = learn(*arguments, False, callback=note)
    return replace(result.raise_if_interrupted(), seconds=np.array(times) - times[0])


def learn_with_each(case: Case, steps: list[int], iterations: int, learning_rate: float) -> dict[str, LearningResult]:
    """Learn psi: unrolled for each N, and implicit. The seconds of results are those of the CPU."""
    contenders: dict[str, Hypergradient] = {f"unrolled, N = {n}": Unrolled(converging_descent(case, n)) for n in steps}
    contenders["implicit (Riccati)"] = Implicit()
    results = {}
    for label, method in contenders.items():
        method(case.problem, case.demonstration, case.psi)  # build outside the clock
        results[label] = _learn(case, method, Adam(learning_rate), iterations)
    return results
