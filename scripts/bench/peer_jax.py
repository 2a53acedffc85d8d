"""The unrolled hypergradient in JAX, float64: jit of `value_and_grad`, `lax.scan` over time and over steps."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from bench.contenders import Evaluation
from kpirl_ocp.irl.cases.network_cases import N_Q, N_Z, NetworkCase
from kpirl_ocp.types import Array

jax.config.update("jax_enable_x64", True)


def unrolled(data: NetworkCase, unroll: int = 1) -> Evaluation:
    """Loss and gradient (T, n_z); their means over demonstrations, by `vmap`, when there are several.

    unroll: stages per trip of the loop over time. Five are faster than one, all 25 slower, and compile for 15 s.
    """
    weights, biases = ([jnp.array(array) for array in arrays] for arrays in (data.weights, data.biases))
    activation = {"relu": jax.nn.relu, "tanh": jnp.tanh}[data.activation]

    def keypoints(s0: jax.Array, actions: jax.Array) -> jax.Array:
        def stage(carry: tuple[jax.Array, jax.Array], u: jax.Array) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
            z, theta = carry
            h = jnp.concatenate([z, theta, s0[N_Z + N_Q :], u])
            for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
                h = activation(weight @ h + bias)
            z = z + weights[-1] @ h + biases[-1]
            return (z, theta + u), z

        return jax.lax.scan(stage, (s0[:N_Z], s0[N_Z : N_Z + N_Q]), actions, unroll=min(unroll, data.horizon))[1]

    def irl_loss(psi: jax.Array, s0: jax.Array, goal: jax.Array, observed: jax.Array) -> jax.Array:
        def cost(actions: jax.Array) -> jax.Array:
            return (psi * (keypoints(s0, actions) - goal) ** 2).sum()

        def descend(actions: jax.Array, _: None) -> tuple[jax.Array, None]:
            return actions - data.step_size * jax.grad(cost)(actions), None

        actions = jax.lax.scan(descend, jnp.zeros((data.horizon, N_Q)), None, data.steps)[0]
        return ((keypoints(s0, actions) - observed[1:]) ** 2).sum() + ((s0[:N_Z] - observed[0]) ** 2).sum()

    one = jax.value_and_grad(irl_loss)
    several = jax.vmap(one, in_axes=(None, 0, 0, 0))

    def mean(psi: jax.Array, *demonstrations: jax.Array) -> tuple[jax.Array, jax.Array]:
        losses, gradients = several(psi, *demonstrations)
        return losses.mean(), gradients.mean(axis=0)

    alone = len(data.s0) == 1
    compiled = jax.jit(one if alone else mean)
    arrays = (array[0] if alone else array for array in (data.s0, data.goal, data.observed))
    arguments = [jnp.array(array) for array in arrays]

    def evaluate() -> tuple[float, Array]:
        loss, gradient = compiled(data.psi, *arguments)
        return float(loss), np.asarray(gradient)  # both wait for the result

    return evaluate
