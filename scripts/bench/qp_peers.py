"""Peers for QPs: HPIPM of CasADi's wheel, PIQP's multistage backend, Crocoddyl's BoxFDDP."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable

import casadi as ca
import numpy as np

from bench.control_problems import ControlProblem

HPIPM, PIQP, CROCODDYL = "HPIPM", "PIQP, multistage", "Crocoddyl, BoxFDDP"
NAMES = (HPIPM, PIQP, CROCODDYL)
Peer = tuple[Callable[[], object] | None, int]
"""A solve, and how many iterations it takes; None where the peer is not installed, cannot state it, or fails."""
_FAR = 1e3  # for infinite bounds with HPIPM: CasADi's interface hands these on as bounds, and it does not converge


def qp_peers(case: ControlProblem, tolerance: float) -> dict[str, Peer]:
    """All that are installed; every call takes the numbers of the problem anew."""
    return {HPIPM: _hpipm(case, tolerance), PIQP: _piqp(case, tolerance), CROCODDYL: _crocoddyl(case, tolerance)}


def _program(case: ControlProblem) -> list[ca.DM]:
    """H, g, A and b of the unknowns (s_0, u_0, s_1, .., s_T): minimise 1/2 x' H x + g' x subject to A x = b."""
    problem, T = case.problem, case.problem.horizon
    n_s, n_u = problem.n_states, problem.n_actions
    x = [ca.MX.sym(f"x{t}", n_s + (n_u if t < T else 0)) for t in range(T + 1)]
    empty = ca.MX(0, 1)
    cost, gaps = ca.MX(0), []
    for t in range(T):
        s, u = x[t][:n_s], x[t][n_s:]
        cost += problem.stage_cost(s, u, empty, empty, empty)
        gaps.append(problem.dynamics(s, u, empty, empty, empty) - x[t + 1][:n_s])
    cost += problem.terminal_cost(x[T], empty, empty, empty)
    unknowns, rows = ca.vertcat(*x), ca.vertcat(*gaps)
    H, g = ca.hessian(cost, unknowns)
    return list(ca.Function("qp", [unknowns], [H, g, ca.jacobian(rows, unknowns), -rows])(0))


def _hpipm(case: ControlProblem, tolerance: float) -> Peer:
    problem, T = case.problem, case.problem.horizon
    H, g, A, b = _program(case)
    settings = dict.fromkeys(("res_g_max", "res_b_max", "res_d_max", "res_m_max"), tolerance) | {"iter_max": 100}
    options = {
        "N": T,
        "nx": [problem.n_states] * (T + 1),
        "nu": [problem.n_actions] * T + [0],
        "ng": [0] * (T + 1),
        "print_time": False,
        "error_on_fail": False,
        "hpipm": settings,
    }
    solver = ca.conic("peer", "hpipm", {"h": H.sparsity(), "a": A.sparsity()}, options)
    lower, upper = (np.clip(_side(case, side), -_FAR, _FAR) for side in (0, 1))
    given = {"h": H, "g": g, "a": A, "lba": b, "uba": b, "lbx": lower, "ubx": upper}
    solver(**given)
    stats = solver.stats()
    if not stats["success"]:
        return None, 0
    return (lambda: solver(**given)), int(stats.get("iter_count", stats.get("n_iter", -1)))


def _side(case: ControlProblem, side: int) -> np.ndarray:
    """Bounds of one side by stage, those of s_0 at its value."""
    problem = case.problem
    states, actions = np.array(problem.limits[side]), np.asarray(problem.action_bounds[side])
    states[0] = case.s0
    return np.concatenate([np.hstack([states[:-1], actions]).ravel(), states[-1]])


def _piqp(case: ControlProblem, tolerance: float) -> Peer:
    if importlib.util.find_spec("piqp") is None:
        return None, 0
    import piqp

    H, g, A, b = _program(case)
    numbers = {"P": H.sparse(), "c": np.array(g).ravel(), "A": A.sparse(), "b": np.array(b).ravel()}
    numbers |= {"x_l": _side(case, 0), "x_u": _side(case, 1)}
    solver = piqp.SparseSolver()
    solver.settings.kkt_solver = piqp.KKTSolver.sparse_multistage
    solver.settings.eps_abs, solver.settings.eps_rel = tolerance, 0.0
    solver.setup(**numbers)

    def solve() -> object:
        solver.update(**numbers)
        return solver.solve()

    return (solve, int(solver.result.info.iter)) if solve() == piqp.PIQP_SOLVED else (None, 0)


def _crocoddyl(case: ControlProblem, tolerance: float) -> Peer:
    """For bounds on actions alone, which is what BoxFDDP knows; costs without linear terms and products."""
    problem = case.problem
    if importlib.util.find_spec("crocoddyl") is None or np.isfinite(np.asarray(problem.limits)[:, 1:]).any():
        return None, 0
    import crocoddyl

    H, _, A, _ = (np.array(part) for part in _program(case))
    n_s, n_u = problem.n_states, problem.n_actions
    n = n_s + n_u

    def stage(Q: np.ndarray) -> object:
        zeros = np.zeros((n_s, n_u)), np.zeros(n_s), np.zeros(n_s), np.zeros(n_u)  # N, f, q, r
        model = crocoddyl.ActionModelLQR(A[:n_s, :n_s], A[:n_s, n_s:n], Q, H[n_s:n, n_s:n], *zeros)
        model.u_lb, model.u_ub = (np.asarray(bound)[0] for bound in problem.action_bounds)
        return model

    shooting = crocoddyl.ShootingProblem(case.s0, [stage(H[:n_s, :n_s])] * problem.horizon, stage(H[-n_s:, -n_s:]))
    shooting.nthreads = 1  # it takes the cores that it saw at its start
    solver = crocoddyl.SolverBoxFDDP(shooting)
    solver.th_stop = tolerance**2
    states, actions = [case.s0] * (problem.horizon + 1), [np.zeros(n_u)] * problem.horizon

    def solve() -> object:
        return solver.solve(states, actions, 100, False)

    return (solve, int(solver.iter)) if solve() else (None, 0)
