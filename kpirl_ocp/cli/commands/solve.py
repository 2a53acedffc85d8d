"""Plan with a solver, and show the solution's own audit."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from kpirl_ocp import figures, viewing
from kpirl_ocp.cli.options.solve import ARM
from kpirl_ocp.cli.sentences import of_option
from kpirl_ocp.errors import OptionError
from kpirl_ocp.irl.cases.cost_files import robot_called
from kpirl_ocp.irl.cases.own import load_own
from kpirl_ocp.ocp.models.keypoint_costs import Default, KeypointCost
from kpirl_ocp.ocp.models.keypoint_problems import keypoint_ocp, keypoint_state
from kpirl_ocp.ocp.models.robot import Robot, held_object
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Solver
from kpirl_ocp.ocp.solvers.fatrop import Fatrop
from kpirl_ocp.ocp.solvers.gradient_descent import GradientDescent
from kpirl_ocp.ocp.solvers.ipopt import Ipopt
from kpirl_ocp.ocp.solvers.riccati import Riccati
from kpirl_ocp.ocp.solvers.sqp import SQP
from kpirl_ocp.reporting import table, write_metrics
from kpirl_ocp.types import Array, Solution

_RATE = 5.0  # [Hz] at which a plan is shown


def main(args: Namespace) -> int:
    """Solve; 1 if the solution did not converge."""
    solution, rows, figure = _solve_own(args) if args.problem else _solve_arm(args)
    print(table(["", "value"], rows) + f"\n{solution.status.name}: {solution.status.value}")
    results = dict(rows) | {"states": solution.states, "actions": solution.actions}
    print(f"\nnumbers: {write_metrics(args.out, vars(args), results)}\nfigure:  {figure}")
    return 0 if solution.status.ok else 1


def solver_of(args: Namespace) -> Solver:
    """The solver that --solver names."""
    if args.solver == "gradient":
        return GradientDescent(args.steps, args.step_size, project=True)
    solvers: dict[str, type[Solver]] = {"riccati": Riccati, "ipopt": Ipopt, "fatrop": Fatrop, "sqp": SQP}
    return solvers[args.solver]()


def bent_posture(robot: Robot, bend: float = 0.4) -> Array:
    """Joint positions away from limits and from stretched postures: mid-range, bent to alternating sides.

    bend: of a joint [rad], and at most half of the way to its limits.
    """
    lower, upper = robot.joint_limits
    bounded = np.isfinite(lower) & np.isfinite(upper)
    middle = np.where(bounded, (np.where(bounded, lower, 0) + np.where(bounded, upper, 0)) / 2, 0.3)
    bends = np.minimum(bend, (upper - middle) / 2)
    return middle + bends * (-1.0) ** np.arange(robot.n_joints)


def _solve_arm(args: Namespace) -> tuple[Solution, list[tuple[str, object]], Path]:
    vars(args).update({name: value for name, value in ARM.items() if getattr(args, name) is None})
    write_rerun = viewing.write_rerun if args.rerun else None  # before the solve: it raises if its package is missing
    with of_option("--robot" if args.tool is None else f"--robot {args.robot} --tool {args.tool}"):
        robot = robot_called(args.robot, () if args.tool is None else held_object(args.tool))
    problem = keypoint_ocp(
        robot,
        KeypointCost(Default(), effort=args.effort),
        args.horizon,
        joint_limits=args.solver != "gradient",  # gradient descent projects onto action bounds only
        max_displacement=args.max_displacement,
    )
    start = bent_posture(robot)
    goal = (robot.locate(start) + np.array(args.move)).ravel()
    solution = solver_of(args).solve(problem, keypoint_state(robot, start), (), goal)
    keypoints, joints, _ = np.split(solution.states, [goal.size, goal.size + robot.n_joints], axis=1)
    distance = np.linalg.norm((keypoints - goal).reshape(args.horizon + 1, -1, 3), axis=2)
    rows = [*_audit(solution), ("distance to the goal [m]", float(distance[-1].mean()))]
    if write_rerun is not None:
        write_rerun(args.out / "plan.rrd", robot, joints, _RATE, goal)
    return solution, rows, _draw_arm(solution, distance, joints, args.max_displacement, args.out / "plan.png")


def _solve_own(args: Namespace) -> tuple[Solution, list[tuple[str, object]], Path]:
    if given := [name for name in ARM if getattr(args, name) is not None]:
        raise OptionError(f"--{given[0].replace('_', '-')} is for the arm's problem, and {args.problem} is your own")
    own = load_own(args.problem)
    solution = solver_of(args).solve(own.problem, own.s0, own.psi, own.context)
    return solution, _audit(solution), _draw_own(own.problem, solution, args.out / "plan.png")


def _audit(solution: Solution) -> list[tuple[str, object]]:
    residuals = solution.residuals
    return [
        ("status", solution.status.name),
        ("objective", solution.objective),
        ("iterations", solution.iterations),
        ("stationarity", residuals.stationarity),
        ("feasibility", residuals.feasibility),
        ("complementarity", residuals.complementarity),
        ("KKT residual, relative", residuals.worst),
        ("largest action multiplier", float(np.abs(solution.multipliers.action).max())),
    ]


def _draw_arm(solution: Solution, distance: Array, joints: Array, limit: float, path: Path) -> Path:
    """distance (T+1, K) [m] to the goal, joints (T+1, n) [rad], and the actions between their bounds +-limit."""
    figure, axes = figures.new_figure(1, 3)
    _lines(axes[0], distance, "keypoint {}", title="keypoints", ylabel="distance to the goal [m]", ylim=(0, None))
    _lines(axes[1], joints, "joint {}", title="joints", ylabel="position [rad]")
    bounds = np.array([[-limit], [limit]])
    _actions(axes[2], solution.actions, bounds, title="actions, bounds dotted", ylabel="displacement [rad]")
    return figures.save(figure, path)


def _draw_own(problem: OCP, solution: Solution, path: Path) -> Path:
    figure, axes = figures.new_figure(1, 2)
    _lines(axes[0], solution.states, "state {}", title="states", ylabel="state")
    _actions(axes[1], solution.actions, np.array(problem.action_bounds), title="actions", ylabel="action")
    return figures.save(figure, path)


def _lines(axis: Axes, values: Array, label: str, **settings: object) -> None:
    """Columns of values (T+1, n) over time."""
    for index, column in enumerate(values.T):
        axis.plot(column, marker=".", label=label.format(index + 1))
    axis.set(xlabel="time step", **settings)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8, ncols=2)


def _actions(axis: Axes, actions: Array, bounds: Array, **settings: object) -> None:
    """actions (T, n) as steps, their finite bounds (2, n) dotted."""
    axis.step(np.arange(len(actions) + 1), np.vstack([actions, actions[-1:]]), where="post")
    for bound in np.unique(bounds[np.isfinite(bounds)]):
        axis.axhline(bound, color=figures.GREY, ls=":")
    axis.set(xlabel="time step", **settings)
    axis.grid(alpha=0.3)
