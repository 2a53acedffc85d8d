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
from kpirl_ocp.cli.sentences import of_option
from kpirl_ocp.errors import OptionError, TrainingError
from kpirl_ocp.perception.data.clips import read_recordings, read_videos
from kpirl_ocp.perception.data.recordings import Recording
from kpirl_ocp.perception.data.video import Frames
from kpirl_ocp.perception.detector.detector import KeypointDetector
from kpirl_ocp.perception.detector.evaluation import DetectorScores, score
from kpirl_ocp.perception.detector.track_images import contact_sheet, track_video
from kpirl_ocp.perception.detector.training import PRESETS, check_lengths, device_called, train_detector
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
    """A block in which Ctrl-C says from where the training can be resumed."""
    words = f"the last checkpoint is {checkpoint}; the same command resumes"
    return said_if_interrupted(lambda: words if checkpoint.exists() else "")


def called(option: str, directories: Sequence[Path]) -> dict[str, Path]:
    """Directories by the names under which their scores are reported. Raises OptionError if two share a name."""
    names = [directory.resolve().name for directory in directories]
    if len(set(names)) < len(names):
        raise OptionError(f"{option}: takes directories of different names, got {', '.join(map(str, directories))}")
    return dict(zip(names, directories, strict=True))


def held_out(directories: Sequence[Path]) -> dict[str, list[Recording]]:
    """The clips of --test. Raises OptionError for fewer than two in a directory, or for clips of different sizes."""
    tests = {}
    for name, directory in called("--test", directories).items():
        with of_option("--test"):
            tests[name] = read_recordings(directory)
        sizes = {clip.images.shape[1:] for clip in tests[name]}
        if len(tests[name]) < 2 or len(sizes) > 1:
            raise OptionError(f"--test: {directory} must hold two clips or more, all of one size")
    return tests


def check_device(name: str) -> None:
    """Raise OptionError if torch has no such device."""
    with of_option("--device"):
        device_called(name)


def finish(
    args: Namespace,
    settings: Mapping[str, Any],
    detector: KeypointDetector,
    card: Mapping[str, Any],
    curves: Mapping[str, Array],
    *,
    tests: Mapping[str, list[Recording]],
    wrong: Sequence[str] = (),
    clips: Sequence[Frames] = (),
) -> None:
    """Score a trained detector on tests, draw, and save it as good or rejected.

    tests: held-out clips, by name. wrong: faults that are known already.
    clips: those to judge it by where there are no tests.

    Raises TrainingError if it is not good.
    """
    out = args.out
    wrong = [*wrong, *faults(detector, [clip.images for recordings in tests.values() for clip in recordings] or clips)]
    scores = {name: score(detector, recordings) for name, recordings in tests.items()}
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
    check_device(args.device)
    with of_option("--start"):
        start = KeypointDetector.load(args.start).model if args.start else None
    with of_option("--data"):
        clips = [clip.images for clip in read_recordings(args.data)]
        check_lengths(clips, settings.frames)
    tests = held_out(args.test)
    with of_option("--videos"):
        others = read_videos(args.videos)
        check_lengths(others or clips, settings.frames)
    trained = train_detector(
        clips,
        settings,
        args.seed,
        others=others,
        start=start,
        checkpoint=args.out / CHECKPOINT,
        device=args.device,
    )
    detector, wrong = KeypointDetector(trained.model, settings.size), []
    try:
        detector = detector.calibrated(others or clips)
    except TrainingError as error:
        wrong = [str(error).removesuffix(".")]

    card = {"training": {"preset": args.preset, "seed": args.seed, "clips": len(clips), "videos": len(others)}}
    finish(args, asdict(settings), detector, card, trained.curves, tests=tests, wrong=wrong, clips=[*clips, *others])
