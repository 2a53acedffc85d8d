"""Reaching problems on a learned network, as plain arrays and as OCPs.

    z_{t+1} = z_t + MLP(z, theta, theta_dot, u),   C_psi = sum_t W_t . (z_t - z_goal)^2,   L = sum_t |z_t - z_demo,t|^2

with psi = W (T, n_z). In the paper N gradient steps from u = 0 descend C_psi before L is taken.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kpirl_ocp.assets import shipped_model
from kpirl_ocp.irl.cases.planar_arm import HELD_JOINTS, planar_dynamics
from kpirl_ocp.ocp.models.keypoint_costs import KeypointCost, TimeDependent
from kpirl_ocp.ocp.models.keypoint_dynamics import NetworkDynamics
from kpirl_ocp.ocp.models.keypoint_problems import network_ocp
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, Demonstration

N_Z, N_Q = 8, 7


@dataclass(frozen=True, eq=False)
class NetworkCase:
    """A network problem with B demonstrations, and parameters at which to solve and differentiate it.

    model: the network. s0: (B, n_s). goal: (B, n_z). observed: (B, T+1, n_z). psi: (T, n_z).
    steps, step_size: N and alpha of the gradient descent.
    effort: rho of the bounded problem. reach: largest |u| of the bounded problem [rad].
    """

    name: str
    model: NetworkDynamics
    s0: Array
    goal: Array
    observed: Array
    psi: Array
    steps: int
    step_size: float
    effort: float
    reach: float

    @property
    def weights(self) -> tuple[Array, ...]:
        """Weight matrices (n_l, n_{l-1}) of the layers."""
        return self.model.mlp.weights

    @property
    def biases(self) -> tuple[Array, ...]:
        """Biases (n_l,) of the layers."""
        return self.model.mlp.biases

    @property
    def activation(self) -> str:
        """Name of the activation of the hidden layers."""
        return self.model.mlp.activations[0]

    @property
    def horizon(self) -> int:
        """T."""
        return len(self.psi)

    @cached_property
    def demonstrations(self) -> list[Demonstration]:
        """The B demonstrations as records."""
        return [Demonstration(*arrays) for arrays in zip(self.s0, self.goal, self.observed, strict=True)]

    @cached_property
    def problem(self) -> OCP:
        """Unbounded and without effort, as in the paper."""
        return network_ocp(self.model, KeypointCost(TimeDependent()), self.horizon)

    @cached_property
    def bounded(self) -> OCP:
        """With effort, so that there is an optimum, bounds on the actions and joint limits."""
        theta = self.s0[:, N_Z : N_Z + N_Q]
        # No whole number of steps, so that a joint limit and the action bounds on the way to it are independent.
        room = (self.horizon // 2 + 0.3) * self.reach
        limits = theta.min(axis=0) - room, theta.max(axis=0) + room
        cost = KeypointCost(TimeDependent(), effort=self.effort)
        return network_ocp(self.model, cost, self.horizon, joint_limits=limits, max_displacement=self.reach)


def placing_case(horizon: int, steps: int, count: int = 1, seed: int = 0) -> NetworkCase:
    """The shipped placing model, from starts within its training data, in the arm's plane."""
    model, rng = planar_dynamics(shipped_model("placing")), np.random.default_rng(seed)
    moves = np.full(N_Q, 0.4)
    moves[list(HELD_JOINTS)] = 0
    z = np.tile([0.08, -0.2], N_Z // 2) + rng.uniform(-0.1, 0.1, (count, N_Z))
    theta = [0.0, 0.26, 0.0, -1.75, 0.0, -0.42, 0.0] + moves * rng.uniform(-0.4, 0.4, (count, N_Q))
    return network_case(f"trained, {model.mlp.activations[0]}", model, z, theta, moves, horizon, steps, 1e-4, rng)


def network_case(
    name: str,
    model: NetworkDynamics,
    z: Array,
    theta: Array,
    moves: Array,
    horizon: int,
    steps: int,
    step_size: float,
    rng: np.random.Generator,
) -> NetworkCase:
    """Demonstrations are motions of the model itself, every joint at its own steady speed, and goals their ends.

    moves: (n_joints,) largest displacement of each joint [rad].
    """
    s0 = np.hstack([z, theta, np.zeros_like(theta)])
    speeds = moves * rng.uniform(-1, 1, theta.shape) / horizon
    psi = rng.uniform(0.5, 1.5, (horizon, N_Z))
    plain = network_ocp(model, KeypointCost(TimeDependent()), horizon)
    motions = [
        plain.simulate(*pair, psi.ravel()) for pair in zip(s0, np.repeat(speeds[:, None], horizon, 1), strict=True)
    ]
    observed = np.array([motion.states[:, :N_Z] for motion in motions])
    alpha = step_size * min(1.0, 25 / horizon) ** 2  # all actions before z_t move it: curvature grows like T^2
    effort, reach = 1e-3 / alpha, float(moves.max()) / horizon  # the fastest demonstrated speed
    return NetworkCase(name, model, s0, observed[:, -1], observed, psi, steps, alpha, effort, reach)
