"""Ordinary control problems: `Riccati` with no settings given, beside Ipopt with compiled functions, and HPIPM for QPs.

Every solver starts from no action. First solves are those of a problem that nobody has solved before.
"""

from __future__ import annotations

import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np

from bench.control_problems import ControlProblem, problems
from bench.part import Numbers, Part, Table
from bench.settings import Preset
from bench.timing import interleaved
from kpirl_ocp import Ipopt, Riccati
from kpirl_ocp.ocp.codegen.compiler import find_compiler
from kpirl_ocp.ocp.conditions.program import limits_from, starting_point, transcribe

OURS, WITHOUT, PEER, QP = "Riccati", "Riccati, no compiler", "Ipopt, compiled functions", "HPIPM"
TOLERANCE = 1e-8


def measure(preset: Preset) -> Part:
    """Milliseconds warm and of the first solve, and iterations."""
    numbers: Numbers = {}
    rows = []
    for case in problems(tiny=not preset.trained):
        found = _case(case, preset)
        numbers[case.name] = found
        rows.append([case.name, *(_cell(found.get(name)) for name in (OURS, WITHOUT, PEER, QP)), *_firsts(found)])
    header = ["problem", OURS, WITHOUT, PEER, QP, "first solve: Riccati", "first solve: Ipopt"]
    note = f"Times [ms] of a cold start to a tolerance of {TOLERANCE:.0e}, medians, with iterations in brackets."
    return Part(numbers, [Table("Control problems", header, rows, note)])


def _cell(found: Numbers | None) -> str:
    return "" if found is None else f"{found['median_ms']:.3g} ({found['iterations']})"


def _firsts(found: Numbers) -> list[str]:
    return [f"{found[name]:.3g}" for name in ("first_riccati_ms", "first_ipopt_ms")]


def _case(case: ControlProblem, preset: Preset) -> Numbers:
    first, second = replace(case.problem), replace(case.problem)  # equal, and new to every cache
    firsts = {"first_riccati_ms": _first(Riccati(tolerance=TOLERANCE), first, case)}
    firsts["first_ipopt_ms"] = _first(Ipopt(tolerance=TOLERANCE), second, case)
    ours, without = (Riccati(tolerance=TOLERANCE, compile=wish) for wish in (True, False))
    calls: dict[str, Callable[[], object]] = {
        OURS: lambda: ours.solve(case.problem, case.s0),
        WITHOUT: lambda: without.solve(case.problem, case.s0),
    }
    iterations = {name: ours.solve(case.problem, case.s0).iterations for name in (OURS, WITHOUT)}
    with tempfile.TemporaryDirectory() as folder:
        peers = {PEER: _compiled_ipopt(case, Path(folder))}
        if case.name.startswith("LQR"):
            peers[QP] = _hpipm(case)
        for name, (call, count) in peers.items():
            if call is not None:
                calls[name], iterations[name] = call, count
        timings = interleaved(calls, preset.budget, preset.most)
    return firsts | {name: timing.numbers | {"iterations": iterations[name]} for name, timing in timings.items()}


def _first(solver: Riccati | Ipopt, problem: object, case: ControlProblem) -> float:
    started = time.perf_counter()
    solver.solve(problem, case.s0)
    return 1e3 * (time.perf_counter() - started)


def _compiled_ipopt(case: ControlProblem, folder: Path) -> tuple[Callable[[], object] | None, int]:
    """Ipopt on the same program, with its functions as machine code."""
    problem, command = case.problem, find_compiler()
    if command is None:
        return None, 0
    program = transcribe(problem)
    w, *others = program.symbols
    objective = program.values(*program.symbols)[0]
    nlp = {"x": w, "p": ca.vertcat(*others), "f": objective, "g": program.rows}
    settings = {"tol": TOLERANCE, "print_level": 0, "sb": "yes", "nlp_scaling_method": "none"}
    options = {"ipopt": settings, "print_time": False}
    ca.nlpsol("peer", "ipopt", nlp, options).generate_dependencies("peer.c", {"with_header": False})
    source, library = Path("peer.c"), folder / "peer.so"
    source.rename(folder / "peer.c")
    subprocess.run(
        [command, "-O1", "-Wno-int-conversion", "-fPIC", "-shared", str(folder / "peer.c"), "-o", str(library), "-lm"],
        check=True,
    )
    solver = ca.nlpsol("peer", "ipopt", str(library), options)
    lower, upper = limits_from(problem, case.s0)
    given = {
        "x0": starting_point(problem, case.s0, np.zeros(0), np.zeros(0), None),
        "lbx": lower,
        "ubx": upper,
        "lbg": 0.0,  # dynamics alone
        "ubg": 0.0,
    }
    solver(**given)
    return (lambda: solver(**given)), int(solver.stats()["iter_count"])


def _hpipm(case: ControlProblem) -> tuple[Callable[[], object] | None, int]:
    """HPIPM on the QP that a problem with linear dynamics and quadratic cost is; None where it does not converge."""
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
    numbers = ca.Function("qp", [unknowns], [H, g, ca.jacobian(rows, unknowns), -rows])(0)
    solver = ca.conic(
        "peer",
        "hpipm",
        {"h": numbers[0].sparsity(), "a": numbers[2].sparsity()},
        {
            "N": T,
            "nx": [n_s] * (T + 1),
            "nu": [n_u] * T + [0],
            "ng": [0] * (T + 1),
            "print_time": False,
            "error_on_fail": False,
            "hpipm": {
                "iter_max": 100,
                "res_g_max": TOLERANCE,
                "res_b_max": TOLERANCE,
                "res_d_max": TOLERANCE,
                "res_m_max": TOLERANCE,
            },
        },
    )
    lower, upper = (_side(problem, case.s0, side) for side in (0, 1))
    right = numbers[3]
    given = {"h": numbers[0], "g": numbers[1], "a": numbers[2], "lba": right, "uba": right, "lbx": lower, "ubx": upper}
    solver(**given)
    stats = solver.stats()
    if not stats["success"]:
        return None, 0
    return (lambda: solver(**given)), int(stats.get("iter_count", stats.get("n_iter", -1)))


def _side(problem: object, s0: np.ndarray, side: int) -> np.ndarray:
    """Bounds of one side by stage, those of s_0 at its value."""
    states, actions = np.array(problem.limits[side]), np.asarray(problem.action_bounds[side])
    states[0] = s0
    return np.concatenate([np.hstack([states[:-1], actions]).ravel(), states[-1]])
