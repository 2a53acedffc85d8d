"""Gradient-based IRL (the paper's Algorithm 1), for one or several demonstrations.

    psi <- optimiser step on the mean over demonstrations of L_IRL(tau(psi), tau_demo)

The mean, not the sum, so that a learning rate means the same for one demonstration and for ten. The optimiser moves
psi / scale, within bounds.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from tqdm import tqdm

from kpirl_ocp.errors import FileError, ProblemError
from kpirl_ocp.irl.hypergradients.certificate import Hypergradient, HypergradientResult
from kpirl_ocp.irl.hypergradients.implicit import Implicit
from kpirl_ocp.irl.hypergradients.unrolled import Unrolled
from kpirl_ocp.irl.learning.arguments import (
    check_bounds,
    check_demonstrations,
    check_methods,
    check_run,
    psi_of,
    scale_of,
)
from kpirl_ocp.irl.learning.checkpoint import Checkpoint, Saved, fingerprint, statement_of
from kpirl_ocp.irl.learning.horizons import Problems, problems_of
from kpirl_ocp.irl.learning.optimisers import Adam, Box, Optimiser, Point
from kpirl_ocp.irl.learning.result import LearningResult
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Guess
from kpirl_ocp.ocp.problem.statement.checks import UNBOUNDED, Bounds, bounds_of
from kpirl_ocp.ocp.solvers.gradient_descent import GradientDescent
from kpirl_ocp.types import Array, Demonstration


@dataclass(frozen=True)
class LearningState:
    """State of learning: the evaluated psi, the optimiser's memory, and the best point so far."""

    point: Point
    memory: Any
    best: Point


@dataclass(frozen=True)
class Learner:
    """One outer iteration at a time: `init(psi0) -> state`, `step(state) -> state`; arguments as in `learn`."""

    problem: Problems
    demonstrations: Sequence[Demonstration]
    hypergradient: Hypergradient
    optimiser: Optimiser
    guesses: Sequence[Guess] | None = None
    warm_start: bool = True
    scale: ArrayLike = 1.0
    bounds: Bounds = UNBOUNDED

    def __post_init__(self) -> None:
        check_demonstrations(self.demonstrations, self.guesses)
        check_methods(self.hypergradient, self.optimiser)
        check_bounds(self.bounds)

    def evaluate(self, psi: Array, near: Point | None = None) -> Point:
        """Mean loss and gradient over the demonstrations; solves start from the plans of a point nearby."""
        results = self._results(psi, self._starts(near))
        return Point(
            psi=psi,
            loss=float(np.mean([result.loss for result in results])),
            gradient=np.mean([result.gradient for result in results], axis=0),
            uncertified=sum(not result.certificate.certified for result in results),
            solutions=tuple(result.certificate.solution for result in results),
        )

    def init(self, psi0: ArrayLike) -> LearningState:
        """Evaluate psi0 (n_psi,)."""
        psi = psi_of(psi0, self.problems[0].n_parameters)
        within = self._box.project(psi)
        for i in np.flatnonzero(within != psi):
            at = f"psi0[{i}] is {psi[i]:g}, the nearest that does {within[i]:g}"
            raise ProblemError(f"psi0 must lie within the bounds (lower, upper): {at}.")
        point = self.evaluate(psi)
        return LearningState(point, self.optimiser.start(self._scaled(point)), point)

    def step(self, state: LearningState) -> LearningState:
        """Move psi once."""
        scale, before = self._scale, self._scaled(state.point)
        evaluated: dict[int, Point] = {}

        def evaluate(x: Array) -> Point:
            point = self.evaluate(self._box.project(x * scale), state.point)
            scaled = self._scaled(point)
            evaluated[id(scaled)] = point
            return scaled

        box = Box(self._box.lower / scale, self._box.upper / scale)
        after, memory = self.optimiser.step(evaluate, before, state.memory, box)
        point = state.point if after is before else evaluated[id(after)]
        return LearningState(point, memory, min(state.best, point, key=lambda p: p.loss))

    def fingerprint(self, psi0: ArrayLike) -> str:
        """A hash of problems, demonstrations and settings, by which a checkpoint of the same learning is known."""
        stated = [part for problem in dict.fromkeys(self.problems) for part in statement_of(problem)]
        seen = [vars(demonstration) for demonstration in self.demonstrations]
        parts = [part for values in seen for part in values.values()] + [psi0, self.scale, *self.bounds]
        arrays = [np.asarray(part) for part in parts if part is not None]
        return fingerprint(*stated, *arrays, self.hypergradient, self.optimiser, self.warm_start)

    @cached_property
    def problems(self) -> tuple[OCP, ...]:
        """The problem of every demonstration."""
        return problems_of(self.problem, self.demonstrations)

    @cached_property
    def _scale(self) -> Array:
        return scale_of(self.scale, self.problems[0].n_parameters)

    @cached_property
    def _box(self) -> Box:
        return Box(*bounds_of("bounds", self.bounds, (self.problems[0].n_parameters,)))

    def _scaled(self, point: Point) -> Point:
        """The point in the coordinates psi / scale."""
        return point._replace(psi=point.psi / self._scale, gradient=point.gradient * self._scale)

    def _starts(self, near: Point | None) -> Sequence[Guess]:
        """Starts of the solves. Those of gradient steps are part of the method, and stay what they are."""
        given = self.guesses or [None] * len(self.demonstrations)
        steps = isinstance(getattr(self.hypergradient, "solver", None), GradientDescent)
        if near is None or steps or not self.warm_start:
            return given
        return [plan if plan.status.ok else guess for plan, guess in zip(near.solutions, given, strict=True)]

    def _results(self, psi: Array, starts: Sequence[Guess]) -> list[HypergradientResult]:
        rows = list(zip(self.problems, self.demonstrations, starts, strict=True))
        if not isinstance(self.hypergradient, Unrolled | Implicit):
            return [self.hypergradient(problem, demo, psi, start) for problem, demo, start in rows]
        found: dict[int, HypergradientResult] = {}
        for problem in dict.fromkeys(self.problems):  # side by side where the horizon is the same
            at = [i for i, (own, *_) in enumerate(rows) if own is problem]
            demonstrations, guesses = [rows[i][1] for i in at], [rows[i][2] for i in at]
            found |= zip(at, self.hypergradient.batch(problem, demonstrations, psi, guesses), strict=True)
        return [found[i] for i in range(len(rows))]


def learn(
    problem: Problems,
    demonstrations: Sequence[Demonstration],
    psi0: ArrayLike,
    hypergradient: Hypergradient,
    optimiser: Optimiser | None = None,
    steps: int = 100,
    progress: bool = True,
    *,
    guesses: Sequence[Guess] | None = None,
    warm_start: bool = True,
    scale: ArrayLike = 1.0,
    bounds: Bounds = UNBOUNDED,
    checkpoint: str | Path | None = None,
    callback: Callable[[LearningState], object] | None = None,
) -> LearningResult:
    """Learn psi from demonstrations, starting at psi0 (n_psi,), by default with Adam at the paper's learning rate.

    Ends after `steps`, or sooner when the optimiser stays where it is. Ctrl-C ends it too: the best psi so far is
    returned, and the result says that it was interrupted.

    Args:
        problem: one problem, or a function T -> problem for demonstrations of different lengths.
        guesses: to start the first solves from, one per demonstration.
        warm_start: start later solves from the plans for the last psi, so that they stay in the same local minimum;
            not those of `GradientDescent`, whose start is a part of the method.
        scale: a number or (n_psi,), the size of psi: the optimiser moves psi / scale.
        bounds: (lower, upper) of psi, each a number or (n_psi,).
        checkpoint: file that learning is saved to, about every second and at the end. If it exists, learning resumes
            from there, up to `steps` in total, with the same numbers as if it had not been interrupted.
        callback: called with the state after every step; a true answer ends learning.

    Raises:
        CertificateError: a gradient was not certified and the hypergradient's policy is "raise".
        FileError: the checkpoint is damaged, of another learning, longer than `steps`, or cannot be written.
        ProblemError: arguments that do not fit.
    """
    check_run(steps, callback)
    seen = tuple(demonstrations) if isinstance(demonstrations, Iterable) else demonstrations
    optimiser = Adam() if optimiser is None else optimiser
    learner = Learner(problem, seen, hypergradient, optimiser, guesses, warm_start, scale, bounds)
    file = Checkpoint(checkpoint, "" if checkpoint is None else learner.fingerprint(psi0))
    saved = file.load()
    state, history = (LearningState(*saved[:3]), saved.history) if saved else (None, [])
    if len(history) - 1 > steps:
        raise FileError(
            f"{file.path} holds {len(history) - 1} steps, more than the {steps} that are wanted: ask for at least as "
            "many, or give another path."
        )
    begun = time.perf_counter() - (history[-1][1] if history else 0.0)
    interrupted = False

    def note(state: LearningState) -> None:
        history.append((state.point._replace(solutions=()), time.perf_counter() - begun))

    try:
        if state is None:
            note(state := learner.init(psi0))
        with tqdm(range(len(history) - 1, steps), desc="learning", disable=not progress, unit="step") as bar:
            for _ in bar:
                previous, state = state, learner.step(state)
                if state.point is previous.point:  # the optimiser has nothing left to gain
                    break
                note(state)
                bar.set_postfix(loss=f"{state.point.loss:.4g}", best=f"{state.best.loss:.4g}", refresh=False)
                file.save(Saved(state.point, state.memory, state.best, history))
                if callback is not None and callback(state):
                    break
    except KeyboardInterrupt:
        if state is None:
            raise
        interrupted = True
    file.save(Saved(state.point, state.memory, state.best, history), now=True)
    return LearningResult.of(state.best, history, interrupted)
