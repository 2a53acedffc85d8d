"""Plan a motion of an arm that carries its keypoints to a goal, and audit the solution.

The goal is the starting place displaced by --move, in metres. Try: --robot panda --solver riccati --move 0.1 0 -0.2
"""

import argparse
from pathlib import Path

import numpy as np

from kpirl_ocp import (
    Default,
    GradientDescent,
    Ipopt,
    KeypointCost,
    Riccati,
    Robot,
    Solution,
    figures,
    keypoint_ocp,
    keypoint_state,
)
from kpirl_ocp.ocp.problem.solver import Solver
from kpirl_ocp.reporting import output_directory, run, table, write_metrics


def robot_called(name: str) -> Robot:
    if name == "iiwa":
        return Robot.iiwa()
    return Robot.from_urdf(name) if name.endswith(".urdf") else Robot.from_example_data(name)


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--robot", default="iiwa", help="iiwa, a name of example-robot-data (panda, ur5), or a .urdf file"
    )
    parser.add_argument("--move", type=float, nargs=3, default=(0.1, 0.0, -0.2), metavar=("DX", "DY", "DZ"), help="[m]")
    parser.add_argument("--horizon", type=int, default=10, help="time steps T (default: 10)")
    parser.add_argument("--effort", type=float, default=0.1, help="weight rho of |u|² (default: 0.1)")
    parser.add_argument("--max-displacement", type=float, default=0.2, help="per joint and step [rad] (default: 0.2)")
    parser.add_argument("--solver", choices=["riccati", "ipopt", "gradient"], default="riccati")
    parser.add_argument("--steps", type=int, default=500, help="of the gradient solver (default: 500)")
    parser.add_argument("--step-size", type=float, default=3e-3, help="of the gradient solver (default: 0.003)")
    parser.add_argument("--out", default="out/solve_ocp", help="directory to write (default: %(default)s)")
    return parser.parse_args()


def bent_posture(robot: Robot) -> np.ndarray:
    """Joint positions away from limits and from stretched postures: mid-range, bent by 0.4 to alternating sides."""
    lower, upper = robot.joint_limits
    bounded = np.isfinite(lower) & np.isfinite(upper)
    middle = np.where(bounded, (np.where(bounded, lower, 0) + np.where(bounded, upper, 0)) / 2, 0.3)
    return np.clip(middle + 0.4 * (-1.0) ** np.arange(robot.n_joints), lower, upper)


def draw(solution: Solution, distance: np.ndarray, joints: np.ndarray, limit: float, path: Path) -> Path:
    """distance (T+1, K) [m] to the goal, joints (T+1, n) [rad], and the actions between their bounds +-limit."""
    figure, axes = figures.new_figure(1, 3)
    for index, values in enumerate(distance.T):
        axes[0].plot(values, marker=".", label=f"keypoint {index}")
    axes[0].set(title="keypoints", xlabel="time step", ylabel="distance to the goal [m]", ylim=(0, None))
    for index, values in enumerate(joints.T):
        axes[1].plot(values, marker=".", label=f"joint {index + 1}")
    axes[1].set(title="joints", xlabel="time step", ylabel="position [rad]")
    axes[2].step(range(len(solution.actions)), solution.actions, where="post")
    for bound in (-limit, limit):
        axes[2].axhline(bound, color=figures.GREY, ls=":")
    axes[2].set(title="actions, bounds dotted", xlabel="time step", ylabel="displacement [rad]")
    for axis in axes:
        axis.grid(alpha=0.3)
    axes[0].legend()
    axes[1].legend(fontsize=6, ncols=2)
    return figures.save(figure, path)


def solver_of(args: argparse.Namespace) -> Solver:
    if args.solver == "gradient":
        return GradientDescent(args.steps, args.step_size, project=True)
    return Riccati() if args.solver == "riccati" else Ipopt()


def main() -> None:
    args = parse()
    robot, gradient = robot_called(args.robot), args.solver == "gradient"
    problem = keypoint_ocp(
        robot,
        KeypointCost(Default(), effort=args.effort),
        args.horizon,
        joint_limits=not gradient,  # gradient descent projects onto action bounds only
        max_displacement=args.max_displacement,
    )
    start = bent_posture(robot)
    goal = (robot.locate(start) + np.array(args.move)).ravel()
    solution = solver_of(args).solve(problem, keypoint_state(robot, start), (), goal)

    keypoints, joints, _ = np.split(solution.states, [goal.size, goal.size + robot.n_joints], axis=1)
    distance = np.linalg.norm((keypoints - goal).reshape(args.horizon + 1, -1, 3), axis=2)
    residuals = solution.residuals
    rows = [
        ["status", solution.status.name],
        ["objective", solution.objective],
        ["iterations", solution.iterations],
        ["stationarity", residuals.stationarity],
        ["feasibility", residuals.feasibility],
        ["complementarity", residuals.complementarity],
        ["KKT residual, relative", residuals.worst],
        ["distance to the goal [m]", float(distance[-1].mean())],
        ["largest action multiplier", float(np.abs(solution.multipliers.action).max())],
    ]
    print(table(["", "value"], rows) + f"\n{solution.status.name}: {solution.status.value}")

    out = output_directory(args.out)
    results = dict(rows) | {"states": solution.states, "actions": solution.actions}
    print(f"\nnumbers: {write_metrics(out, vars(args), results)}")
    print(f"figure:  {draw(solution, distance, joints, args.max_displacement, out / 'plan.png')}")


if __name__ == "__main__":
    run(main)
