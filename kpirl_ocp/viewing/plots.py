"""`plot(result)`: a figure of a solution, of learning, or of a certificate."""

from __future__ import annotations

from dataclasses import replace
from functools import singledispatch

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.learning.result import LearningResult
from kpirl_ocp.ocp.problem.ocp import OCP, Bounds
from kpirl_ocp.ocp.sensitivity.certificate import Certificate
from kpirl_ocp.pictures import COLOURS, draw
from kpirl_ocp.types import Solution


@singledispatch
def plot(result: object, problem: OCP | None = None) -> Figure:
    """A figure of a result; `figure.savefig("plan.svg")` writes it, a notebook shows it.

    Args:
        result: a `Solution` (states and actions over time), a `LearningResult` (loss and parameters over the outer
            iterations), or a `Certificate` (the solution that was differentiated, under its verdict).
        problem: of a solution; its finite bounds are drawn as well.

    Raises:
        ProblemError: nothing is known about how to draw this.
    """
    kinds = "a Solution, a LearningResult or a Certificate"
    raise ProblemError(f"plot draws {kinds}, not a {type(result).__name__}.")


@plot.register
def _(result: Solution, problem: OCP | None = None) -> Figure:
    states, actions = result.panels()
    if not isinstance(problem, OCP | None):
        raise ProblemError(f"plot(solution, problem) needs the OCP as problem, got {type(problem).__name__}.")
    if problem is not None:
        states, actions = replace(states, names=_states(problem)), replace(actions, names=_actions(problem))
    figure = draw((states, actions))
    figure.suptitle(f"{result.status.name}, objective {result.objective:.6g}", fontsize=10)
    if problem is not None:
        _draw_bounds(figure.axes[0], problem.state_bounds, stairs=False)
        _draw_bounds(figure.axes[1], problem.action_bounds, stairs=True)
    return figure


@plot.register
def _(result: LearningResult, problem: OCP | None = None) -> Figure:
    figure = draw(result.panels())
    figure.suptitle(str(result), fontsize=10)
    return figure


@plot.register
def _(result: Certificate, problem: OCP | None = None) -> Figure:
    figure = plot(result.solution, problem)
    figure.suptitle(str(result), fontsize=9, wrap=True)
    return figure


def _states(problem: OCP) -> list[str]:
    """s of the user, q for static decisions, and slacks at the end."""
    added = problem.additions
    counts = {"s": problem.n_stated_states, "q": len(added.static), "end slack ": added.end_slacks}
    return [f"{name}{i}" for name, count in counts.items() for i in range(count)]


def _actions(problem: OCP) -> list[str]:
    """u of the user, and slacks."""
    counts = {"u": problem.n_stated_actions, "slack ": problem.additions.slacks}
    return [f"{name}{i}" for name, count in counts.items() for i in range(count)]


def _draw_bounds(axes: Axes, bounds: Bounds, stairs: bool) -> None:
    """The finite ones of bounds (n, k), dashed in the colours of what they bound.

    Those further from the lines than the lines are high stay outside, so that they do not flatten the lines.
    """
    low, high = axes.get_ylim()
    edges = np.array(bounds, float)
    near = edges[np.abs(edges - (low + high) / 2) <= 1.5 * (high - low)]
    for bound in bounds:
        for index, column in enumerate(np.asarray(bound, float).T):
            style = {"color": COLOURS[index % len(COLOURS)], "linestyle": "--", "linewidth": 0.8, "zorder": 1}
            if not np.isfinite(column).any():
                continue
            if stairs:
                axes.stairs(column, baseline=None, **style)
            else:
                axes.plot(column, **style)
    margin = 0.05 * (high - low)
    axes.set_ylim(min([low, *(near - margin)]), max([high, *(near + margin)]))
