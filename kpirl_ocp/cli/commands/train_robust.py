"""Make a keypoint detector robust to its surroundings, and score it on data it has not seen."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterator
from dataclasses import asdict
from math import ceil

import numpy as np
import torch
from tqdm import tqdm

from kpirl_ocp.cli.commands.train_keypoints import CHECKPOINT, check_device, finish, held_out, resumable
from kpirl_ocp.cli.sentences import of_option
from kpirl_ocp.perception.data.motions import HandPlacing, HandWandering, LastJoint, Motion, Placing, Sines
from kpirl_ocp.perception.detector.detector import KeypointDetector
from kpirl_ocp.perception.detector.robust import RobustSettings, train_robust
from kpirl_ocp.perception.scene.frame import Frame

# Motions and how many clips of each.
RENDERED: tuple[tuple[Motion, int], ...] = (
    (HandWandering(rate=5), 160),
    (LastJoint(), 130),
    (HandPlacing(rate=5), 40),
    (Placing(), 40),
    (Sines(steps=20), 40),
)


def rendered(share: float, seed: int) -> Iterator[Frame]:
    """The frames of a share of the usual clips, in front of the white wall."""
    episodes = [(motion, i) for motion, count in RENDERED for i in range(ceil(share * count))]
    for motion, index in tqdm(episodes, "render", unit="clip"):
        yield from motion.film(np.random.default_rng([seed, index]))


def main(args: Namespace) -> None:
    """Render, train, score, draw."""
    torch.set_num_threads(args.threads)
    with resumable(args.out / CHECKPOINT):
        train(args)


def train(args: Namespace) -> None:
    """The detector, scored and saved."""
    settings = RobustSettings(steps=args.steps, batch=args.batch)
    check_device(args.device)
    with of_option("--teacher"):
        teacher = KeypointDetector.load(args.teacher)
    tests = held_out(args.test)
    detector, curves = train_robust(
        teacher,
        rendered(args.clips, args.seed),
        settings,
        args.seed,
        checkpoint=args.out / CHECKPOINT,
        device=args.device,
    )
    card = {"training": {"seed": args.seed, "clips": args.clips, **asdict(settings)}}
    films = (motion.film(np.random.default_rng([args.seed, 0])) for motion, _ in RENDERED)
    clips = [] if args.test else [np.array([frame.rgb for frame in film]) for film in films]
    finish(args, asdict(settings), detector, card, curves, tests=tests, clips=clips)
