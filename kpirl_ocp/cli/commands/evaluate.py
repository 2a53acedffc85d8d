"""Plan with a learned cost on new demonstrations; compare it with the Default cost and with standing still."""

from __future__ import annotations

from argparse import Namespace

import numpy as np

from kpirl_ocp import figures
from kpirl_ocp.cli.learned_cost import cost_of_the_iiwa
from kpirl_ocp.cli.sentences import of_option
from kpirl_ocp.errors import OptionError
from kpirl_ocp.irl.cases.cost_files import LearnedCost
from kpirl_ocp.irl.cases.tasks import as_demonstration, read_demonstrations
from kpirl_ocp.irl.learning.evaluation import evaluate
from kpirl_ocp.ocp.models import Default, KeypointCost, Robot
from kpirl_ocp.ocp.solvers.gradient_descent import GradientDescent
from kpirl_ocp.reporting import table, write_metrics


def main(args: Namespace) -> None:
    """Plan with both costs, and draw."""
    robot = Robot.iiwa()
    learned = cost_of_the_iiwa(args.cost, robot)
    with of_option("--demonstrations"):
        episodes, meta = read_demonstrations(robot, args.demonstrations)
    if any(episode.horizon != learned.horizon for episode in episodes):
        raise OptionError(
            f"--cost, --demonstrations: {args.cost} plans {learned.horizon} steps, {args.demonstrations} "
            "has other lengths"
        )
    shown = meta.get("test", list(range(len(episodes))))
    if not isinstance(shown, list) or not shown or not all(i in range(len(episodes)) for i in shown):
        place = f"--demonstrations: 'test' in {args.demonstrations}/meta.json"
        raise OptionError(f"{place} must list some of the {len(episodes)} episodes")
    tests = [as_demonstration(robot, episodes[index]) for index in map(int, shown)]

    # Default moves as far as the learned cost may: the same gradient steps, or the same mean effort.
    effort = learned.cost.weights(learned.psi, learned.horizon, 3 * robot.n_keypoints)[1]
    fixed = 0.0 if isinstance(learned.solver, GradientDescent) else float(effort.mean())
    default = LearnedCost(KeypointCost(Default(), effort=fixed), np.zeros(0), learned.horizon, learned.solver)
    results = {
        name: evaluate(cost.problem(robot), tests, cost.psi, cost.solver)
        for name, cost in (("learned", learned), ("Default", default))
    }
    still = [float(np.sum((demo.observations - demo.observations[0]) ** 2)) for demo in tests]
    rows = [
        [name, r.losses.mean(), r.losses.std(), r.relative_distances.mean(), r.relative_distances.std()]
        for name, r in results.items()
    ]
    header = ["cost", "IRL loss [m²]", "std", "relative distance", "std"]
    print(table(header, [*rows, ["standing still", np.mean(still), np.std(still), 1.0, 0.0]]))
    for name, result in results.items():
        if result.failures:
            print(f"{name}: {result.failures}")

    out = args.out
    figure, axes = figures.new_figure(1, 2)
    for index, (name, result) in enumerate(results.items()):
        for axis, values in zip(axes, (result.losses, result.relative_distances), strict=True):
            positions = np.arange(1, len(tests) + 1) + 0.4 * index - 0.2
            axis.bar(positions, values, 0.4, color=figures.COLOURS[index], label=name)
    axes[0].set(ylabel="IRL loss [m²]", xlabel="test demonstration")
    axes[1].set(ylabel="relative distance to the goal", xlabel="test demonstration")
    axes[0].legend()
    numbers = {name: {"losses": r.losses, "relative_distances": r.relative_distances} for name, r in results.items()}
    print(f"\nnumbers: {write_metrics(out, vars(args), numbers | {'standing still': still})}")
    print(f"figure:  {figures.save(figure, out / 'evaluation.png')}")
