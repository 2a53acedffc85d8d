"""Train the keypoint detector on camera data without labels, and score it on data it has not seen."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from kpirl_ocp import figures
from kpirl_ocp.errors import TrainingError
from kpirl_ocp.perception.data.clips import read_recordings, read_videos
from kpirl_ocp.perception.data.video import Frames
from kpirl_ocp.perception.detector.detector import KeypointDetector
from kpirl_ocp.perception.detector.evaluation import DetectorScores, score
from kpirl_ocp.perception.detector.track_images import contact_sheet, track_video
from kpirl_ocp.perception.detector.training import PRESETS, train_detector
from kpirl_ocp.perception.detector.verdict import faults
from kpirl_ocp.reporting import said_if_interrupted, table, write_metrics
from kpirl_ocp.types import Array

CHECKPOINT = "checkpoint.safetensors"


def draw_curves(curves: Mapping[str, Array], path: Path) -> Path:
    """One panel a term of the loss."""
    figure, axes = figures.new_figure(1, len(curves), width=2.6, height=2.4)
    for axis, (name, curve) in zip(axes, curves.items(), strict=True):
        axis.plot(curve, color=figures.COLOURS[0], linewidth=0.8)
        axis.set(title=name, xlabel="step", yscale="log" if (curve > 0).all() else "linear")
        axis.grid(alpha=0.3, which="both")
    axes[0].set_ylabel("loss")
    return figures.save(figure, path)


def score_rows(scores: dict[str, DetectorScores]) -> list[list[object]]:
    """A row per data set and keypoint, and one for their mean."""
    rows: list[list[object]] = []
    for name, found in scores.items():
        columns = np.array([found.error, found.on_mask, found.displacement, found.jitter])
        rows += [[f"{name}, keypoint {k}", *map(float, column)] for k, column in enumerate(columns.T)]
        rows.append([f"{name}, mean", *map(float, columns.mean(axis=1))])
    return rows


def resumable(checkpoint: Path) -> AbstractContextManager[None]:
    """A block in which Ctrl-C says where the training can go on."""
    words = f"the last checkpoint is {checkpoint}; the same command goes on"
    return said_if_interrupted(lambda: words if checkpoint.exists() else "")


def finish(
    args: Namespace,
    settings: Mapping[str, Any],
    detector: KeypointDetector,
    card: Mapping[str, Any],
    curves: Mapping[str, Array],
    *,
    wrong: Sequence[str] = (),
    clips: Sequence[Frames] = (),
) -> None:
    """Score a trained detector on --test, draw, and save it as good or rejected.

    wrong: faults that are known already. clips: to judge it by where there is nothing to test on.

    Raises TrainingError if it is not good.
    """
    out = args.out
    tests = {Path(directory).name: read_recordings(directory) for directory in args.test}
    wrong = [*wrong, *faults(detector, [clip.images for held_out in tests.values() for clip in held_out] or clips)]
    scores = {name: score(detector, held_out) for name, held_out in tests.items()}
    results = {
        "steps": len(curves["total"]),
        "losses": {name: float(curve[-50:].mean()) for name, curve in curves.items()},
        "scores": {name: asdict(found) | {"on_object": found.on_object} for name, found in scores.items()},
    }
    write_metrics(out, vars(args) | dict(settings), results)
    metrics = {
        name: {
            "error": float(s.error.mean()),
            "displacement": float(np.median(s.displacement)),
            "on_object": s.on_object,
        }
        for name, s in scores.items()
    }
    model = detector.save(out / ("rejected.json" if wrong else "detector.json"), dict(card) | {"metrics": metrics})
    if scores:
        header = ["", "error [px]", "on the bottle", "displacement error [px]", "jitter [px]"]
        print(table(header, score_rows(scores)))
        sheet = {name: (held[0].images, detector.detect(held[0].images)) for name, held in tests.items()}
        print(f"\nsheet:  {contact_sheet(out / 'contact_sheet.png', sheet)}")
        for name, (images, keypoints) in sheet.items():
            track_video(out / f"tracks_{name}.mp4", images, keypoints, rate=5)
    print(f"curves: {draw_curves(curves, out / 'curves.png')}\nmodel:  {model}")
    if wrong:
        raise TrainingError(f"the detector is not good: {'; '.join(wrong)}. It is kept as {model}.")


def main(args: Namespace) -> None:
    """Train, score, draw."""
    torch.set_num_threads(args.threads)
    with resumable(args.out / CHECKPOINT):
        train(args)


def train(args: Namespace) -> None:
    """The detector, scored and saved."""
    settings = PRESETS[args.preset]
    settings = settings if args.steps is None else replace(settings, steps=args.steps)
    clips = [clip.images for clip in read_recordings(args.data)]
    others = read_videos(args.videos)
    trained = train_detector(
        clips,
        settings,
        args.seed,
        others=others,
        start=KeypointDetector.load(args.start).model if args.start else None,
        checkpoint=args.out / CHECKPOINT,
        device=args.device,
    )
    detector, wrong = KeypointDetector(trained.model, settings.size), []
    try:
        detector = detector.calibrated(others or clips)
    except TrainingError as error:
        wrong = [str(error).rstrip(".")]

    card = {"training": {"preset": args.preset, "seed": args.seed, "clips": len(clips), "videos": len(others)}}
    finish(args, asdict(settings), detector, card, trained.curves, wrong=wrong, clips=[*clips, *others])
