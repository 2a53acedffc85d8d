"""Train the dynamics of keypoints on recordings of the robot, seen through a trained detector."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch

from kpirl_ocp import figures
from kpirl_ocp.cli.commands.train_keypoints import CHECKPOINT, called, resumable
from kpirl_ocp.cli.sentences import of_option
from kpirl_ocp.errors import OptionError
from kpirl_ocp.perception.detector.detector import KeypointDetector
from kpirl_ocp.perception.detector.tracks import detect_tracks, recorded_sizes
from kpirl_ocp.perception.dynamics.augmentation import augmented
from kpirl_ocp.perception.dynamics.training import DynamicsScores, DynamicsSettings, score_dynamics, train_dynamics
from kpirl_ocp.reporting import table, write_metrics
from kpirl_ocp.types import Array


def draw(scores: dict[str, DynamicsScores], curves: dict[str, Array], path: Path) -> Path:
    """Training curves, and scores over the steps ahead."""
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


def check(args: Namespace) -> None:
    """Raise OptionError for recordings that cannot be read, are too few or too short, or are of different arms."""
    data, tests = sizes("--data", args.data), sizes("--test", list(called("--test", args.test).values()))
    if len(data) < 2:
        raise OptionError("--data: training needs at least two recordings, got 1")
    if len(joints := {n_joints for _, n_joints in (*data, *tests)}) > 1:
        raise OptionError(f"--data, --test: one arm is needed, got {min(joints)} and {max(joints)} joints")
    longest, shortest = max(data)[0], min(tests)[0]
    if args.steps is not None and args.steps > longest:
        raise OptionError(f"--steps: must be at most {longest}, the steps of the longest recording, got {args.steps}")
    if args.ahead > shortest:
        raise OptionError(f"--ahead: must be at most {shortest}, the steps of the shortest test, got {args.ahead}")


def sizes(option: str, directories: Sequence[Path]) -> list[tuple[int, int]]:
    """T and number of joints of all recordings in directories. Raises OptionError if one holds none."""
    found = []
    for directory in directories:
        with of_option(option):
            recorded = recorded_sizes(directory)
        if not recorded:
            raise OptionError(f"{option}: {directory} holds no recordings")
        found += recorded
    return found


def main(args: Namespace) -> None:
    """Train, score, draw."""
    torch.set_num_threads(1)
    with resumable(args.out / CHECKPOINT):
        train(args)


def train(args: Namespace) -> None:
    """The dynamics, scored and saved."""
    out = args.out
    with of_option("--detector"):
        detector = KeypointDetector.load(args.detector)
    check(args)
    names = ("activation", "steps", "epochs")
    given = {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    settings = replace(DynamicsSettings(), **given)
    tracks = [track for directory in args.data for track in detect_tracks(detector, directory)]
    data = augmented(tracks, np.random.default_rng(args.seed)) if args.augment else tracks
    tests = {name: detect_tracks(detector, directory) for name, directory in called("--test", args.test).items()}
    model, curves = train_dynamics(data, settings, args.seed, checkpoint=out / CHECKPOINT)
    scores = {name: score_dynamics(model, held_out, args.ahead) for name, held_out in tests.items()}

    rows = [row for name, found in scores.items() for row in score_rows(name, found)]
    print(table(["test", "NMSE", "nothing moves", "ratio"], rows))
    write_metrics(out, vars(args) | asdict(settings), {"scores": {name: asdict(s) for name, s in scores.items()}})
    card = {
        "rate": float(1 / (tracks[0].times[1] - tracks[0].times[0])),
        "training": asdict(settings) | {"seed": args.seed, "trajectories": len(data), "augmented": args.augment},
        "metrics": {
            name: {"nmse": float(s.model[0].mean()), "persistence": float(s.persistence[0].mean())}
            for name, s in scores.items()
        },
    }
    print(f"\nmodel:  {model.save(out / 'dynamics.json', card)}")
    print(f"figure: {draw(scores, curves, out / 'dynamics.png')}")
