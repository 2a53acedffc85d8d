"""mpc.pytorch on a batch of QPs, with as many threads of torch as there are cores."""

from __future__ import annotations

import os
from collections.abc import Callable

import numpy as np
import torch
from mpc.mpc import MPC, GradMethods, LinDx, QuadCost

from bench.qps import N_S, N_U, Batch
from kpirl_ocp.types import Array

_ITERATIONS = 200


def evaluation(batch: Batch, tolerance: float) -> Callable[[], tuple[Array, Array]]:
    """All solves and the backward pass: which converged (B,), and gradients by c, summed over the stages (B, n)."""
    count, horizon = len(batch.s0), batch.by_actions.shape[1]
    C, c, F, f, s0 = (torch.tensor(part) for part in _stages(batch, horizon))
    slopes = torch.tensor(batch.by_states.swapaxes(0, 1)), torch.tensor(batch.by_actions.swapaxes(0, 1))
    bounds = {"u_lower": -batch.limit, "u_upper": batch.limit}

    def evaluate() -> tuple[Array, Array]:
        torch.set_num_threads(len(os.sched_getaffinity(0)))
        vectors = c.clone().requires_grad_()
        solver = MPC(
            N_S,
            N_U,
            horizon + 1,
            **bounds,
            lqr_iter=_ITERATIONS,
            n_batch=count,
            verbose=-1,
            eps=tolerance,
            back_eps=tolerance,
            grad_method=GradMethods.ANALYTIC,
            exit_unconverged=False,
            detach_unconverged=True,
        )
        states, actions, _ = solver(s0, QuadCost(C, vectors), LinDx(F, f))
        if not states.requires_grad:
            return np.zeros(count, bool), np.zeros((count, N_S + N_U))
        ((states * slopes[0]).sum() + (actions[:-1] * slopes[1]).sum()).backward()
        gradient = vectors.grad
        assert gradient is not None
        moved = gradient.abs().sum((0, 2)).numpy() > 0  # unconverged ones are detached
        return moved, gradient.sum(0).numpy()

    return evaluate


def _stages(batch: Batch, horizon: int) -> tuple[Array, ...]:
    """Costs (T+1, B, n, n) and (T+1, B, n), dynamics (T, B, n_s, n) and (T, B, n_s), s_0; the last action is free."""
    count = len(batch.s0)
    C = np.broadcast_to(batch.matrices, (horizon + 1, *batch.matrices.shape)).copy()
    c = np.broadcast_to(batch.vectors, (horizon + 1, *batch.vectors.shape)).copy()
    C[-1, :, N_S:], C[-1, :, :, N_S:], c[-1, :, N_S:] = 0.0, 0.0, 0.0
    C[-1, :, N_S:, N_S:] = np.eye(N_U)
    F = np.broadcast_to(batch.dynamics, (horizon, count, N_S, N_S + N_U)).copy()
    f = np.broadcast_to(batch.offsets, (horizon, count, N_S)).copy()
    return C, c, F, f, batch.s0
