"""What is asked of the problems beside their optima: gradients that are those of differences, and learning."""

from __future__ import annotations

import numpy as np

from kpirl_ocp import LBFGS, Demonstration, Implicit, Riccati, Solution, learn, sensitivity
from kpirl_ocp.ocp.problem import Solver
from kpirl_ocp.types import Array

from .problems import Instance, Reference

STEPS = {"glider": 200, "hanging chain": 200}  # coarser ones have no solution near the guess
STEPS |= {"free-flying robot": 40, "quadrotor, two obstacles": 40}  # with 39 there are several plans
STEPS |= {"limit cycle": 40}  # with 39 Fatrop ends at a residual of 6e-7


def coarse(reference: Reference, most: int = 39) -> Instance:
    """With an odd number of steps, so that an action that switches in the middle is free."""
    return reference.build(STEPS.get(reference.name, min(reference.steps, most)))


def solve(case: Instance, solver: Solver, **changes: object) -> Solution:
    """The plan from the guess of the problem."""
    return solver.solve(case.problem, **{"s0": case.s0, "psi": case.psi, "guess": case.guess} | changes)


def gradient_error(case: Instance) -> float:
    """Of the certified gradient of a random linear loss by s0 and psi, relative to extrapolated central differences.

    The least of three steps. Raises CertificateError where the gradient is not certified.
    """
    solver, rng = Riccati(1e-13), np.random.default_rng(0)
    plan = solve(case, solver)
    by_states, by_actions = rng.normal(size=plan.states.shape), rng.normal(size=plan.actions.shape)
    pulled = sensitivity(case.problem, plan).pull(by_states, by_actions)
    at = np.concatenate([case.problem.inputs(case.s0, case.psi, ())[0], case.psi])

    def loss(numbers: Array) -> float:
        s0, psi = np.split(numbers, [case.problem.n_states])
        found = solve(case, solver, s0=s0, psi=psi, guess=plan)
        return np.sum(by_states * found.states) + np.sum(by_actions * found.actions) if found.status.ok else np.nan

    def slope(step: Array) -> float:
        return (loss(at + step) - loss(at - step)) / (2 * np.abs(step).max())

    moved = np.append(~case.problem.free_start, np.ones(len(case.psi), bool))
    found, errors = np.concatenate([pulled.s0, pulled.psi])[moved], []
    for size in (1e-3, 1e-4, 1e-5):
        steps = size * np.diag(np.maximum(1, np.abs(at)))[moved]
        expected = np.array([(4 * slope(step / 2) - slope(step)) / 3 for step in steps])
        errors.append(np.abs(found - expected).max() / np.abs(expected).max())
    return float(np.nanmin(errors))


def learned(case: Instance) -> tuple[float, float]:
    """Loss, and relative error of psi, of learning from one plan and 1.2 psi."""
    solver = Riccati(1e-12)
    plan = solve(case, solver).raise_if_failed()
    seen = Demonstration(case.s0, np.zeros(0), np.array(case.problem.observe(plan.states.T)).T)
    guesses = None if case.guess is None else [case.guess]
    settings = {"guesses": guesses, "scale": case.psi, "progress": False}
    method, optimiser = Implicit(solver), LBFGS(tolerance=0)
    result = learn(case.problem, [seen], 1.2 * case.psi, method, optimiser, steps=60, **settings)
    return float(result.loss), float(np.abs(result.psi / case.psi - 1).max())
