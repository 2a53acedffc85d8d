"""The record of a learning run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kpirl_ocp.irl.learning.optimisers import Point
from kpirl_ocp.pictures import Panel, card, draw, svg
from kpirl_ocp.types import Array, Solution


@dataclass(frozen=True, repr=False)
class LearningResult:
    """The learned psi and the history of learning.

    psi: (n_psi,) with the lowest training loss. loss: that loss.
    losses: (n+1,) training loss after 0 .. n steps. psis: (n+1, n_psi).
    seconds: (n+1,) wall time since the start. uncertified: (n+1,) gradients used that were only flagged.
    solutions: the plans for psi, one per demonstration. interrupted: True if Ctrl-C ended it.
    """

    psi: Array
    loss: float
    losses: Array
    psis: Array
    seconds: Array
    uncertified: Array
    solutions: tuple[Solution, ...] = ()
    interrupted: bool = False

    @classmethod
    def of(cls, best: Point, history: Sequence[tuple[Point, float]], interrupted: bool) -> LearningResult:
        """The result of the best point, and all points with the seconds since the start."""
        points = [point for point, _ in history]
        return cls(
            psi=best.psi,
            loss=best.loss,
            losses=np.array([point.loss for point in points]),
            psis=np.array([point.psi for point in points]),
            seconds=np.array([seconds for _, seconds in history]),
            uncertified=np.array([point.uncertified for point in points]),
            solutions=best.solutions,
            interrupted=interrupted,
        )

    def raise_if_interrupted(self) -> LearningResult:
        """This result. Raises KeyboardInterrupt if Ctrl-C ended it, for callers that need learning to be finished."""
        if self.interrupted:
            raise KeyboardInterrupt
        return self

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
