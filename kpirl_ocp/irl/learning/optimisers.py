"""Outer optimisers: rules for the next psi, given a function that returns loss and gradient.

An optimiser is a small configured object; `start(point)` gives its memory, and `step(evaluate, point, memory)` the next
point, evaluated, with the next memory. Nothing is kept inside.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from kpirl_ocp.errors import CertificateError
from kpirl_ocp.ocp.problem.statement.checks import check_settings, number
from kpirl_ocp.types import Array, Mask, Solution


class Point(NamedTuple):
    """psi (n_psi,) with its loss and gradient (n_psi,).

    uncertified: number of gradients that were only flagged. solutions: the plans, one per demonstration.
    """

    psi: Array
    loss: float
    gradient: Array
    uncertified: int = 0
    solutions: tuple[Solution, ...] = ()


Evaluate = Callable[[Array], Point]


class Box(NamedTuple):
    """Bounds on psi: lower, upper (n_psi,), or numbers."""

    lower: Array | float = -np.inf
    upper: Array | float = np.inf

    def project(self, psi: Array) -> Array:
        """The nearest psi within the bounds."""
        return np.clip(psi, self.lower, self.upper)

    def free(self, point: Point) -> Mask:
        """(n_psi,) True for entries that descent does not push against a bound that they are at."""
        below, above = point.psi <= self.lower, point.psi >= self.upper
        return ~((below & (point.gradient > 0)) | (above & (point.gradient < 0)))


EVERYWHERE = Box()
_HALVINGS = 30  # of a step, down to 1e-9 of it
_ARMIJO = 1e-4  # share of the decrease to first order that a step must bring (Nocedal and Wright, section 3.1)


class Optimiser(Protocol):
    """A rule for the next psi."""

    def start(self, point: Point) -> Any:
        """Memory before the first step."""
        ...

    def step(self, evaluate: Evaluate, point: Point, memory: Any, box: Box = EVERYWHERE) -> tuple[Point, Any]:
        """The next point, within the box, and memory."""
        ...


@dataclass(frozen=True)
class Descent:
    """psi <- psi - eta grad L (the paper's Algorithm 1, with its learning rate)."""

    learning_rate: float = 1e-3

    def __post_init__(self) -> None:
        number("learning_rate", self.learning_rate, "a number above 0", 0)

    def start(self, point: Point) -> None:
        """Nothing to remember."""

    def step(self, evaluate: Evaluate, point: Point, memory: None, box: Box = EVERYWHERE) -> tuple[Point, None]:
        """One gradient step, projected."""
        return evaluate(box.project(point.psi - self.learning_rate * point.gradient)), None


@dataclass(frozen=True)
class Adam:
    """Adam (Kingma and Ba, 2015, Algorithm 1)."""

    learning_rate: float = 1e-3
    beta1: float = 0.9
    beta2: float = 0.999
    epsilon: float = 1e-8

    def __post_init__(self) -> None:
        number("learning_rate", self.learning_rate, "a number above 0", 0)

    def start(self, point: Point) -> tuple[int, Array, Array]:
        """Step counter and the two moments."""
        return 0, np.zeros_like(point.psi), np.zeros_like(point.psi)

    def step(
        self, evaluate: Evaluate, point: Point, memory: tuple[int, Array, Array], box: Box = EVERYWHERE
    ) -> tuple[Point, tuple[int, Array, Array]]:
        """One step along the normalised, bias-corrected mean gradient, projected."""
        count, first, second = memory
        count += 1
        first = self.beta1 * first + (1 - self.beta1) * point.gradient
        second = self.beta2 * second + (1 - self.beta2) * point.gradient**2
        mean, spread = first / (1 - self.beta1**count), np.sqrt(second / (1 - self.beta2**count))
        psi = point.psi - self.learning_rate * mean / (spread + self.epsilon)
        return evaluate(box.project(psi)), (count, first, second)


@dataclass(frozen=True)
class LBFGS:
    """L-BFGS (Nocedal and Wright, Algorithms 7.4 and 3.1): two-loop recursion, backtracking line search.

    memory: number of pairs (s, y) kept.
    first_step: length of the first step, before there is any curvature.
    tolerance: relative decrease of the loss below which it makes no step.
    """

    memory: int = 10
    first_step: float = 0.1
    tolerance: float = 1e-6

    def __post_init__(self) -> None:
        number("first_step", self.first_step, "a number above 0", 0)
        check_settings(self, "tolerance")

    def start(self, point: Point) -> tuple[tuple[Array, Array], ...]:
        """No pairs."""
        return ()

    def step(
        self, evaluate: Evaluate, point: Point, memory: tuple[tuple[Array, Array], ...], box: Box = EVERYWHERE
    ) -> tuple[Point, tuple[tuple[Array, Array], ...]]:
        """One quasi-Newton step, or the same point when no step gains the relative `tolerance` any more.

        Entries that are pushed against their bounds stay there; the others follow the projected path (Bertsekas, 1982).
        A trial point whose gradient cannot be certified counts as too far away.
        """
        free = box.free(point)
        direction = np.where(free, -self._two_loops(np.where(free, point.gradient, 0.0), _on(free, memory)), 0.0)
        if not memory:
            direction *= self.first_step / max(float(np.linalg.norm(direction)), np.finfo(float).tiny)
        for halvings in range(_HALVINGS):
            psi = box.project(point.psi + 0.5**halvings * direction)
            try:
                new = evaluate(psi)
            except CertificateError:
                continue
            if new.loss <= point.loss + _ARMIJO * float(point.gradient @ (psi - point.psi)):
                if point.loss - new.loss > self.tolerance * abs(point.loss):
                    return new, self._remember(point, new, memory)
                break
        return self.step(evaluate, point, (), box) if memory else (point, ())  # once more, along steepest descent

    def _two_loops(self, gradient: Array, pairs: tuple[tuple[Array, Array], ...]) -> Array:
        """Inverse Hessian estimate times gradient."""
        q, factors = gradient.copy(), []
        for s, y in reversed(pairs):
            factors.append((s @ q) / (y @ s))
            q = q - factors[-1] * y
        if pairs:
            s, y = pairs[-1]
            q = q * (s @ y) / (y @ y)
        for (s, y), factor in zip(pairs, reversed(factors), strict=True):
            q = q + s * (factor - (y @ q) / (y @ s))
        return q

    def _remember(
        self, old: Point, new: Point, pairs: tuple[tuple[Array, Array], ...]
    ) -> tuple[tuple[Array, Array], ...]:
        s, y = new.psi - old.psi, new.gradient - old.gradient
        if s @ y <= 1e-10 * np.linalg.norm(s) * np.linalg.norm(y):  # no positive curvature: the pair would spoil it
            return pairs
        return (*pairs, (s, y))[-self.memory :]


def _on(free: Mask, pairs: tuple[tuple[Array, Array], ...]) -> tuple[tuple[Array, Array], ...]:
    """The pairs on the free entries alone, where these still have positive curvature."""
    if free.all():
        return pairs
    kept = ((np.where(free, s, 0.0), np.where(free, y, 0.0)) for s, y in pairs)
    return tuple((s, y) for s, y in kept if s @ y > 0)
