"""The problems of the benchmark: networks with random weights, and the shipped one (`placing_case`)."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from kpirl_ocp.irl.cases.network_cases import N_Q, N_Z, NetworkCase, network_case
from kpirl_ocp.ocp.models.keypoint_dynamics import NetworkDynamics
from kpirl_ocp.ocp.models.mlp import MLP


def random_network(
    hidden: tuple[int, ...], horizon: int, steps: int, activation: str = "relu", count: int = 1, seed: int = 0
) -> NetworkCase:
    """Random weights, as torch starts a linear layer, with outputs scaled to what keypoints move in a step."""
    rng, widths = np.random.default_rng(seed), (N_Z + 3 * N_Q, *hidden, N_Z)
    pairs = list(pairwise(widths))
    weights = [rng.uniform(-1, 1, (m, n)) / np.sqrt(n) for n, m in pairs]
    biases = [rng.uniform(-1, 1, m) / np.sqrt(n) for n, m in pairs]
    gain = 0.1 * min(1.0, 25 / horizon)  # a long horizon is a fine one
    weights[-1], biases[-1] = gain * weights[-1], gain * biases[-1]
    model = NetworkDynamics(MLP.from_layers(weights, biases, activation), N_Z, N_Q)
    z, theta = rng.uniform(-0.5, 0.5, (count, N_Z)), rng.uniform(-1, 1, (count, N_Q))
    return network_case(f"random, {activation}", model, z, theta, np.ones(N_Q), horizon, steps, 1e-2, rng)


def single(data: NetworkCase, index: int) -> NetworkCase:
    """One demonstration alone."""
    cut = slice(index, index + 1)
    return replace(data, s0=data.s0[cut], goal=data.goal[cut], observed=data.observed[cut])
