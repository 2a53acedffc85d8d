"""The unrolled hypergradient of the paper's network problem in torch and JAX, for comparison with this package.

Every function returns a call without arguments that gives (loss, gradient), ready to be timed. Torch and JAX are
imported inside. The problem: z_{t+1} = z_t + MLP(z, theta, theta_dot, u), N gradient steps on the actions of
sum_t W_t . (z_t - z_goal)^2, then the squared distance to the demonstration, differentiated by W (T, n_z).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

Evaluation = Callable[[], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Data:
    """Everything the problem needs, as plain arrays; B demonstrations.

    weights, biases: of a ReLU network n_z + 3 n_q -> n_z. s0: (B, n_s). goal: (B, n_z). observed: (B, T+1, n_z).
    psi: (T, n_z). steps: N. step_size: alpha.
    """

    weights: list[np.ndarray]
    biases: list[np.ndarray]
    s0: np.ndarray
    goal: np.ndarray
    observed: np.ndarray
    psi: np.ndarray
    steps: int
    step_size: float


def paper_size(demonstrations: int = 1, horizon: int = 25, steps: int = 20, seed: int = 0) -> Data:
    """The paper's sizes with random numbers: 29-100-25-8, T = 25, N = 20."""
    rng, widths = np.random.default_rng(seed), (29, 100, 25, 8)
    pairs = list(pairwise(widths))
    z = rng.uniform(-0.5, 0.5, (demonstrations, 8))
    drift = np.cumsum(0.02 * rng.normal(size=(demonstrations, horizon + 1, 8)), axis=1)
    observed = z[:, None] + drift - drift[:, :1]
    return Data(
        weights=[rng.uniform(-1, 1, (m, n)) / np.sqrt(n) for n, m in pairs],  # as torch starts a linear layer
        biases=[rng.uniform(-1, 1, m) / np.sqrt(n) for n, m in pairs],
        s0=np.hstack([z, rng.uniform(-1, 1, (demonstrations, 7)), np.zeros((demonstrations, 7))]),
        goal=observed[:, -1],
        observed=observed,
        psi=rng.uniform(0.5, 1.5, (horizon, 8)),
        steps=steps,
        step_size=1e-2,
    )


def torch_create_graph(data: Data) -> Evaluation:
    """`autograd.grad(create_graph=True)` through every step, one demonstration: what `higher` does."""
    import torch

    tensors = [torch.tensor(array) for array in (data.s0[0], data.goal[0], data.observed[0])]
    s0, goal, observed = tensors
    weights, biases = ([torch.tensor(array) for array in arrays] for arrays in (data.weights, data.biases))

    def keypoints(actions: torch.Tensor) -> torch.Tensor:
        z, theta, velocity, found = s0[:8], s0[8:15], s0[15:], []
        for u in actions:
            h = torch.cat([z, theta, velocity, u])
            for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
                h = torch.relu(weight @ h + bias)
            z, theta = z + weights[-1] @ h + biases[-1], theta + u
            found.append(z)
        return torch.stack(found)

    def evaluate() -> tuple[np.ndarray, np.ndarray]:
        psi = torch.tensor(data.psi, requires_grad=True)
        actions = torch.zeros(len(data.psi), 7, dtype=torch.float64, requires_grad=True)
        for _ in range(data.steps):
            cost = (psi * (keypoints(actions) - goal) ** 2).sum()
            (slope,) = torch.autograd.grad(cost, actions, create_graph=True)
            actions = actions - data.step_size * slope
        loss = ((keypoints(actions) - observed[1:]) ** 2).sum()
        (gradient,) = torch.autograd.grad(loss, psi)
        return loss.detach().numpy(), gradient.numpy()

    return evaluate


def jax_scan(data: Data) -> Evaluation:
    """jit, `lax.scan` over time and over steps; `vmap` over demonstrations when there are several."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    weights, biases = ([jnp.array(array) for array in arrays] for arrays in (data.weights, data.biases))

    def keypoints(s0: jax.Array, actions: jax.Array) -> jax.Array:
        def step(carry: tuple[jax.Array, jax.Array], u: jax.Array) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
            z, theta = carry
            h = jnp.concatenate([z, theta, s0[15:], u])
            for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
                h = jax.nn.relu(weight @ h + bias)
            z = z + weights[-1] @ h + biases[-1]
            return (z, theta + u), z

        return jax.lax.scan(step, (s0[:8], s0[8:15]), actions)[1]

    def irl_loss(psi: jax.Array, s0: jax.Array, goal: jax.Array, observed: jax.Array) -> jax.Array:
        def cost(actions: jax.Array) -> jax.Array:
            return (psi * (keypoints(s0, actions) - goal) ** 2).sum()

        def descend(actions: jax.Array, _: None) -> tuple[jax.Array, None]:
            return actions - data.step_size * jax.grad(cost)(actions), None

        actions = jax.lax.scan(descend, jnp.zeros((len(psi), 7)), None, data.steps)[0]
        return ((keypoints(s0, actions) - observed[1:]) ** 2).sum()

    function = jax.value_and_grad(irl_loss)
    arguments = data.s0, data.goal, data.observed
    if len(data.s0) > 1:
        function = jax.vmap(function, in_axes=(None, 0, 0, 0))
    else:
        arguments = tuple(array[0] for array in arguments)
    compiled = jax.jit(function)

    def evaluate() -> tuple[np.ndarray, np.ndarray]:
        loss, gradient = compiled(data.psi, *arguments)
        return np.asarray(loss), np.asarray(gradient)

    return evaluate
