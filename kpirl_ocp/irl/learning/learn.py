"""Gradient-based IRL (the paper's Algorithm 1), for one or several demonstrations.

    psi <- optimiser step on the mean over demonstrations of L_IRL(tau(psi), tau_demo)

The mean, not the sum, so that a learning rate means the same for one demonstration and for ten.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from tqdm import tqdm

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.hypergradients.certificate import Hypergradient
from kpirl_ocp.irl.hypergradients.unrolled import Unrolled
from kpirl_ocp.irl.learning.optimisers import Adam, Optimiser, Point
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.pictures import Panel, card, draw, svg
from kpirl_ocp.types import Array, Demonstration


@dataclass(frozen=True)
class LearningState:
    """State of learning: the evaluated psi, the optimiser's memory, and the best point so far."""

    point: Point
    memory: Any
    best: Point


@dataclass(frozen=True)
class Learner:
    """One outer iteration at a time: `init(psi0) -> state`, `step(state) -> state`; no hidden state."""

    problem: OCP
    demonstrations: Sequence[Demonstration]
    hypergradient: Hypergradient
    optimiser: Optimiser

    def __post_init__(self) -> None:
        if not self.demonstrations:
            raise ProblemError("learning needs at least one demonstration.")

    def evaluate(self, psi: Array) -> Point:
        """Mean loss and gradient over the demonstrations."""
        if isinstance(self.hypergradient, Unrolled):
            results = self.hypergradient.batch(self.problem, self.demonstrations, psi)
        else:
            results = [self.hypergradient(self.problem, demonstration, psi) for demonstration in self.demonstrations]
        return Point(
            psi=psi,
            loss=float(np.mean([result.loss for result in results])),
            gradient=np.mean([result.gradient for result in results], axis=0),
            uncertified=sum(not result.certificate.certified for result in results),
        )

    def init(self, psi0: ArrayLike) -> LearningState:
        """Evaluate psi0 (n_psi,)."""
        point = self.evaluate(np.array(psi0, float))
        return LearningState(point, self.optimiser.start(point), point)

    def step(self, state: LearningState) -> LearningState:
        """Move psi once."""
        point, memory = self.optimiser.step(self.evaluate, state.point, state.memory)
        return LearningState(point, memory, min(state.best, point, key=lambda p: p.loss))


@dataclass(frozen=True, repr=False)
class LearningResult:
    """The learned psi and the history of learning.

    psi: (n_psi,) with the lowest training loss. loss: that loss.
    losses: (n+1,) training loss after 0 .. n steps. psis: (n+1, n_psi).
    seconds: (n+1,) wall time since the start. uncertified: (n+1,) gradients used that were only flagged.
    """

    psi: Array
    loss: float
    losses: Array
    psis: Array
    seconds: Array
    uncertified: Array

    def panels(self) -> tuple[Panel, Panel]:
        """Training loss and parameters over the outer iterations, to be drawn."""
        loss = Panel("training loss", self.losses, xlabel="outer iteration", log=bool((self.losses > 0).all()))
        names = [f"psi[{i}]" for i in range(self.psis.shape[1])]
        return loss, Panel("parameters", self.psis, names, xlabel="outer iteration")

    def _repr_html_(self) -> str:
        uncertified = f"{int((self.uncertified > 0).sum())} of {len(self.losses)}"
        facts = {"time": f"{self.seconds[-1]:.1f} s", "iterations without certified gradients": uncertified}
        return card(str(self), facts, svg(draw(self.panels())))

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self}>"

    def __str__(self) -> str:
        return f"loss {self.losses[0]:.4g} -> {self.loss:.4g} in {len(self.losses) - 1} outer iterations"


def learn(
    problem: OCP,
    demonstrations: Sequence[Demonstration],
    psi0: ArrayLike,
    hypergradient: Hypergradient,
    optimiser: Optimiser | None = None,
    steps: int = 100,
    progress: bool = True,
) -> LearningResult:
    """Learn psi from demonstrations.

    Ends after `steps`, or sooner when the optimiser makes no progress.

    Args:
        psi0: (n_psi,) start.
        hypergradient: `Implicit()`, `Unrolled(...)`, ...; it holds the inner solver and the loss.
        optimiser: by default Adam at the paper's learning rate.
        steps: outer iterations, at most.

    Returns:
        The psi (n_psi,) with the lowest training loss, the mean over the demonstrations, and the history.

    Raises:
        ProblemError: there is no demonstration, or one does not fit the problem.
        CertificateError: a gradient was not certified and the hypergradient's policy is "raise".
    """
    learner = Learner(problem, tuple(demonstrations), hypergradient, optimiser or Adam())
    started = time.perf_counter()
    state = learner.init(psi0)
    history = [(state.point, time.perf_counter() - started)]
    with tqdm(range(steps), desc="learning", disable=not progress, unit="step") as bar:
        for _ in bar:
            previous, state = state, learner.step(state)
            if state.point is previous.point:  # the optimiser has nothing left to gain
                break
            history.append((state.point, time.perf_counter() - started))
            bar.set_postfix(loss=f"{state.point.loss:.4g}", best=f"{state.best.loss:.4g}", refresh=False)
    points = [point for point, _ in history]
    return LearningResult(
        psi=state.best.psi,
        loss=state.best.loss,
        losses=np.array([point.loss for point in points]),
        psis=np.array([point.psi for point in points]),
        seconds=np.array([seconds for _, seconds in history]),
        uncertified=np.array([point.uncertified for point in points]),
    )
