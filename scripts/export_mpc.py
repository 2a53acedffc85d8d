"""Export a model-predictive controller as a folder of C99 that needs nothing but libc and libm.

Without --cost: the placing model that comes with the package, with action bounds and joint limits; weights of keypoints
and goal are given at run time. With --cost: the planner of a cost that learn_cost.py learned, on the iiwa's kinematics.
"""

import argparse
from dataclasses import replace
from pathlib import Path

from kpirl_ocp import OCP, GradientDescent, Riccati
from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.cases.cost_files import LearnedCost
from kpirl_ocp.irl.cases.network_cases import placing_case
from kpirl_ocp.irl.cases.tasks import as_demonstration, demonstrate
from kpirl_ocp.ocp.export import export_c
from kpirl_ocp.ocp.models import Robot
from kpirl_ocp.ocp.problem.solver import Solver
from kpirl_ocp.ocp.problem.statement.checks import UNBOUNDED
from kpirl_ocp.ocp.solvers.sqp import SQP
from kpirl_ocp.reporting import run
from kpirl_ocp.types import Array

SOLVERS: dict[str, Solver] = {
    "real-time": Riccati(steps=1, barrier=1e-2),
    "converged": Riccati(1e-8),
    "gradient-descent": GradientDescent(20, 1e-4, project=True),
    "sqp": SQP(),
}
EXAMPLES = 5


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="directory to write")
    parser.add_argument("--solver", choices=list(SOLVERS), help="default: real-time, or what --cost was learned for")
    parser.add_argument("--horizon", type=int, default=10, help="T of the placing model (default: 10)")
    parser.add_argument("--cost", type=Path, help="cost.json of learn_cost.py")
    parser.add_argument("--prefix", default="kpirl_mpc", help="of all names and files (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the recorded examples (default: 0)")
    return parser.parse_args()


def network(horizon: int, seed: int) -> tuple[OCP, Array, list[tuple[Array, Array]]]:
    """The placing problem with random weights, and starts with goals within its training data."""
    data = placing_case(horizon, steps=20, count=EXAMPLES, seed=seed)
    return data.bounded, data.psi.ravel(), list(zip(data.s0, data.goal, strict=True))


def learned(path: Path, seed: int) -> tuple[OCP, Array, list[tuple[Array, Array]], Solver]:
    """The planning problem of a learned cost, and demonstrated starts with goals."""
    cost, robot = LearnedCost.read(path), Robot.iiwa()
    episodes = demonstrate(robot, "placing", EXAMPLES, seed, cost.horizon)
    shown = [as_demonstration(robot, episode) for episode in episodes]
    return cost.problem(robot), cost.psi, [(d.s0, d.context) for d in shown], cost.solver


def main() -> None:
    args = parse()
    if args.horizon < 1:
        raise ProblemError(f"--horizon must be at least 1, got {args.horizon}.")
    solver: Solver = SOLVERS[args.solver or "real-time"]
    if args.cost is None:
        problem, psi, examples = network(args.horizon, args.seed)
        if isinstance(solver, GradientDescent):  # it knows no joint limits
            problem = replace(problem, state_bounds=UNBOUNDED)
    else:
        problem, psi, examples, own = learned(args.cost, args.seed)
        solver = own if args.solver is None else solver
    folder = export_c(problem, solver, args.out, prefix=args.prefix, psi=psi, examples=examples)
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    print(f"{folder}: {len(list(folder.rglob('*.c')))} C files, {size / 1e6:.1f} MB\n")
    print(
        f"cmake -S {folder} -B {folder}/build && cmake --build {folder}/build && ctest --test-dir {folder}/build && "
        f"{folder}/build/{args.prefix}_example"
    )


if __name__ == "__main__":
    run(main)
