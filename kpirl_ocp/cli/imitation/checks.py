"""Options of `kpirl learn-video`, checked before the film is opened: those that exclude each other, arms and files."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from kpirl_ocp.cli.imitation import learned_dynamics
from kpirl_ocp.cli.sentences import of_option
from kpirl_ocp.errors import OptionError
from kpirl_ocp.irl.cases.cost_files import LearnedCost, robot_called
from kpirl_ocp.perception.detector.detector import KeypointDetector
from kpirl_ocp.perception.hands.landmarks import check_hands
from kpirl_ocp.perception.tracking.objects import check_box, check_points
from kpirl_ocp.perception.tracking.tracks import read_tracks
from kpirl_ocp.perception.tracking.watch import LONGEST, Film


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


def check_places(args: Namespace, film: Film) -> None:
    """Raise OptionError if --box or --points are not in the film's first frame."""
    if args.box:
        with of_option("--box"):
            check_box(film.first(), args.box)
    if args.points:
        with of_option("--points"):
            check_points(film.first(), args.points)


def camera_cost(path: Path, robot: str, steps: int) -> LearnedCost:
    """The cost of a file, in a camera's image. Raises OptionError if it is for another robot or number of steps."""
    with of_option("--cost"):
        learned = LearnedCost.read(path)
    if learned.setting.camera is None:
        raise OptionError(f"--cost: {path} is for keypoints in space; a film needs keypoints in a camera's image")
    if learned.horizon != steps:
        raise OptionError(f"--cost: {path} has T = {learned.horizon}, --steps says {steps}")
    if learned.setting.robot != robot:
        raise OptionError(f"--cost: {path} is for the robot {learned.setting.robot!r}, not {robot!r}")
    return learned


def _together(args: Namespace) -> None:
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


def _arm_and_cost(args: Namespace) -> None:
    name = args.robot or "iiwa"
    with of_option("--robot"):
        robot = robot_called(name)
    if args.flange:
        with of_option("--flange"):
            robot.frame_id(args.flange)
    if args.cost:
        camera_cost(args.cost, name, args.steps)
