"""The records that pass between the parts: plain frozen data, numpy float64, time first."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kpirl_ocp.errors import ProblemError, SolveError
from kpirl_ocp.pictures import Brief, Panel, card, draw, svg

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]
R = TypeVar("R")


def record(kind: type[R], fields: dict[str, Any]) -> R:
    """A frozen record with all its fields, which are the package's own: without its checks and copies of users' arrays.

    It takes a fifth of the time, and keeps the dictionary.
    """
    made = object.__new__(kind)
    object.__setattr__(made, "__dict__", fields)
    return made


def max_or_nan(*numbers: float) -> float:
    """The largest number; NaN if there is one."""
    return math.nan if any(map(math.isnan, numbers)) else max(numbers)


def largest(values: Array) -> float:
    """Largest absolute value, 0 for an empty array, NaN if there is one."""
    return float(np.abs(values).max(initial=0.0))


def refuse_masked(name: str, value: object) -> None:
    """Raise ProblemError for masked entries: numpy hands over the numbers under the mask."""
    if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):
        count = int(np.ma.count_masked(value))
        raise ProblemError(f"{name} must be an array of numbers; {count} of them masked: fill them, or leave them out.")


def floats(name: str, value: ArrayLike) -> Array:
    """A value as an array of floating-point numbers, whatever their type. Raises ProblemError for what has none."""
    refuse_masked(name, value)
    if isinstance(value, np.ndarray) and value.dtype == float:
        return value
    try:
        array = np.asarray(value)
    except ValueError:
        array = np.array(None)
    if array.dtype.kind not in "biuf":
        raise ProblemError(f"{name} must be an array of numbers, got {type(value).__name__} of {array.dtype}.")
    return np.asarray(array, float)


@dataclass(frozen=True, repr=False)
class Trajectory(Brief):
    """States and actions over a horizon of T steps.

    states: (T+1, n_s).
    actions: (T, n_u).
    """

    states: Array
    actions: Array


@dataclass(frozen=True, repr=False)
class Demonstration(Brief):
    """The observations of one demonstration, its initial state and its context.

    s0: (n_s,) initial state.
    context: (n_c,) known to the cost, e.g. the goal keypoints.
    observations: (T+1, n_z), which the IRL loss compares with `OCP.observation` of the planned states.
    actions: (T, n_u), for losses on actions; None where they were not recorded.
    frames: (k,) ascending times t that were observed, if not all were; then observations are (k, n_z).

    Raises ProblemError for arrays that are not finite, and frames that do not fit the observations.
    """

    s0: Array
    context: Array
    observations: Array
    actions: Array | None = field(default=None, kw_only=True)
    frames: Indices | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        for name in ("s0", "context", "observations", "actions"):
            if getattr(self, name) is None and name == "actions":
                continue
            value = floats(f"the demonstration's {name}", getattr(self, name))
            if not np.isfinite(value).all():
                raise ProblemError(f"the demonstration's {name} must be finite; it holds NaN or infinity.")
            object.__setattr__(self, name, value)
        if self.frames is not None:
            frames = np.asarray(self.frames)
            whole = frames.ndim == 1 and frames.dtype.kind in "iu"
            if not whole or len(frames) != len(self.observations) or (np.diff(frames, prepend=-1) <= 0).any():
                raise ProblemError("the demonstration's frames must be ascending times, one for every observation.")
            object.__setattr__(self, "frames", frames.astype(np.intp))

    @property
    def horizon(self) -> int:
        """T, number of steps; that of the actions, or up to the last frame."""
        if self.actions is not None:
            return len(self.actions)
        return len(self.observations) - 1 if self.frames is None else int(self.frames[-1])


@dataclass(frozen=True, eq=False, repr=False)
class Sight(Brief):
    """One look of a robot: detected keypoints and measured joints at the same moment.

    keypoints: (K, 3), x and y [half an image] and the confidence mu in [0, 1].
    joints: (n_joints,) [rad]. velocities: (n_joints,) [rad/s].
    """

    keypoints: Array
    joints: Array
    velocities: Array


class Status(Enum):
    """End of a solve; the value is the remedy."""

    CONVERGED = "the KKT conditions hold to the solver's tolerance."
    STEPS_TAKEN = (
        "all steps were taken, short of stationarity. Right for unrolled gradients and real-time iterations; "
        "for a converged OCP take more gradient steps, another step size, or another solver."
    )
    ITERATION_LIMIT = "the iteration limit was reached. Raise max_iterations, or pass a better guess."
    INFEASIBLE = "no feasible point was found nearby. Relax the bounds or path constraints, or pass another guess."
    STALLED = "no further progress was possible. Rescale the problem, smooth its kinks, or pass another guess."
    DIVERGED = (
        "the iterates diverged, or left the domain of a function. Add effort weight or bounds, so that the cost has a "
        "minimum; of GradientDescent, use a smaller step_size."
    )
    NOT_FINITE = "a function returned NaN or infinity. Check s0, psi, context, the guess, and dynamics and costs there."
    FAILED = "the solver gave up; its own message says why."
    NOT_A_MINIMUM = (
        "a stationary point that is no minimum: the Hessian is not positive there, and no way led down from it. "
        "Pass another guess, or add effort weight."
    )
    ACCEPTABLE = (
        "the KKT conditions hold as far as rounding lets them, short of the tolerance. Rescale the problem for more."
    )

    @property
    def ok(self) -> bool:
        """True when the solver finished its task."""
        return self in (Status.CONVERGED, Status.STEPS_TAKEN, Status.ACCEPTABLE)


@dataclass(frozen=True, repr=False)
class Multipliers(Brief):
    """Lagrange multipliers of

        J + dynamics . (f - s_next) + state . s + action . u + path . h + path_equality . e
          + terminal . g_T + terminal_equality . e_T

    with g_T the rows of `OCP.terminal_inequality`. The gradient of this sum vanishes at a solution.

    dynamics: (T, n_s) costates; row t belongs to s_{t+1} = f(s_t, u_t).
    state: (T+1, n_s) bounds on s_0 .. s_T; positive pushes from the upper, negative from the lower bound. Row 0 is
        zero where s_0 is given.
    action: (T, n_u) bounds on u_0 .. u_{T-1}; the same signs.
    path: (T, n_h) of h <= 0; never negative at a solution.
    path_equality: (T, n_e) of e = 0; of either sign. None stands for a problem that has none, also below.
    terminal: (n_gT,) of g_T <= 0; never negative at a solution.
    terminal_equality: (n_eT,) of e_T = 0; of either sign.
    """

    dynamics: Array
    state: Array
    action: Array
    path: Array
    path_equality: Array = None  # type: ignore[assignment]
    terminal: Array = None  # type: ignore[assignment]
    terminal_equality: Array = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        shapes = {"path_equality": (*np.shape(self.dynamics)[:1], 0), "terminal": (0,), "terminal_equality": (0,)}
        for name, value in vars(self).items():
            none = value is None and name in shapes
            array = np.zeros(shapes[name]) if none else floats(f"multipliers.{name}", value)
            if array is not value:
                object.__setattr__(self, name, array)


@dataclass(frozen=True)
class KKTResiduals:
    """Residuals of the first-order conditions at a point; every entry is a largest absolute value.

    stationarity: gradient of the Lagrangian.
    feasibility: violation of dynamics, bounds and path constraints, in their own units.
    complementarity: multiplier times slack, minus the barrier parameter.
    sign: multipliers of the wrong sign.
    scale: max(1, gradient of the objective, multipliers); `worst` is relative to it.
    """

    stationarity: float
    feasibility: float
    complementarity: float
    sign: float
    scale: float

    @property
    def worst(self) -> float:
        """Feasibility, or the largest other residual over `scale`; NaN if any of them is."""
        dual = max_or_nan(self.stationarity, self.complementarity, self.sign)
        return max_or_nan(self.feasibility, float(dual) / self.scale)


@dataclass(frozen=True, repr=False)
class Solution:
    """A trajectory with the evidence for its optimality.

    objective: value of the cost.
    psi, context: (n_psi,), (n_c,) that it was solved for; s_0 is states[0].
    barrier: complementarity parameter tau of the problem that was solved; 0 for the problem itself.
    message: the backend's own status text; of an infeasible one, which constraint is violated most.
    """

    trajectory: Trajectory
    multipliers: Multipliers
    objective: float
    residuals: KKTResiduals
    status: Status
    iterations: int
    psi: Array
    context: Array
    barrier: float = 0.0
    message: str = ""

    def __post_init__(self) -> None:
        for name in ("psi", "context"):  # copies: a caller may go on to change its arrays
            object.__setattr__(self, name, np.array(getattr(self, name), float))

    @property
    def states(self) -> Array:
        """(T+1, n_s)."""
        return self.trajectory.states

    @property
    def actions(self) -> Array:
        """(T, n_u)."""
        return self.trajectory.actions

    def raise_if_failed(self) -> Solution:
        """Return self, or raise SolveError with the remedy when the status is not ok."""
        if not self.status.ok:
            raise SolveError(str(self))
        return self

    def panels(self) -> tuple[Panel, Panel]:
        """States and actions over time, to be drawn."""
        states, actions = (
            [f"{name}{i}" for i in range(values.shape[1])] for name, values in (("s", self.states), ("u", self.actions))
        )
        return Panel("states", self.states, states), Panel("actions", self.actions, actions, stairs=True)

    def _repr_html_(self) -> str:
        facts = {
            "objective": f"{self.objective:.6g}",
            "KKT residual": f"{self.residuals.worst:.1e}",
            "iterations": str(self.iterations),
        }
        return card(f"{self.status.name}: {self.status.value}", facts, svg(draw(self.panels())))

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {len(self.actions)} steps, {self}>"

    def __str__(self) -> str:
        backend = f"; {self.message}" if self.message else ""
        return (
            f"{self.status.name}: {self.status.value} (objective {self.objective:.6g}, "
            f"KKT residual {self.residuals.worst:.1e} after {self.iterations} iterations{backend})"
        )
