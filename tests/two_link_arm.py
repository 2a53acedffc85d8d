"""The planar two-link arm that inverse optimal control is often tried on (Becanovic, Jovanovic and Bonnet, 2024).

Links of 1 m, 1 kg and 1/12 kg m^2, in a vertical plane; the actions are joint accelerations. The hand is to be at a
goal at the end, as an equality, and the cost is a mixture psi of three mean squares in units that make them alike:
joint torques over 80, joint velocities over 3, the velocity of the hand over 20.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, Trajectory

DURATION = 1.5  # [s]
START = np.array([np.pi / 2, 0.0, 0.0, 0.0])  # stretched upwards, at rest: angles [rad] and rates [rad/s]
GOAL = np.array([0.5, 0.5])  # of the hand [m]
FOLDED = np.array([2.0399, -2.2524])  # angles with the hand at the goal [rad]
_GRAVITY, _INERTIA, _CENTRE = 9.81, 1 / 12, 0.5


def two_link_arm(horizon: int = 49) -> OCP:
    """The problem with psi = (torque, joint velocity, hand velocity) and the goal (2,) [m] as context.

    It shows the angles (2,). Fifty points of the paper are 49 steps.
    """
    s, u, psi, goal = ca.SX.sym("s", 4), ca.SX.sym("u", 2), ca.SX.sym("psi", 3), ca.SX.sym("goal", 2)
    q, rates, dt = s[:2], s[2:], DURATION / horizon
    hand = _place(q)
    velocity = ca.jacobian(hand, q) @ rates
    stages = horizon + 1
    torque_cost = ca.sumsqr(_torques(q, rates, u)) / stages / 2 / 80
    moving = psi[1] * ca.sumsqr(rates) / stages / 2 / 3 + psi[2] * ca.sumsqr(velocity) / stages / 20
    return OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        context=goal,
        dynamics=ca.vertcat(q + dt * rates, rates + dt * u),
        stage_cost=psi[0] * torque_cost + moving,
        terminal_equality=hand - goal,
        observation=q,
        horizon=horizon,
    )


def folding(horizon: int = 49) -> Trajectory:
    """A guess: from the start to the goal at constant rates. From the stretched arm alone, solvers go astray."""
    share = np.linspace(0, 1, horizon + 1)[:, None]
    angles = START[:2] + share * (FOLDED - START[:2])
    rates = np.diff(angles, axis=0, append=angles[-1:]) * horizon / DURATION
    return Trajectory(np.hstack([angles, rates]), np.diff(rates, axis=0) * horizon / DURATION)


def hand(angles: Array) -> Array:
    """Position of the hand (2,) [m]."""
    first, both = angles[0], angles[0] + angles[1]
    return np.array([np.cos(first) + np.cos(both), np.sin(first) + np.sin(both)])


def _place(q: ca.SX) -> ca.SX:
    both = q[0] + q[1]
    return ca.vertcat(ca.cos(q[0]) + ca.cos(both), ca.sin(q[0]) + ca.sin(both))


def _torques(q: ca.SX, rates: ca.SX, accelerations: ca.SX) -> ca.SX:
    """Inverse dynamics by Lagrange's equations, d/dt dL/drates - dL/dq."""
    both = q[0] + q[1]
    elbow = ca.vertcat(ca.cos(q[0]), ca.sin(q[0]))
    centres = [_CENTRE * elbow, elbow + _CENTRE * ca.vertcat(ca.cos(both), ca.sin(both))]
    turning = [rates[0], rates[0] + rates[1]]
    kinetic, potential = 0, 0
    for centre, omega in zip(centres, turning, strict=True):
        velocity = ca.jacobian(centre, q) @ rates
        kinetic += 0.5 * ca.sumsqr(velocity) + 0.5 * _INERTIA * omega**2
        potential += _GRAVITY * centre[1]
    momentum = ca.gradient(kinetic, rates)
    change = ca.jacobian(momentum, q) @ rates + ca.jacobian(momentum, rates) @ accelerations
    return change - ca.gradient(kinetic - potential, q)
