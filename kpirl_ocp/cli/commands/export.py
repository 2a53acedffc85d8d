"""Export a model-predictive controller as a folder of C99."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import NamedTuple

from kpirl_ocp.cli.learned_cost import cost_of_the_iiwa
from kpirl_ocp.errors import OptionError
from kpirl_ocp.irl.cases.network_cases import placing_case
from kpirl_ocp.irl.cases.own import load_own
from kpirl_ocp.irl.cases.tasks import as_demonstration, demonstrate
from kpirl_ocp.ocp.export import export_c
from kpirl_ocp.ocp.models import KeypointCost, Robot, TimeDependent
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Solver
from kpirl_ocp.ocp.problem.statement.checks import UNBOUNDED
from kpirl_ocp.ocp.solvers.gradient_descent import GradientDescent
from kpirl_ocp.ocp.solvers.riccati import Riccati
from kpirl_ocp.ocp.solvers.sqp import SQP
from kpirl_ocp.types import Array

SOLVERS: dict[str, Solver] = {
    "real-time": Riccati(steps=1, barrier=1e-2),
    "converged": Riccati(1e-8),
    "gradient-descent": GradientDescent(20, 1e-4, project=True),
    "sqp": SQP(),
}
EXAMPLES = 5
_OF_STEPS = (
    "The cost was learned for {} gradient steps from no action: follow the plan that they find. Steps from a plan, as "
    "in the closed loop of the example, go farther than what was learned. For a controller learn with --method "
    "implicit.\n"
)


class Exported(NamedTuple):
    """A problem to export: psi (n_psi,), examples of (s0, context), and its default solver.

    preview: (m, n_d) rows that follow its schedule; None where they are not known.
    """

    problem: OCP
    psi: Array
    examples: list[tuple[Array, Array]]
    solver: Solver
    preview: Array | None = None


def network(horizon: int, seed: int) -> Exported:
    """The placing problem with random weights; starts and goals are from within its training data."""
    data = placing_case(horizon, steps=20, count=EXAMPLES, seed=seed)
    examples = list(zip(data.s0, data.goal, strict=True))
    preview = KeypointCost(TimeDependent(), effort=data.effort).preview(horizon)
    return Exported(data.bounded, data.psi.ravel(), examples, SOLVERS["real-time"], preview)


def learned(path: Path, seed: int) -> Exported:
    """The planning problem of a learned cost, with the starts and goals of demonstrations."""
    robot = Robot.iiwa()
    cost = cost_of_the_iiwa(path, robot)
    episodes = demonstrate(robot, "placing", EXAMPLES, seed, cost.horizon)
    shown = [as_demonstration(robot, episode) for episode in episodes]
    return Exported(cost.problem(robot), cost.psi, [(d.s0, d.context) for d in shown], cost.solver, cost.preview())


def own(place: str) -> Exported:
    """A user's own problem, with its own numbers as the only example."""
    mine = load_own(place)
    return Exported(mine.problem, mine.psi, [(mine.s0, mine.context)], SOLVERS["real-time"])


def chosen(args: Namespace) -> Exported:
    """The problem that the options select."""
    if args.problem and args.cost:
        raise OptionError("--cost is for a learned cost, and FILE.py:FUNCTION your own problem: give one of them")
    if args.horizon and (args.problem or args.cost):
        raise OptionError("--horizon is for the placing model; another problem has a horizon of its own")
    if args.problem:
        return own(args.problem)
    return learned(args.cost, args.seed) if args.cost else network(args.horizon or 10, args.seed)


def main(args: Namespace) -> None:
    """Export, and say how to build."""
    exported = chosen(args)
    solver = SOLVERS[args.solver] if args.solver else exported.solver
    problem = exported.problem
    if isinstance(solver, GradientDescent) and not (args.problem or args.cost):  # it knows no joint limits
        problem = replace(problem, state_bounds=UNBOUNDED)
    preview = exported.preview if isinstance(solver, Riccati) else None  # the others have their schedule compiled in
    folder = export_c(
        problem, solver, args.out, prefix=args.prefix, psi=exported.psi, examples=exported.examples, preview=preview
    )
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    print(f"{folder}: {len(list(folder.rglob('*.c')))} C files, {size / 1e6:.1f} MB\n")
    if args.cost and isinstance(solver, GradientDescent):
        print(_OF_STEPS.format(solver.steps))
    source, build = quote(str(folder)), quote(f"{folder}/build")
    print(
        f"cmake -S {source} -B {build} && cmake --build {build} && ctest --test-dir {build} && "
        f"{quote(f'{folder}/build/{args.prefix}_example')}"
    )
