"""Learn a cost from one or more demonstrations, plan with it on those kept for testing, and show what was learned.

unrolled: the paper's way; N gradient steps on the actions, differentiated.
implicit: the planning problem is solved to the end with Riccati, and its optimality conditions are differentiated.
"""

import argparse
from pathlib import Path

import numpy as np

from kpirl_ocp import GradientDescent, Implicit, Riccati, Unrolled, figures
from kpirl_ocp.episodes import Episode, read_episodes
from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.cases.cost_files import BASES, LearnedCost, make_basis
from kpirl_ocp.irl.cases.tasks import HORIZON, TASKS, as_demonstration, demonstrate
from kpirl_ocp.irl.learning.evaluation import Evaluation, evaluate
from kpirl_ocp.irl.learning.learn import learn
from kpirl_ocp.irl.learning.optimisers import LBFGS, Adam, Descent
from kpirl_ocp.irl.learning.result import LearningResult
from kpirl_ocp.ocp.models import KeypointCost, Robot
from kpirl_ocp.reporting import output_directory, run, table, write_metrics

OPTIMISERS = {"adam": Adam, "descent": Descent, "lbfgs": LBFGS}


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--demonstrations", type=Path, help="directory from make_demonstrations.py")
    source.add_argument("--task", choices=list(TASKS), default="placing", help="or: demonstrate this task afresh")
    parser.add_argument("--train", type=int, default=1, help="demonstrations to learn from, the first (default: 1)")
    parser.add_argument("--method", choices=["unrolled", "implicit"], default="unrolled", help="hypergradient")
    parser.add_argument("--cost", choices=[n for n in BASES if n != "default"], default="weighted", help="cost family")
    parser.add_argument("--steps", type=int, default=100, help="outer iterations (default: 100)")
    parser.add_argument("--optimiser", choices=list(OPTIMISERS), help="default: adam (unrolled), lbfgs (implicit)")
    parser.add_argument("--learning-rate", type=float, default=1e-2, help="of adam and descent (default: 0.01)")
    parser.add_argument("--inner-steps", type=int, default=5, help="N of the unrolled method (default: 5)")
    parser.add_argument("--step-size", type=float, default=1e-2, help="alpha of the unrolled method (default: 0.01)")
    parser.add_argument("--seed", type=int, default=0, help="demonstrations and starting weights (default: 0)")
    parser.add_argument("--out", default="out/learn_cost", help="directory to write (default: %(default)s)")
    return parser.parse_args()


def load(args: argparse.Namespace, robot: Robot) -> list[Episode]:
    if args.train < 1:
        raise ProblemError(f"--train must be at least one demonstration, got {args.train}.")
    if args.demonstrations is None:
        return demonstrate(robot, args.task, args.train + 5, args.seed, HORIZON)
    episodes, _ = read_episodes(args.demonstrations, Episode)
    if len(episodes) <= args.train or len({episode.horizon for episode in episodes}) > 1:
        raise ProblemError(
            f"{args.demonstrations} holds {len(episodes)} episodes; it takes {args.train} for training "
            "and at least one for testing, all of one length."
        )
    return episodes


def configure(args: argparse.Namespace, horizon: int, n_z: int) -> LearnedCost:
    """The cost family with random starting weights, and the inner solver."""
    start = np.random.default_rng(args.seed).uniform(0.5, 1.5, n_z)
    if args.method == "unrolled":
        cost = KeypointCost(make_basis(args.cost))
        solver = GradientDescent(args.inner_steps, args.step_size)
    else:
        effort = 1 / (2 * args.step_size * args.inner_steps)  # moves about as far as N gradient steps
        cost = KeypointCost(make_basis(args.cost), (effort,) * horizon, learn_effort=True, positivity="softplus")
        solver = Riccati()
    return LearnedCost(cost, cost.initial(horizon, n_z, start), horizon, solver)


def optimiser(args: argparse.Namespace) -> Adam | Descent | LBFGS:
    name = args.optimiser or ("adam" if args.method == "unrolled" else "lbfgs")
    return LBFGS() if name == "lbfgs" else OPTIMISERS[name](args.learning_rate)


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


def main() -> None:
    args = parse()
    out, robot = output_directory(args.out), Robot.iiwa()
    episodes = load(args, robot)
    demonstrations = [as_demonstration(robot, episode) for episode in episodes]
    start = configure(args, episodes[0].horizon, demonstrations[0].observations.shape[1])
    problem = start.problem(robot)
    method = Unrolled(start.solver) if isinstance(start.solver, GradientDescent) else Implicit(start.solver)
    known = out / "learning.npz"  # from which the same command goes on if it was interrupted
    train = demonstrations[: args.train]
    result = learn(problem, train, start.psi, method, optimiser(args), args.steps, checkpoint=known)
    learned = LearnedCost(start.cost, result.psi, start.horizon, start.solver)
    learned.write(out / "cost.json")

    plans = {
        name: evaluate(problem, learned.solver, psi, demonstrations)
        for name, psi in (("starting cost", start.psi), ("learned cost", learned.psi))
    }
    header = ["", "train: IRL loss [m²]", "relative distance", "test: IRL loss [m²]", "relative distance"]
    print("\n" + table(header, [[name, *means(plan, args.train)] for name, plan in plans.items()]))
    print(
        f"\n{args.steps} outer iterations at most, {len(result.losses) - 1} taken, in {result.seconds[-1]:.1f} s; "
        f"every gradient certified: {'yes' if not result.uncertified.any() else 'no'}"
    )
    results = {name: {"losses": p.losses, "relative_distances": p.relative_distances} for name, p in plans.items()}
    results |= {"training_losses": result.losses, "seconds": result.seconds, "psi": result.psi}
    print(f"\ncost:    {out / 'cost.json'}\nnumbers: {write_metrics(out, vars(args), results)}")
    for path in draw(robot, learned, result, plans, episodes[0], out):
        print(f"figure:  {path}")
    if result.interrupted:
        print(f"interrupted after {len(result.losses) - 1} of {args.steps} outer iterations; the same command goes on.")
    else:
        known.unlink()


if __name__ == "__main__":
    run(main)
