"""Plan with a typical network as dynamics: residual, LayerNorm, GELU; from torch (extra `torch`)."""

import casadi as ca
import torch
from torch import nn

from kpirl_ocp import OCP, Riccati
from kpirl_ocp.bridges import from_torch


class Dynamics(nn.Module):
    """x + net(x, u)."""

    def __init__(self):
        super().__init__()
        self.net = nn.Sequential(nn.Linear(3, 32), nn.LayerNorm(32), nn.GELU(), nn.Linear(32, 2))

    def forward(self, x, u):
        """One step."""
        return x + 0.1 * self.net(torch.cat([x, u], dim=-1))


torch.manual_seed(0)
model = Dynamics()
network, s, u = from_torch(model, 2, 1), ca.MX.sym("s", 2), ca.MX.sym("u")
problem = OCP.from_expressions(state=s, action=u, dynamics=network(s, u), stage_cost=ca.sumsqr(s) + u**2, horizon=20)
plan = Riccati().solve(problem, [0.2, 0.0])
following = model(torch.tensor(plan.states[:1]).float(), torch.tensor(plan.actions[:1]).float())[0].detach().numpy()
print(f"{plan.status.name}; torch predicts the same next state, to {abs(following - plan.states[1]).max():.0e}")
