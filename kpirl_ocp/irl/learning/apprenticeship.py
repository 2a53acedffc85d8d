"""Apprenticeship learning (Abbeel and Ng, 2004), the paper's baseline (Algorithm 2, appendix A.4).

The cost C_psi = psi . phi is the Weighted cost, with features phi_i = sum_t gamma^t (z_t[i] - z_goal[i])^2. Every epoch
finds the cost under which the expert beats all plans so far by the largest margin, and plans with it:

    psi = argmax_{|psi| <= 1} min_j psi . (mu_j - mu_E),        mu_j = features of plan j, mu_E = of the expert.

The paper writes mu_E - mu_j, right for a reward; a cost is to be low for the expert. `margins` has other rules. Where
the context holds a target for every step, (T n_z,), the same features are the per-step IRL losses of appendix A.4.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.learning.evaluation import evaluate
from kpirl_ocp.irl.learning.margins import Rule, largest_margin
from kpirl_ocp.ocp.problem.guards import dense
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.solvers.gradient_descent import GradientDescent
from kpirl_ocp.pictures import Brief
from kpirl_ocp.types import Array, Demonstration


@dataclass(frozen=True, repr=False)
class ApprenticeshipResult(Brief):
    """The history of the baseline.

    psi: (n_z,) with the lowest training loss. loss: that loss.
    losses: (epochs,) training IRL loss of each epoch's plan. psis: (epochs, n_z). margins: (epochs,).
    separable: False if the rule found no margin in the end, where Abbeel and Ng's algorithm stops: the expert's
        features are a mixture of those found, and no cost tells them apart.
    seconds: wall time.
    """

    psi: Array
    loss: float
    losses: Array
    psis: Array
    margins: Array
    separable: bool
    seconds: float


def apprenticeship(
    problem: OCP,
    demonstrations: Sequence[Demonstration],
    solver: GradientDescent,
    epochs: int,
    rng: np.random.Generator,
    discount: float = 1.0,
    initial_spread: float = 0.05,
    rule: Rule = largest_margin,
) -> ApprenticeshipResult:
    """Run the baseline with the inner loop of the unrolled method.

    Args:
        problem: a keypoint problem with the Weighted cost, identity parametrisation and no effort.
        epochs: plans after the first one, at most.
        discount: gamma of the features.
        rng, initial_spread: the first plan takes random actions of this standard deviation [rad].
        rule: how psi follows from the features of all plans so far and of the expert.

    Raises:
        ProblemError: another cost, no epoch, or a first plan that already has the expert's features.
    """
    if epochs < 1:
        raise ProblemError(f"apprenticeship learning needs at least one epoch, got {epochs}.")
    for demonstration in demonstrations:
        _check_cost(problem, demonstration)
    started = time.perf_counter()
    expert = np.mean([features(demo.observations, demo, discount) for demo in demonstrations], axis=0)
    found = [_random_plan(problem, demonstrations, rng, discount, initial_spread)]
    history: list[tuple[Array, float, float]] = []
    separable = True
    for _ in range(epochs):
        psi, margin = rule(np.array(found), expert)
        separable = margin > 0
        if not separable:
            break
        plans = evaluate(problem, demonstrations, psi, solver)
        pairs = zip(plans.solutions, demonstrations, strict=True)
        found.append(np.mean([_features_of(problem, plan.states, demo, discount) for plan, demo in pairs], axis=0))
        history.append((psi, float(plans.losses.mean()), margin))
    if not history:
        raise ProblemError("the first, random plan already has the expert's features: there is nothing to learn.")
    psis, losses, margins = (np.array(column) for column in zip(*history, strict=True))
    best = int(np.argmin(losses))
    seconds = time.perf_counter() - started
    return ApprenticeshipResult(psis[best], float(losses[best]), losses, psis, margins, separable, seconds)


def features(observations: Array, demonstration: Demonstration, discount: float = 1.0) -> Array:
    """phi (n_z,) of observations (T+1, n_z): discounted squared distances to the target, summed over t = 1..T.

    The target is the demonstration's context: one for all steps, (n_z,), or one for each, (T n_z,).

    The same observations have the same features to the last bit, however they lie in memory.
    """
    errors = np.ascontiguousarray(observations[1:] - demonstration.context.reshape(-1, observations.shape[1])) ** 2
    return (discount ** np.arange(1, len(observations))[:, None] * errors).sum(axis=0)


def _check_cost(problem: OCP, demonstration: Demonstration) -> None:
    """Raise ProblemError unless the cost of standing still is psi . features, for psi = 1 and psi = 2."""
    actions = np.zeros((problem.horizon, problem.n_actions))
    fits = problem.n_parameters == problem.n_observations
    for psi in (np.full(problem.n_parameters, value) for value in (1.0, 2.0) if fits):
        states = problem.simulate(demonstration.s0, actions, psi).states
        cost = float(problem.cost(states.T, actions.T, psi, demonstration.context))
        expected = psi @ _features_of(problem, states, demonstration, discount=1.0)
        fits = bool(np.isclose(cost, expected, rtol=1e-9, atol=0.0))
    if not fits:
        raise ProblemError("apprenticeship learning needs a cost psi . features: Weighted, positivity='identity'.")


def _features_of(problem: OCP, states: Array, demonstration: Demonstration, discount: float) -> Array:
    return features(dense(problem.observe(states.T)).T, demonstration, discount)


def _random_plan(
    problem: OCP, demonstrations: Sequence[Demonstration], rng: np.random.Generator, discount: float, spread: float
) -> Array:
    actions = rng.normal(0.0, spread, (problem.horizon, problem.n_actions))
    states = [problem.simulate(demo.s0, actions, np.zeros(problem.n_parameters)).states for demo in demonstrations]
    pairs = zip(states, demonstrations, strict=True)
    return np.mean([_features_of(problem, plan, demo, discount) for plan, demo in pairs], axis=0)
