"""Make demonstrations of a task on the iiwa and write them as episode files.

The first episode is for training, the others are for testing; starts and goals differ.
"""

import argparse

from kpirl_ocp import figures
from kpirl_ocp.irl.cases.tasks import HORIZON, TASKS, write_demonstrations
from kpirl_ocp.ocp.models import Robot
from kpirl_ocp.reporting import output_directory, run, table, write_metrics


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=list(TASKS), default="placing", help="what is demonstrated")
    parser.add_argument("--tests", type=int, default=5, help="how many test demonstrations (default: 5)")
    parser.add_argument("--horizon", type=int, default=HORIZON, help=f"time steps T (default: {HORIZON})")
    parser.add_argument("--seed", type=int, default=0, help="starts and goals (default: 0)")
    parser.add_argument("--out", default="out/demonstrations", help="directory to write (default: %(default)s)")
    args = parser.parse_args()

    out = output_directory(args.out)
    episodes = write_demonstrations(out, Robot.iiwa(), args.task, args.tests, args.seed, args.horizon)
    names = ["train", *(f"test {i}" for i in range(1, len(episodes)))]
    moves = [episode.keypoints[-1, 0] - episode.keypoints[0, 0] for episode in episodes]
    rows = [[name, *map(float, move)] for name, move in zip(names, moves, strict=True)]
    print(table(["episode", "dx [m]", "dy [m]", "dz [m]"], rows))
    write_metrics(out, vars(args), {"displacements_m": moves})

    figure, axes = figures.new_figure(1, 2)
    for axis, (across, up) in zip(axes, [(0, 2), (0, 1)], strict=True):
        figures.paths(axis, [episode.keypoints for episode in episodes], names, across, up)
        axis.set(title="from the side" if up == 2 else "from above", aspect="equal")
    axes[1].legend(fontsize=7)
    print(f"\nepisodes: {out}\nfigure:   {figures.save(figure, out / 'demonstrations.png')}")


if __name__ == "__main__":
    run(main)
