"""Learn a cost from demonstrations, plan with it on those kept for testing, and show what was learned."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import numpy as np

from kpirl_ocp import figures
from kpirl_ocp.cli.options.learn import TASKS
from kpirl_ocp.cli.sentences import of_option
from kpirl_ocp.episodes import Episode
from kpirl_ocp.errors import OptionError
from kpirl_ocp.irl.cases.cost_files import LearnedCost, make_basis
from kpirl_ocp.irl.cases.tasks import HORIZON, as_demonstration, demonstrate, read_demonstrations
from kpirl_ocp.irl.hypergradients.implicit import Implicit
from kpirl_ocp.irl.hypergradients.unrolled import Unrolled
from kpirl_ocp.irl.learning.evaluation import Evaluation, evaluate
from kpirl_ocp.irl.learning.learn import learn
from kpirl_ocp.irl.learning.optimisers import LBFGS, Adam, Descent
from kpirl_ocp.irl.learning.result import LearningResult
from kpirl_ocp.ocp.models import KeypointCost, Robot
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.solvers.gradient_descent import GradientDescent
from kpirl_ocp.ocp.solvers.riccati import Riccati
from kpirl_ocp.reporting import said_if_interrupted, table, write_metrics
from kpirl_ocp.types import Array, Demonstration

CHECKPOINT = "learning.npz"
OPTIMISERS = {"adam": Adam, "descent": Descent, "lbfgs": LBFGS}


def load(args: Namespace, robot: Robot) -> list[Episode]:
    """The demonstrations of a directory, or new ones; the first --train are for training."""
    if args.demonstrations and args.task:
        raise OptionError("--demonstrations and --task exclude each other: take those of a directory, or make new ones")
    if args.demonstrations is None:
        return demonstrate(robot, args.task or TASKS[0], args.train + 5, args.seed, HORIZON)
    with of_option("--demonstrations"):
        episodes, _ = read_demonstrations(robot, args.demonstrations)
    if len(episodes) <= args.train or len({episode.horizon for episode in episodes}) > 1:
        raise OptionError(
            f"--demonstrations: {args.demonstrations} holds {len(episodes)} episodes; it takes {args.train} for "
            "training and at least one for testing, all of one length"
        )
    return episodes


def configure(args: Namespace, horizon: int, n_z: int) -> LearnedCost:
    """The cost family with random starting weights, and the inner solver."""
    start = np.random.default_rng(args.seed).uniform(0.5, 1.5, n_z)
    if args.method == "unrolled":
        cost = KeypointCost(make_basis(args.cost))
        descent = GradientDescent(args.inner_steps, args.step_size)
        return LearnedCost(cost, cost.initial(horizon, n_z, start), horizon, descent)
    effort = 1 / (2 * args.step_size * args.inner_steps)  # moves about as far as N gradient steps
    cost = KeypointCost(make_basis(args.cost), (effort,) * horizon, learn_effort=True, positivity="softplus")
    return LearnedCost(cost, cost.initial(horizon, n_z, start), horizon, Riccati())


def optimiser(args: Namespace) -> Adam | Descent | LBFGS:
    """The one that --optimiser names, or the method's own."""
    name = args.optimiser or ("adam" if args.method == "unrolled" else "lbfgs")
    return LBFGS() if name == "lbfgs" else OPTIMISERS[name](args.learning_rate)


def learn_from(args: Namespace, start: LearnedCost, problem: OCP, train: list[Demonstration]) -> LearningResult:
    """Learn and write the best cost, also if interrupted; the same command resumes from the checkpoint."""
    method = Unrolled(start.solver) if isinstance(start.solver, GradientDescent) else Implicit(start.solver)
    checkpoint, path = args.out / CHECKPOINT, args.out / "cost.json"
    result = learn(problem, train, start.psi, method, optimiser(args), args.iterations, checkpoint=checkpoint)
    replace(start, psi=result.psi).write(path)
    if result.interrupted:
        write_metrics(args.out, vars(args), history(result))
        done = f"the best cost of {len(result.losses) - 1} iterations is in {path}"
        raise KeyboardInterrupt(f"{done}; the same command resumes")
    return result


def history(result: LearningResult) -> dict[str, Array]:
    """Numbers for metrics.json."""
    return {"training_losses": result.losses, "seconds": result.seconds, "psi": result.psi}


def means(plan: Evaluation, train: int) -> list[float]:
    """Mean loss and relative distance on the training demonstrations, the first ones, and on the others."""
    parts = [
        values[cut] for cut in (slice(train), slice(train, None)) for values in (plan.losses, plan.relative_distances)
    ]
    return [float(part.mean()) for part in parts]


def draw(
    robot: Robot,
    learned: LearnedCost,
    result: LearningResult,
    plans: dict[str, Evaluation],
    episode: Episode,
    out: Path,
) -> list[Path]:
    """Loss and weights; the arm in the demonstration and in every plan."""
    n_z, n_q = 3 * robot.n_keypoints, robot.n_joints
    loss_figure, (loss_axes, weight_axes, effort_axes) = figures.new_figure(1, 3)
    loss_axes.semilogy(result.losses, color=figures.COLOURS[0])
    loss_axes.set(xlabel="outer iteration", ylabel="IRL loss [m²]", title="training loss")
    loss_axes.grid(alpha=0.3, which="both")
    values, effort = learned.cost.weights(learned.psi, learned.horizon, n_z)
    figures.weights(weight_axes, values, "learned weights")
    effort_axes.bar(range(learned.horizon), effort, color=figures.COLOURS[0])
    kind = "learned" if learned.cost.learn_effort else "fixed"
    effort_axes.set(title=f"effort weights, {kind}", xlabel="action t", ylabel="weight of |u|² [m²/rad²]")

    arm_figure, axes = figures.new_figure(1, 1 + len(plans), width=3.2, height=3.6)
    motions = {"demonstration": episode.joints}
    motions |= {name: plan.solutions[0].states[:, n_z : n_z + n_q] for name, plan in plans.items()}
    for axis, colour, (name, joints) in zip(axes, figures.COLOURS, motions.items(), strict=False):
        keypoints = np.array([robot.locate(theta) for theta in joints])
        figures.arm(axis, np.array([robot.skeleton(theta) for theta in joints]), keypoints, colour, name)
        axis.plot(episode.keypoints[:, :, 0], episode.keypoints[:, :, 2], ":", color=figures.GREY, linewidth=1)
        axis.set(xlim=(-0.2, 1.0), ylim=(-0.05, 1.05))
    axes[0].set_ylabel("z [m]")
    arm_figure.suptitle("later is darker; dots are the keypoints, dotted the demonstrated paths", fontsize=9)
    return [figures.save(loss_figure, out / "learning.png"), figures.save(arm_figure, out / "plans.png")]


def main(args: Namespace) -> None:
    """Learn, then plan with the learned cost."""
    robot = Robot.iiwa()
    episodes = load(args, robot)
    demonstrations = [as_demonstration(robot, episode) for episode in episodes]
    start = configure(args, episodes[0].horizon, demonstrations[0].observations.shape[1])
    problem = start.problem(robot)
    result = learn_from(args, start, problem, demonstrations[: args.train])
    with said_if_interrupted(lambda: f"the learned cost is in {args.out / 'cost.json'}; the same command resumes"):
        show(args, start, result, problem, episodes)
    (args.out / CHECKPOINT).unlink()


def show(args: Namespace, start: LearnedCost, result: LearningResult, problem: OCP, episodes: list[Episode]) -> None:
    """Plan with the starting and the learned cost; print, write and draw the results."""
    out, learned, robot = args.out, replace(start, psi=result.psi), Robot.iiwa()
    demonstrations = [as_demonstration(robot, episode) for episode in episodes]
    plans = {
        name: evaluate(problem, demonstrations, psi, learned.solver)
        for name, psi in (("starting cost", start.psi), ("learned cost", learned.psi))
    }
    header = ["", "train: IRL loss [m²]", "relative distance", "test: IRL loss [m²]", "relative distance"]
    print("\n" + table(header, [[name, *means(plan, args.train)] for name, plan in plans.items()]))
    for name, plan in plans.items():
        if plan.failures:
            print(f"{name}: {plan.failures}")
    print(
        f"\n{args.iterations} outer iterations at most, {len(result.losses) - 1} taken, in {result.seconds[-1]:.1f} s; "
        f"every gradient certified: {'yes' if not result.uncertified.any() else 'no'}"
    )
    results: dict[str, object] = {
        name: {"losses": p.losses, "relative_distances": p.relative_distances} for name, p in plans.items()
    }
    results |= history(result)
    print(f"\ncost:    {out / 'cost.json'}\nnumbers: {write_metrics(out, vars(args), results)}")
    for path in draw(robot, learned, result, plans, episodes[0], out):
        print(f"figure:  {path}")
