"""Iterations of `Riccati` and `Ipopt` between obstacles that are drawn, from guesses that know nothing of them."""

from __future__ import annotations

from functools import partial

import casadi as ca
import numpy as np
from bench.part import Part

from kpirl_ocp import OCP, Trajectory
from kpirl_ocp.types import Array
from stress.settings import Profile
from stress.starts.board import REPORTED, part, race, reported
from stress.starts.systems import Start

T, DT = 40, 0.1
GOAL = np.array([3.0, 0.0, 0.0, 0.0])
_NOTE = (
    f"Seeds from {REPORTED} on. 40 steps of 0.1 s from rest near (0, 0) to rest at (3, 0), least effort, one to three "
    "discs of radius 0.2 to 0.5 between them. From rest: no guess is given. Straight: states on the line from start to "
    "goal. Lost, and won: what only one of them solves."
)


def measure(profile: Profile) -> Part:
    """Ratios of iterations by vehicle and guess, at seeds that are reported."""
    draws = {
        f"{name}, {guess}": partial(start, unicycle, guess == "straight")
        for name, unicycle in (("point mass", False), ("unicycle", True))
        for guess in ("from rest", "straight")
    }
    pairs = race(draws, reported(profile.obstacles))
    return part("Iterations between obstacles, Riccati / Ipopt", "vehicle and guess", pairs, _NOTE)


def start(unicycle: bool, straight: bool, seed: int) -> Start:
    """A vehicle, and discs (x, y, radius) of this seed [m]."""
    rng = np.random.default_rng(seed)
    discs = rng.uniform([0.7, -0.5, 0.2], [2.3, 0.5, 0.5], (rng.integers(1, 4), 3))
    s0 = np.array([0, rng.uniform(-0.2, 0.2), 0, 0])
    guess = Trajectory(np.linspace(s0, GOAL, T + 1), np.zeros((T, 2))) if straight else None
    return Start(between(discs, unicycle), s0, np.zeros(0), np.zeros(0), guess)


def between(discs: Array, unicycle: bool) -> OCP:
    """State (x, y, velocity) driven by accelerations, or (x, y, heading, speed) by acceleration and turning rate."""
    s, u = ca.SX.sym("s", 4), ca.SX.sym("u", 2)
    moved = ca.vertcat(s[3] * ca.cos(s[2]), s[3] * ca.sin(s[2]), u[1], u[0]) if unicycle else ca.vertcat(s[2:], u)
    return OCP.from_expressions(
        state=s,
        action=u,
        horizon=T,
        dynamics=s + DT * moved,
        stage_cost=DT * ca.sumsqr(u),
        path_constraint=ca.vertcat(*(r**2 - ca.sumsqr(s[:2] - ca.vertcat(x, y)) for x, y, r in discs)),
        terminal_equality=s - GOAL,
        action_bounds=(-5, 5),
    )
