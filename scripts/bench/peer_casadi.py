"""The unrolled hypergradient in plain CasADi: an MX graph, `mapaccum` and `fold`, AD, and the virtual machine."""

from __future__ import annotations

import casadi as ca
import numpy as np

from bench.contenders import Evaluation
from kpirl_ocp.irl.cases.network_cases import N_Q, N_Z, NetworkCase
from kpirl_ocp.types import Array


def unrolled(data: NetworkCase) -> Evaluation:
    """Loss and gradient (T, n_z) of the first demonstration."""
    psi, s0, goal = ca.MX.sym("psi", N_Z, data.horizon), ca.MX.sym("s0", N_Z + 2 * N_Q), ca.MX.sym("goal", N_Z)
    actions, observed = ca.MX.sym("U", N_Q, data.horizon), ca.MX.sym("Z", N_Z, data.horizon + 1)
    rollout = _stage(data).mapaccum(data.horizon)

    def keypoints(inputs: ca.MX) -> ca.MX:
        return rollout(s0, inputs)[:N_Z, :]

    cost = ca.sum2(ca.sum1(psi * (keypoints(actions) - ca.repmat(goal, 1, data.horizon)) ** 2))
    descended = actions - data.step_size * ca.gradient(cost, actions)
    step = ca.Function("step", [actions, psi, s0, goal], [descended]).fold(data.steps)
    constants = (ca.repmat(constant, 1, data.steps) for constant in (psi, s0, goal))
    final = step(ca.MX.zeros(*actions.shape), *constants)
    loss = ca.sumsqr(keypoints(final) - observed[:, 1:]) + ca.sumsqr(s0[:N_Z] - observed[:, 0])
    function = ca.Function("unrolled", [psi, s0, goal, observed], [loss, ca.gradient(loss, psi)])

    def evaluate() -> tuple[float, Array]:
        value, gradient = function(data.psi.T, data.s0[0], data.goal[0], data.observed[0].T)
        return float(value), np.array(gradient).T

    return evaluate


def _stage(data: NetworkCase) -> ca.Function:
    """f(s, u) -> s_next."""
    s, u = ca.MX.sym("s", N_Z + 2 * N_Q), ca.MX.sym("u", N_Q)
    activation = {"relu": lambda x: ca.fmax(x, 0), "tanh": ca.tanh}[data.activation]
    h = ca.vertcat(s, u)
    for weight, bias in zip(data.weights[:-1], data.biases[:-1], strict=True):
        h = activation(ca.DM(weight) @ h + ca.DM(bias))
    z = s[:N_Z] + ca.DM(data.weights[-1]) @ h + ca.DM(data.biases[-1])
    return ca.Function("stage", [s, u], [ca.vertcat(z, s[N_Z : N_Z + N_Q] + u, s[N_Z + N_Q :])])
