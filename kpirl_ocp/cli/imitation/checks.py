"""Options of `kpirl learn-video`, checked before the film is opened: those that exclude each other, arms and files."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from kpirl_ocp.cli.imitation import learned_dynamics
from kpirl_ocp.cli.sentences import of_option
from kpirl_ocp.errors import OptionError
from kpirl_ocp.irl.cases.cost_files import LearnedCost, robot_called
from kpirl_ocp.ocp.models.robot import Keypoint
from kpirl_ocp.perception.detector.detector import KeypointDetector
from kpirl_ocp.perception.hands.landmarks import check_hands
from kpirl_ocp.perception.tracking.objects import check_box, check_points
from kpirl_ocp.perception.tracking.tracks import check_size, own_rate, read_tracks
from kpirl_ocp.perception.tracking.watch import LONGEST, Film
from kpirl_ocp.types import Array

_ROUNDED = 0.05  # by which a time that a player shows may be rounded up [s]
_SAME_RATE = 0.02  # relative difference of rates that are rounded, as 29.97 to 30 Hz


def check(args: Namespace) -> None:
    """Raise OptionError, or the error of the arm, file or extra that an option needs."""
    _together(args)
    if args.hand:
        check_hands()
    if args.tracks:
        with of_option("--tracks"):
            read_tracks(args.tracks, rate=args.source_rate, size=(LONGEST, LONGEST))
    if args.detector:
        with of_option("--detector"):
            KeypointDetector.load(args.detector)
    if args.dynamics:
        learned_dynamics.check(args)
    else:
        _arm_and_cost(args)
        _sized(args)


def check_film(args: Namespace, film: Film) -> None:
    """Raise OptionError if --start, --end, --box, --points, --tracks or --source-rate contradict the film."""
    if args.start or args.end is not None:
        _within(args, Film(film.path, film.source_rate, end=film.end).times())
    if args.box:
        with of_option("--box"):
            check_box(film.first(), args.box)
    if args.points:
        with of_option("--points"):
            check_points(film.first(), args.points)
    if args.tracks:
        _tracks_of(args, film)


def camera_cost(path: Path, robot: str, steps: int) -> LearnedCost:
    """The cost of a file, in a camera's image. Raises OptionError if it is for another robot or number of steps."""
    with of_option("--cost"):
        learned = LearnedCost.read(path)
    if learned.setting.camera is None:
        raise OptionError(f"--cost: {path} is for keypoints in space; a film needs keypoints in a camera's image")
    if learned.horizon != steps:
        raise OptionError(f"--cost: {path} has T = {learned.horizon}, --steps says {steps}")
    if learned.setting.robot != robot:
        raise OptionError(
            f"--cost: {path} is for the robot {learned.setting.robot!r}, not {robot!r}; give --robot "
            f"{learned.setting.robot}, or learn a cost for {robot} without --cost"
        )
    return learned


def check_cost_arm(path: Path, learned: LearnedCost, keypoints: Sequence[Keypoint], n_joints: int) -> None:
    """Raise OptionError if a cost is for another arm of the name, another link or another number of keypoints.

    keypoints, n_joints: of the arm that is to plan with it.
    """
    theirs, ours = learned.setting.keypoints, keypoints
    if learned.start.size != n_joints:
        raise OptionError(f"--cost: {path} is for an arm of {learned.start.size} joints; this one has {n_joints}")
    if len(theirs) != len(ours):
        raise OptionError(f"--cost: {path} is for {len(theirs)} keypoints; those of this film are {len(ours)}")
    if theirs[0].link != ours[0].link:
        raise OptionError(
            f"--cost: {path} is for a bottle on the link {theirs[0].link!r}, not {ours[0].link!r}; give --flange "
            f"{theirs[0].link}, or learn without --cost"
        )


def _together(args: Namespace) -> None:
    if args.source_rate and args.film.is_file() and not args.tracks:
        raise OptionError(f"--source-rate: {args.film} has its own times; the option is for pictures and --tracks")
    if args.end is not None and args.end <= args.start:
        raise OptionError(f"--end: must be after --start, {args.start:g} s, got {args.end:g} s")
    if args.dynamics and not args.detector:
        raise OptionError("--dynamics: needs --detector, the one through which the dynamics were learned")
    if args.recording and not args.dynamics:
        raise OptionError("--recording: needs --dynamics, learned from such recordings")
    if args.dynamics and args.robot not in (None, "iiwa") and not args.recording:
        raise OptionError("--robot: not with --dynamics, whose arm is that of --recording, or the iiwa in the scene")
    if args.dynamics and args.flange:
        raise OptionError("--flange: not with --dynamics, which were learned with what the arm held")
    if args.dynamics and args.object_size:
        raise OptionError("--object-size: not with --dynamics, which know no metres; give --scale")


def _sized(args: Namespace) -> None:
    """Raise OptionError where tracks do not give the length of the object in pixels, and no scale is given."""
    sources = {"--tracks": args.tracks, "--hand": args.hand, "--detector": args.detector}
    given = next((name for name, value in sources.items() if value), None)
    if given and args.object_size:
        raise OptionError(f"--object-size: {given} does not say how many pixels long the object is; give --scale")
    if given and args.scale is None:
        raise OptionError(
            f"{given}: needs --scale, the pixels of the arm's camera per pixel of the film, because it does not say "
            "how large the object is"
        )


def _within(args: Namespace, times: Array) -> None:
    """Raise OptionError if --start or --end is after the end of a film with frames at times (n,) [s], up to --end."""
    lasts = float(times[-1] + np.diff(times).max(initial=0.0))
    for name, given in (("--start", args.start), ("--end", args.end or 0.0)):
        if given > lasts + _ROUNDED:
            raise OptionError(
                f"{name}: {args.film} ends after {lasts:.2f} s, {given:g} s is later; give less, or leave {name} out"
            )


def _tracks_of(args: Namespace, film: Film) -> None:
    height, width = film.first().shape[:2]
    tracks = read_tracks(args.tracks, rate=args.source_rate, size=(width, height))
    with of_option("--tracks"):
        check_size(tracks, (width, height))
    if args.source_rate and not args.film.is_dir():
        _check_rate(args, film.times(), len(tracks.times))


def _check_rate(args: Namespace, times: Array, count: int) -> None:
    """Raise OptionError if `count` frames of tracks, of a film with frames at times (n,) [s], cannot have the rate."""
    own = own_rate(args.tracks)
    if own is not None and abs(own / args.source_rate - 1) > _SAME_RATE:
        raise OptionError(f"--source-rate: {args.tracks} has times of its own, at {own:.4g} frames a second")
    found = (len(times) - 1) / max(float(np.ptp(times)), 1e-9)
    if count <= len(times) and args.source_rate > (1 + _SAME_RATE) * found:  # more frames than those are interpolated
        raise OptionError(
            f"--source-rate: {args.film} has {found:.4g} frames a second, so {count} frames of tracks in it have no "
            f"{args.source_rate:g}; give the film's rate, or a lower one if the tracks leave frames out"
        )


def _arm_and_cost(args: Namespace) -> None:
    name = args.robot or "iiwa"
    with of_option("--robot"):
        robot = robot_called(name)
    if args.flange:
        with of_option("--flange"):
            robot.frame_id(args.flange)
    if args.cost:
        camera_cost(args.cost, name, args.steps)
