"""Frey et al.'s test of differentiable solvers (arXiv 2505.01353, QPs): random ones at once, solved and differentiated.

Eight states, four actions, twenty stages; with bounds that matter and with bounds that do not. mpc.pytorch is the peer.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np

from bench.machine import all_cores
from bench.part import Numbers, Part, Table
from bench.settings import Preset
from bench.timing import Timing, interleaved
from kpirl_ocp import OCP, Riccati, Solution
from kpirl_ocp.ocp.solvers import pull_many, solve_many
from kpirl_ocp.types import Array

N_S, N_U, TOLERANCE = 8, 4, 1e-8
TIGHT, WIDE = "bounds of 1", "bounds of 1e4"
LIMITS = {TIGHT: 1.0, WIDE: 1e4}
ONE, TWO, SOLVES_ONE, SOLVES_TWO, PEER = "one thread", "two threads", "solves, one thread", "solves, two", "mpc.pytorch"
NOT_INSTALLED = "not installed: see .venv-stress in the Makefile"
_SPREAD = 0.2  # of the dynamics around the identity


@dataclass(frozen=True, eq=False)
class Batch:
    """B random QPs: minimise sum_t 1/2 tau_t' C tau_t + c' tau_t with tau = (s, u) and s_{t+1} = A s + B u + b.

    matrices: C (B, n, n). vectors: c (B, n). dynamics: [A B] (B, n_s, n). offsets: b (B, n_s). s0 (B, n_s). by_states
    (B, T+1, n_s) and by_actions (B, T, n_u): slopes of the function whose gradient is wanted.
    """

    limit: float
    matrices: Array
    vectors: Array
    dynamics: Array
    offsets: Array
    s0: Array
    by_states: Array
    by_actions: Array

    @property
    def psi(self) -> Array:
        """Everything but s_0 (B, n_psi): each matrix by columns."""
        parts = self.matrices.transpose(0, 2, 1), self.vectors, self.dynamics.transpose(0, 2, 1), self.offsets
        return np.concatenate([part.reshape(len(self.s0), -1) for part in parts], axis=1)


def random_batch(count: int, horizon: int, limit: float, seed: int = 0) -> Batch:
    """As in mpc.pytorch's example: dynamics near the identity, costs positive definite."""
    rng, n = np.random.default_rng(seed), N_S + N_U
    roots = rng.normal(size=(count, n, n))
    dynamics = np.concatenate(
        [np.eye(N_S) + _SPREAD * rng.normal(size=(count, N_S, N_S)), rng.normal(size=(count, N_S, N_U))], axis=2
    )
    return Batch(
        limit=limit,
        matrices=np.swapaxes(roots, 1, 2) @ roots + 0.1 * np.eye(n),
        vectors=rng.normal(size=(count, n)),
        dynamics=dynamics,
        offsets=0.1 * rng.normal(size=(count, N_S)),
        s0=rng.normal(size=(count, N_S)),
        by_states=rng.normal(size=(count, horizon + 1, N_S)),
        by_actions=rng.normal(size=(count, horizon, N_U)),
    )


def qp(horizon: int, limit: float) -> OCP:
    """The problem of a batch, whose numbers are psi."""
    n, n_psi = N_S + N_U, (N_S + N_U) * (N_S + N_U + 1) + N_S * (N_S + N_U + 1)
    s, u, psi = ca.SX.sym("s", N_S), ca.SX.sym("u", N_U), ca.SX.sym("psi", n_psi)
    C, c, F, f = ca.vertsplit(psi, np.cumsum([0, n * n, n, N_S * n, N_S]).tolist())
    tau, C = ca.vertcat(s, u), ca.reshape(C, n, n)
    at_end = s.T @ C[:N_S, :N_S] @ s / 2 + c[:N_S].T @ s
    return OCP.from_expressions(
        state=s,
        action=u,
        parameters=psi,
        horizon=horizon,
        action_bounds=(-limit, limit),
        dynamics=ca.reshape(F, N_S, n) @ tau + f,
        stage_cost=tau.T @ C @ tau / 2 + c.T @ tau,
        terminal_cost=at_end,
    )


def measure(preset: Preset) -> Part:
    """Solves and gradients of all, on one and two threads, and by mpc.pytorch on two."""
    numbers: Numbers = {}
    rows = []
    for name, limit in LIMITS.items():
        batch = random_batch(preset.qps, preset.qp_horizon, limit)
        with all_cores():
            numbers[name] = _measure(batch, preset)
        rows += [[name, who, *_cells(found, preset.qps)] for who, found in numbers[name].items()]
        numbers[name]["count"] = preset.qps
    title = f"{preset.qps} QPs, n_s = {N_S}, n_u = {N_U}, T = {preset.qp_horizon}, solved and differentiated"
    note = (
        "Ours: `solve_many` and `pull_many` with `compile=True`, gradients with certificates. Problems: how many "
        "converged (certified)."
    )
    header = ["bounds", "", "time [ms]", "per problem [ms]", "problems", "difference from ours"]
    return Part(numbers, [Table(title, header, rows, note)])


def _cells(found: Numbers, count: int) -> list[str]:
    if "left_out" in found:
        return [found["left_out"], "", "", ""]
    difference = f"{found['difference']:.0e}" if "difference" in found else ""
    return [f"{found['median_ms']:.4g}", f"{found['median_ms'] / count:.3g}", str(found["done"]), difference]


def _measure(batch: Batch, preset: Preset) -> Numbers:
    problem = qp(preset.qp_horizon, batch.limit)
    expected = _ours(problem, batch, 1)()
    calls: dict[str, Callable[[], object]] = {
        ONE: _ours(problem, batch, 1),
        TWO: _ours(problem, batch, 2),
        SOLVES_ONE: lambda: _solve(problem, batch, 1),
        SOLVES_TWO: lambda: _solve(problem, batch, 2),
    }
    found: dict[str, Numbers] = {PEER: {"left_out": NOT_INSTALLED}}
    peer = _peer(batch)
    if peer is not None:
        found[PEER], calls[PEER] = _compare(peer(), expected), peer
    timings = interleaved(calls, preset.budget, preset.most)
    own = _done(expected[0], [gradients.certificate.certified for gradients in expected[1]])
    return {
        name: _numbers(timings.get(name), found.get(name, own)) for name in (ONE, TWO, SOLVES_ONE, SOLVES_TWO, PEER)
    }


def _numbers(timing: Timing | None, found: Numbers) -> Numbers:
    return found if timing is None else found | timing.numbers


def _done(solutions: list[Solution], certified: list[bool]) -> Numbers:
    return {"done": f"{sum(s.status.ok for s in solutions)} ({sum(certified)})"}


def _solve(problem: OCP, batch: Batch, threads: int) -> list[Solution]:
    solver = Riccati(tolerance=TOLERANCE, compile=True)
    return solve_many(problem, batch.s0, batch.psi, solver=solver, threads=threads)


def _ours(problem: OCP, batch: Batch, threads: int) -> Callable[[], tuple]:
    def evaluate() -> tuple:
        solutions = _solve(problem, batch, threads)
        return solutions, pull_many(problem, solutions, batch.by_states, batch.by_actions, "flag", threads)

    return evaluate


def _peer(batch: Batch) -> Callable[[], tuple] | None:
    if importlib.util.find_spec("mpc") is None or importlib.util.find_spec("torch") is None:
        return None
    return importlib.import_module("bench.peer_mpc").evaluation(batch, TOLERANCE)


def _compare(theirs: tuple, ours: tuple) -> Numbers:
    """Largest relative difference of a gradient by c where both are certain; how many mpc.pytorch calls converged."""
    converged, gradients = theirs
    n = (N_S + N_U) ** 2
    certain = [i for i in range(len(gradients)) if converged[i] and ours[1][i].certificate.certified]
    differences = [_relative(gradients[i], ours[1][i].psi[n : n + N_S + N_U]) for i in certain]
    return {"done": str(int(np.sum(converged))), "difference": float(max(differences, default=np.nan))}


def _relative(found: Array, expected: Array) -> float:
    return float(np.abs(found - expected).max() / np.abs(expected).max())
