"""Closed loop with one Newton step per control step, warm-started: the real-time iteration.

The plant is the model with a little noise on its keypoints, and the goal moves on a circle.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bench.part import Numbers, Part, Table
from bench.settings import Preset
from bench.timing import Timing, seconds
from kpirl_ocp import Riccati
from kpirl_ocp.irl.cases.network_cases import N_Z, NetworkCase
from kpirl_ocp.types import Array

BARRIER = 1e-2  # tau; with 1e-4 single steps creep along the bounds, and the loop does not follow the goal
NOISE = 1e-3  # of a keypoint coordinate and step
RADIUS = 0.03  # of the goal's circle [image units]
_PERIOD = 50  # of the goal [control steps]
PUBLIC, CONVERGED = "Riccati(steps=1)", "solved to 1e-8 at every step"
Controller = Callable[[Array, Array], Array]
"""State (n_s,) and goal (n_z,) -> action (n_u,)."""


def measure(preset: Preset) -> Part:
    """Random tanh weights and the trained model, bounded."""
    numbers: Numbers = {}
    rows = []
    for data in preset.models("tanh"):
        numbers[data.name] = {}
        for name, controller in _controllers(data).items():
            timing, error = _closed_loop(data, controller, preset.control_steps)
            numbers[data.name][name] = {**timing.numbers, "mean_squared_distance": error}
            rows.append([data.name, name, timing, f"{1e3 * timing.minimum:.3g}", f"{error:.5f}"])
    header = ["weights", "controller", "time per step [ms]", "least", "mean squared distance to the goal"]
    title = f"Closed loop, T = {preset.paper_horizon}, {preset.control_steps} steps"
    note = f"The real-time iteration smooths the bounds with tau = {BARRIER:.0e}; so does the solver below it."
    return Part(numbers, [Table(title, header, rows, note)])


def moving_goal(data: NetworkCase, step: int) -> Array:
    """z_goal (n_z,) at a control step, on a circle beside the goal of the data."""
    angle = 2 * np.pi * step / _PERIOD
    return data.goal[0] + RADIUS * np.tile([np.cos(angle), np.sin(angle)], N_Z // 2)


def _closed_loop(data: NetworkCase, controller: Controller, steps: int) -> tuple[Timing, float]:
    """Times of the controller, and how well it keeps the keypoints at the goal."""
    rng, state = np.random.default_rng(0), data.s0[0]
    spent, errors, actions = [], [], []
    for step in range(steps):
        goal = moving_goal(data, step)
        spent.append(seconds(lambda state=state, goal=goal: actions.append(controller(state, goal))))
        action = actions.pop()
        state = np.array(data.bounded.transition(state, action, data.psi.ravel())).ravel()
        state[:N_Z] += NOISE * rng.normal(size=N_Z)
        errors.append(float(np.sum((state[:N_Z] - goal) ** 2)))
    return Timing.of(spent), float(np.mean(errors))


def _controllers(data: NetworkCase) -> dict[str, Controller]:
    """All start from the same solution."""
    problem, psi, converged = data.bounded, data.psi.ravel(), Riccati(1e-8, barrier=BARRIER)
    start = converged.solve(problem, data.s0[0], psi, data.goal[0])

    def by_solver(solver: Riccati) -> Controller:
        last = start

        def act(state: Array, goal: Array) -> Array:
            nonlocal last
            last = solver.solve(problem, state, psi, goal, guess=last)
            return last.actions[0]

        act(data.s0[0], data.goal[0])  # builds and compiles
        return act

    return {
        PUBLIC: by_solver(Riccati(steps=1, barrier=BARRIER)),
        CONVERGED: by_solver(converged),
    }
