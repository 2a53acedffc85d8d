"""A network upstream of an optimal-control problem learns where to go from how an expert moves (extra `torch`)."""

import casadi as ca
import torch

from kpirl_ocp import OCP
from kpirl_ocp.bridges import OCPLayer

s, u, target = ca.SX.sym("s"), ca.SX.sym("u"), ca.SX.sym("target")
problem = OCP.from_expressions(
    state=s, action=u, parameters=target, dynamics=s + u, stage_cost=(s - target) ** 2 + u**2,
    action_bounds=(-0.4, 0.4), horizon=8,
)  # fmt: skip
layer = OCPLayer(problem, policy="mask")  # leaves out instances whose gradient is not certified

torch.manual_seed(0)
sights = torch.linspace(-1, 1, 12).double()[:, None]
start = torch.zeros(12, 1).double()
expert = layer(torch.sin(2 * sights), start).actions
network = torch.nn.Sequential(torch.nn.Linear(1, 16), torch.nn.Tanh(), torch.nn.Linear(16, 1)).double()
optimiser = torch.optim.Adam(network.parameters(), lr=0.05)
for _ in range(200):
    loss = (layer(network(sights), start).actions - expert).square().mean()
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
off = (network(sights) - torch.sin(2 * sights)).abs().max()
print(f"error of the actions {loss.sqrt():.1e}, of the targets {off:.2f}")
