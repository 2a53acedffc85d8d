"""Learning costs from visual demonstrations: the paper's way, with the converged inner problem, and its baseline.

The paper's inner loop takes N gradient steps of size alpha and is differentiated by unrolling; its weights are free.
The converged inner problem needs an effort weight and positive weights. Its plan moves about as far as N gradient steps
with an effort weight rho = 1 / (2 alpha N); the cost is divided by rho, so that the effort weight is 1 and the other
weights are small. They are softplus of their parameters, which scales small weights and shifts large ones. The gradient
is implicit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.hypergradients.certificate import Hypergradient
from kpirl_ocp.irl.hypergradients.implicit import Implicit
from kpirl_ocp.irl.hypergradients.unrolled import Unrolled
from kpirl_ocp.irl.learning.apprenticeship import apprenticeship
from kpirl_ocp.irl.learning.learn import learn
from kpirl_ocp.irl.learning.optimisers import LBFGS, Adam, Optimiser
from kpirl_ocp.irl.visual.planning_costs import PlanningCost, learning_problem
from kpirl_ocp.ocp.models.keypoint_costs import RBF, Basis, KeypointCost, TimeDependent, Weighted
from kpirl_ocp.ocp.models.keypoint_dynamics import NetworkDynamics
from kpirl_ocp.ocp.problem.solver import Solver
from kpirl_ocp.ocp.solvers.gradient_descent import GradientDescent
from kpirl_ocp.ocp.solvers.riccati import Riccati
from kpirl_ocp.pictures import Brief
from kpirl_ocp.types import Array, Demonstration

COSTS: Mapping[str, Basis] = {"Weighted": Weighted(), "TimeDep": TimeDependent(), "RBF": RBF()}
Effort = Literal["fixed", "learned", "learned per step"]
CONVERGED = Riccati(tolerance=1e-9)  # solves the converged inner problem, in learning and in planning
ADAM = Adam(1e-2)  # with the rate of the paper's code
_LEAST_WEIGHT = 0.5  # starting weights are drawn between this and _LARGEST_WEIGHT, as in the simulation study
_LARGEST_WEIGHT = 1.5


@dataclass(frozen=True)
class InnerLoop:
    """N gradient steps of size alpha."""

    steps: int
    step_size: float

    @property
    def solver(self) -> GradientDescent:
        """The steps themselves."""
        return GradientDescent(self.steps, self.step_size)

    @property
    def effort(self) -> float:
        """The effort weight with which the converged plan moves about as far as N gradient steps do."""
        return 1 / (2 * self.steps * self.step_size)


@dataclass(frozen=True, eq=False, repr=False)
class LearnedPlan(Brief):
    """A learned cost and the history of learning.

    family, psi: the family of costs, and the learned parameters (n_psi,) of its member.
    losses: (n+1,) mean training IRL loss after 0 .. n outer iterations. best: the iteration whose cost was kept.
    seconds: wall time of learning.
    """

    cost: PlanningCost
    family: KeypointCost
    psi: Array
    losses: Array
    best: int
    seconds: float


def starting_weights(basis: Basis, horizon: int, n_observations: int, rng: np.random.Generator) -> Array:
    """Random initial weights (J, n_z), constant over time and different for each coordinate."""
    scale = rng.uniform(_LEAST_WEIGHT, _LARGEST_WEIGHT, n_observations)
    return np.tile(scale, (basis.matrix(horizon).shape[1], 1))


def learn_unrolled(
    dynamics: NetworkDynamics,
    demonstrations: Sequence[Demonstration],
    basis: Basis,
    inner: InnerLoop,
    iterations: int,
    rng: np.random.Generator,
    optimiser: Optimiser = ADAM,
    learn_effort: bool = False,
    start: float | None = None,
) -> LearnedPlan:
    """Learn with unrolled gradients, the paper's Algorithm 1.

    Args:
        iterations: number of outer iterations.
        rng: draws the initial weights, unless `start` gives them.
        optimiser: Adam as in the paper's code, or `Descent` as in the paper's text.
        learn_effort: learn one effort weight too, starting from a small value; the paper has none.
        start: one initial value for all weights, as in the paper's code.

    Raises:
        ProblemError: demonstrations differ in length.
        CertificateError: a loss or gradient became NaN.
    """
    rho = 0.1 * inner.effort if learn_effort else 0.0
    cost = KeypointCost(basis, effort=rho, learn_effort=learn_effort)
    weights = starting_weights(basis, horizon_of(demonstrations), dynamics.n_z, rng)
    if start is not None:
        weights = np.full_like(weights, start)
    method = Unrolled(inner.solver)
    return _learn(dynamics, demonstrations, cost, weights, method, optimiser, iterations, inner.solver)


def learn_implicit(
    dynamics: NetworkDynamics,
    demonstrations: Sequence[Demonstration],
    basis: Basis,
    inner: InnerLoop,
    iterations: int,
    rng: np.random.Generator,
    effort: Effort = "fixed",
) -> LearnedPlan:
    """Learn with implicit gradients of the converged plan, by L-BFGS, which may stop before `iterations`.

    Raises:
        ProblemError: demonstrations differ in length.
        CertificateError: the gradient at the start is not certified.
    """
    horizon = horizon_of(demonstrations)
    rho: float | tuple[float, ...] = (1.0,) * horizon if effort == "learned per step" else 1.0
    cost = KeypointCost(basis, effort=rho, learn_effort=effort != "fixed", positivity="softplus")
    weights = starting_weights(basis, horizon, dynamics.n_z, rng) / inner.effort
    return _learn(dynamics, demonstrations, cost, weights, Implicit(CONVERGED), LBFGS(), iterations, CONVERGED)


def learn_by_apprenticeship(
    dynamics: NetworkDynamics,
    demonstrations: Sequence[Demonstration],
    inner: InnerLoop,
    iterations: int,
    rng: np.random.Generator,
) -> LearnedPlan:
    """The baseline: apprenticeship learning of a Weighted cost, with the paper's inner loop."""
    horizon, cost = horizon_of(demonstrations), KeypointCost(Weighted())
    problem = learning_problem(dynamics, cost, horizon)
    result = apprenticeship(problem, demonstrations, inner.solver, iterations, rng)
    planned = PlanningCost.of(cost, result.psi, horizon, dynamics.n_z, inner.solver)
    return LearnedPlan(planned, cost, result.psi, result.losses, int(np.argmin(result.losses)), result.seconds)


def horizon_of(demonstrations: Sequence[Demonstration]) -> int:
    """The common T. Raises ProblemError if demonstrations differ in length, or there are none."""
    horizons = {demonstration.horizon for demonstration in demonstrations}
    if len(horizons) != 1:
        raise ProblemError(f"demonstrations must have one length, got T = {sorted(horizons) or 'none at all'}.")
    return horizons.pop()


def _learn(
    dynamics: NetworkDynamics,
    demonstrations: Sequence[Demonstration],
    cost: KeypointCost,
    weights: Array,
    method: Hypergradient,
    optimiser: Optimiser,
    iterations: int,
    solver: Solver,
) -> LearnedPlan:
    horizon, n_z = horizon_of(demonstrations), dynamics.n_z
    problem = learning_problem(dynamics, cost, horizon)
    psi0 = cost.initial(horizon, n_z, weights)
    result = learn(problem, demonstrations, psi0, method, optimiser, iterations, progress=False).raise_if_interrupted()
    planned = PlanningCost.of(cost, result.psi, horizon, n_z, solver)
    best, seconds = int(np.argmin(result.losses)), float(result.seconds[-1])
    return LearnedPlan(planned, cost, result.psi, result.losses, best, seconds)
