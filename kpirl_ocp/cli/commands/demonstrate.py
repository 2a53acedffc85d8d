"""Make demonstrations of a task on the iiwa and write them as episode files."""

from __future__ import annotations

from argparse import Namespace

from kpirl_ocp import figures
from kpirl_ocp.irl.cases.tasks import write_demonstrations
from kpirl_ocp.ocp.models import Robot
from kpirl_ocp.reporting import table, write_metrics


def main(args: Namespace) -> None:
    """Demonstrate, write, draw."""
    out = args.out
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
