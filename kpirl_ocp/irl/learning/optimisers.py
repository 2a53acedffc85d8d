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
from kpirl_ocp.types import Array


class Point(NamedTuple):
    """psi (n_psi,) with its loss and gradient (n_psi,); uncertified counts the gradients that were only flagged."""

    psi: Array
    loss: float
    gradient: Array
    uncertified: int = 0


Evaluate = Callable[[Array], Point]


class Optimiser(Protocol):
    """A rule for the next psi."""

    def start(self, point: Point) -> Any:
        """Memory before the first step."""
        ...

    def step(self, evaluate: Evaluate, point: Point, memory: Any) -> tuple[Point, Any]:
        """The next point and memory."""
        ...


@dataclass(frozen=True)
class Descent:
    """psi <- psi - eta grad L (the paper's Algorithm 1, with its learning rate)."""

    learning_rate: float = 1e-3

    def start(self, point: Point) -> None:
        """Nothing to remember."""

    def step(self, evaluate: Evaluate, point: Point, memory: None) -> tuple[Point, None]:
        """One gradient step."""
        return evaluate(point.psi - self.learning_rate * point.gradient), None


@dataclass(frozen=True)
class Adam:
    """Adam (Kingma and Ba, 2015, Algorithm 1)."""

    learning_rate: float = 1e-3
    beta1: float = 0.9
    beta2: float = 0.999
    epsilon: float = 1e-8

    def start(self, point: Point) -> tuple[int, Array, Array]:
        """Step counter and the two moments."""
        return 0, np.zeros_like(point.psi), np.zeros_like(point.psi)

    def step(
        self, evaluate: Evaluate, point: Point, memory: tuple[int, Array, Array]
    ) -> tuple[Point, tuple[int, Array, Array]]:
        """One step along the normalised, bias-corrected mean gradient."""
        count, first, second = memory
        count += 1
        first = self.beta1 * first + (1 - self.beta1) * point.gradient
        second = self.beta2 * second + (1 - self.beta2) * point.gradient**2
        mean, spread = first / (1 - self.beta1**count), np.sqrt(second / (1 - self.beta2**count))
        psi = point.psi - self.learning_rate * mean / (spread + self.epsilon)
        return evaluate(psi), (count, first, second)


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

    def start(self, point: Point) -> tuple[tuple[Array, Array], ...]:
        """No pairs."""
        return ()

    def step(
        self, evaluate: Evaluate, point: Point, memory: tuple[tuple[Array, Array], ...]
    ) -> tuple[Point, tuple[tuple[Array, Array], ...]]:
        """One quasi-Newton step, or the same point when no step gains the relative `tolerance` any more.

        A trial point whose gradient cannot be certified counts as too far away.
        """
        direction = -self._two_loops(point.gradient, memory)
        if not memory:
            direction *= self.first_step / max(float(np.linalg.norm(direction)), np.finfo(float).tiny)
        slope = float(point.gradient @ direction)
        for halvings in range(30):
            try:
                new = evaluate(point.psi + 0.5**halvings * direction)
            except CertificateError:
                continue
            if new.loss <= point.loss + 1e-4 * 0.5**halvings * slope:  # Armijo
                if point.loss - new.loss > self.tolerance * abs(point.loss):
                    return new, self._remember(point, new, memory)
                break
        return self.step(evaluate, point, ()) if memory else (point, ())  # once more, along steepest descent

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
