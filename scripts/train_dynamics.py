"""Train the dynamics of keypoints on recordings of the robot, seen through a trained detector.

Scores are NMSE on held-out trajectories, beside persistence ("nothing moves").
"""

import argparse
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch

from kpirl_ocp import figures
from kpirl_ocp.errors import ProblemError
from kpirl_ocp.perception.detector.detector import KeypointDetector
from kpirl_ocp.perception.detector.tracks import detect_tracks
from kpirl_ocp.perception.dynamics.model import ACTIVATIONS
from kpirl_ocp.perception.dynamics.training import DynamicsScores, DynamicsSettings, score_dynamics, train_dynamics
from kpirl_ocp.reporting import output_directory, run, table, write_metrics
from kpirl_ocp.types import Array


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--detector", required=True, help="card of a trained detector (detector.json)")
    parser.add_argument("--data", nargs="+", required=True, help="directories of recordings of the robot")
    parser.add_argument("--test", nargs="+", required=True, help="directories of held-out recordings")
    defaults = DynamicsSettings()
    parser.add_argument("--activation", choices=list(ACTIVATIONS), default=defaults.activation)
    parser.add_argument(
        "--steps", type=int, default=defaults.steps, help="predicted in the loss (default: %(default)s)"
    )
    parser.add_argument("--epochs", type=int, default=defaults.epochs, help="(default: %(default)s)")
    parser.add_argument("--ahead", type=int, default=10, help="steps to predict in the test (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of weights and batches (default: 0)")
    parser.add_argument("--out", default="out/dynamics", help="directory to write (default: %(default)s)")
    return parser.parse_args()


def draw(scores: dict[str, DynamicsScores], curves: dict[str, Array], path: Path) -> Path:
    figure, axes = figures.new_figure(1, 1 + len(scores))
    for colour, (name, values) in zip(figures.COLOURS, curves.items(), strict=False):
        axes[0].semilogy(values, color=colour, label=name)
    axes[0].set(title="training", xlabel="epoch", ylabel="NMSE")
    for axis, (name, found) in zip(axes[1:], scores.items(), strict=True):
        ahead = np.arange(1, len(found.model) + 1)
        axis.semilogy(ahead, found.model.mean(axis=1), ".-", color=figures.COLOURS[0], label="model")
        axis.semilogy(ahead, found.persistence.mean(axis=1), ".-", color=figures.GREY, label="nothing moves")
        axis.set(title=f"test: {name}", xlabel="steps ahead", ylabel="NMSE")
    for axis in axes:
        axis.legend(fontsize=8)
        axis.grid(alpha=0.3, which="both")
    return figures.save(figure, path)


def score_rows(name: str, found: DynamicsScores) -> list[list[object]]:
    """Rows for one step and for the last step, coordinate by coordinate and in the mean."""
    rows: list[list[object]] = []
    for step in (0, len(found.model) - 1):
        label, model, still = f"{name}, {step + 1} ahead", found.model[step], found.persistence[step]
        pairs = enumerate(zip(model, still, strict=True))
        rows += [[f"{label}, {'xy'[i % 2]} of {i // 2}", float(a), float(b), float(a / b)] for i, (a, b) in pairs]
        rows.append([f"{label}, mean", float(model.mean()), float(still.mean()), float(model.mean() / still.mean())])
    return rows


def main() -> None:
    args = parse()
    torch.set_num_threads(1)
    out = output_directory(args.out)
    detector = KeypointDetector.load(args.detector)
    settings = replace(DynamicsSettings(), activation=args.activation, steps=args.steps, epochs=args.epochs)
    tracks = [track for directory in args.data for track in detect_tracks(detector, directory)]
    tests = {Path(directory).name: detect_tracks(detector, directory) for directory in args.test}
    shortest = min(len(track.actions) for held_out in tests.values() for track in held_out)
    if not 1 <= args.ahead <= shortest:
        raise ProblemError(f"--ahead must be from 1 to the {shortest} steps of the shortest test, got {args.ahead}.")
    model, curves = train_dynamics(tracks, settings, args.seed)
    scores = {name: score_dynamics(model, held_out, args.ahead) for name, held_out in tests.items()}

    rows = [row for name, found in scores.items() for row in score_rows(name, found)]
    print(table(["test", "NMSE", "nothing moves", "ratio"], rows))
    write_metrics(out, vars(args) | asdict(settings), {"scores": {name: asdict(s) for name, s in scores.items()}})
    card = {
        "rate": float(1 / (tracks[0].times[1] - tracks[0].times[0])),
        "training": asdict(settings) | {"seed": args.seed, "trajectories": len(tracks)},
        "metrics": {
            name: {"nmse": float(s.model[0].mean()), "persistence": float(s.persistence[0].mean())}
            for name, s in scores.items()
        },
    }
    print(f"\nmodel:  {model.save(out / 'dynamics.json', card)}")
    print(f"figure: {draw(scores, curves, out / 'dynamics.png')}")


if __name__ == "__main__":
    run(main)
