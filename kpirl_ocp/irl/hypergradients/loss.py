"""IRL losses: distances of a plan from a demonstration.

The paper's (section "Cost functions and IRL Loss") is `squared_distance`,  L = sum_{t=0}^{T} |z_t - z_demo,t|^2. A loss
is a function of states, actions and the data that it takes from a demonstration.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import casadi as ca
import numpy as np

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.statement.checks import shown
from kpirl_ocp.types import Array, Demonstration

Loss: TypeAlias = Callable[[OCP], ca.Function]
"""problem -> function (S (n_s, T+1), U (n_u, T), data (n_data, T+1)) -> scalar.

It may have a method `data(problem, demonstration) -> (n_data, T+1)`; without one, the data are the observations.
"""


def data_of(loss: Loss, problem: OCP, demonstration: Demonstration) -> Array:
    """The data (n_data, T+1) that a loss takes from a demonstration. Raises ProblemError if they do not fit."""
    read: Callable[[OCP, Demonstration], Array] = getattr(loss, "data", demonstrated_observations)
    return read(problem, demonstration)


def demonstrated_observations(problem: OCP, demonstration: Demonstration) -> Array:
    """Observations of the demonstration as (n_z, T+1). Raises ProblemError if they do not fit the problem."""
    expected = (problem.horizon + 1, problem.n_observations)
    if demonstration.frames is not None:
        raise ProblemError("the demonstration was observed at some frames only: use loss=KeyFrames().")
    found = demonstration.observations.shape
    if found != expected:
        hint = _mended(problem, found)
        raise ProblemError(f"the demonstration's observations must be (T+1, n_z) = {expected}, got {found}{hint}.")
    return demonstration.observations.T


def _mended(problem: OCP, found: tuple[int, ...]) -> str:
    """A hint for observations of another shape, if there is one."""
    if found == (problem.horizon + 1, problem.n_states):
        return ": these may be states, whose observations are problem.observe(states.T).full().T"
    if found[1:] == (problem.n_observations,):
        return "; for demonstrations of other lengths, `learn` takes a function T -> problem"
    return ""


def squared_distance(problem: OCP) -> ca.Function:
    """Squared distance between planned and demonstrated observations, summed over time and coordinates."""
    states, actions, observed = _symbols(problem, problem.n_observations)
    return ca.Function("loss", [states, actions, observed], [ca.sumsqr(problem.observe(states) - observed)])


@dataclass(frozen=True)
class KeyFrames:
    """Squared distance of observations at the demonstration's frames alone (Jin et al., 2022, at known times)."""

    def __call__(self, problem: OCP) -> ca.Function:
        """The function; its data are observations and, in the last row, 1 where there is one."""
        states, actions, data = _symbols(problem, problem.n_observations + 1)
        off = (problem.observe(states) - data[:-1, :]) * ca.repmat(data[-1, :], problem.n_observations, 1)
        return ca.Function("loss", [states, actions, data], [ca.sumsqr(off)])

    def data(self, problem: OCP, demonstration: Demonstration) -> Array:
        """(n_z + 1, T+1), zeros where nothing was observed. Raises ProblemError for frames beyond the horizon."""
        frames = np.arange(len(demonstration.observations)) if demonstration.frames is None else demonstration.frames
        expected = (len(frames), problem.n_observations)
        if demonstration.observations.shape != expected or (frames > problem.horizon).any():
            raise ProblemError(
                f"the demonstration's observations must be (k, n_z) = {expected} at frames up to {problem.horizon}; "
                f"got {demonstration.observations.shape} at frames up to {frames.max(initial=0)}."
            )
        data = np.zeros((problem.n_observations + 1, problem.horizon + 1))
        data[:-1, frames], data[-1, frames] = demonstration.observations.T, 1.0
        return data


@dataclass(frozen=True)
class ActionDistance:
    """Squared distance between planned and demonstrated actions, summed over time; slacks do not count."""

    def __call__(self, problem: OCP) -> ca.Function:
        """The function; its data are the actions, with a column of zeros for s_T."""
        states, actions, data = _symbols(problem, problem.n_stated_actions)
        off = actions[: problem.n_stated_actions, :] - data[:, : problem.horizon]
        return ca.Function("loss", [states, actions, data], [ca.sumsqr(off)])

    def data(self, problem: OCP, demonstration: Demonstration) -> Array:
        """(n_u, T+1). Raises ProblemError for a demonstration without actions, or of another shape."""
        expected = (problem.horizon, problem.n_stated_actions)
        if demonstration.actions is None or demonstration.actions.shape != expected:
            found = "none" if demonstration.actions is None else demonstration.actions.shape
            raise ProblemError(f"the demonstration's actions must be (T, n_u) = {expected}, got {found}.")
        return np.pad(demonstration.actions.T, ((0, 0), (0, 1)))


@dataclass(frozen=True)
class WeightedSum:
    """A sum of losses, each with its weight.

    parts: pairs of weight and loss.
    """

    parts: tuple[tuple[float, Loss], ...]

    def __post_init__(self) -> None:
        if not isinstance(self.parts, Sequence) or not self.parts or not all(map(_weighed, self.parts)):
            raise ProblemError(f"parts must be pairs (weight, loss), at least one, got {shown(self.parts)}.")

    def __call__(self, problem: OCP) -> ca.Function:
        """The function; its data are those of all parts, one below the other."""
        functions = [(weight, loss(problem)) for weight, loss in self.parts]
        lengths = [function.size1_in(2) for _, function in functions]
        states, actions, data = _symbols(problem, sum(lengths))
        pieces = ca.vertsplit(data, np.cumsum([0, *lengths]).tolist())
        total = sum(
            w * function(states, actions, piece) for (w, function), piece in zip(functions, pieces, strict=True)
        )
        return ca.Function("loss", [states, actions, data], [total])

    def data(self, problem: OCP, demonstration: Demonstration) -> Array:
        """(sum of n_data, T+1)."""
        return np.vstack([data_of(loss, problem, demonstration) for _, loss in self.parts])


def _weighed(part: Any) -> bool:
    return isinstance(part, Sequence) and len(part) == 2 and bool(np.isscalar(part[0])) and callable(part[1])


def _symbols(problem: OCP, n_data: int) -> tuple[ca.MX, ca.MX, ca.MX]:
    """S, U and data."""
    states, actions = problem.symbols()[:2]
    return states, actions, ca.MX.sym("Z", n_data, problem.horizon + 1)
