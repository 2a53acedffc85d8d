"""The unrolled hypergradient in torch, float64: `create_graph=True` through all steps, as `higher` does it."""

from __future__ import annotations

import torch

from bench.contenders import Evaluation
from kpirl_ocp.irl.cases.network_cases import N_Q, N_Z, NetworkCase
from kpirl_ocp.types import Array


def unrolled(data: NetworkCase) -> Evaluation:
    """Loss and gradient (T, n_z) of the first demonstration."""
    torch.set_num_threads(1)
    s0, goal, observed = (torch.tensor(array[0]) for array in (data.s0, data.goal, data.observed))
    weights, biases = ([torch.tensor(array) for array in arrays] for arrays in (data.weights, data.biases))
    activation = getattr(torch, data.activation)

    def keypoints(actions: torch.Tensor) -> torch.Tensor:
        z, theta, velocity = torch.split(s0, [N_Z, N_Q, N_Q])
        found = []
        for u in actions:
            h = torch.cat([z, theta, velocity, u])
            for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
                h = activation(torch.addmv(bias, weight, h))
            z, theta = z + torch.addmv(biases[-1], weights[-1], h), theta + u
            found.append(z)
        return torch.stack(found)

    def evaluate() -> tuple[float, Array]:
        psi = torch.tensor(data.psi, requires_grad=True)
        actions = torch.zeros(data.horizon, N_Q, dtype=torch.float64, requires_grad=True)
        for _ in range(data.steps):
            cost = (psi * (keypoints(actions) - goal) ** 2).sum()
            (slope,) = torch.autograd.grad(cost, actions, create_graph=True)
            actions = actions - data.step_size * slope
        loss = ((keypoints(actions) - observed[1:]) ** 2).sum() + ((s0[:N_Z] - observed[0]) ** 2).sum()
        (gradient,) = torch.autograd.grad(loss, psi)
        return float(loss.detach()), gradient.numpy()

    return evaluate
