"""Learn from a film what mattered, and do it with an arm."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from kpirl_ocp.cli.imitation.arm import BOTTLE_LENGTH, Arm, Scale, arm_for, other_starts
from kpirl_ocp.cli.imitation.checks import camera_cost, check, check_cost_arm, check_film
from kpirl_ocp.cli.imitation.drawing import draw_imitation, draw_learning, draw_paths, side_by_side
from kpirl_ocp.cli.imitation.execution import ALLOWED, Executed, execute, shortfall
from kpirl_ocp.cli.imitation.learned_dynamics import imitate
from kpirl_ocp.errors import DemonstrationError
from kpirl_ocp.irl.cases.cost_files import LearnedCost
from kpirl_ocp.irl.visual.camera_learning import camera_demonstration, learn_in_image
from kpirl_ocp.irl.visual.reach import check_reach
from kpirl_ocp.ocp.export.folder import export_c
from kpirl_ocp.perception.data.video import Frames
from kpirl_ocp.perception.detector.tracks import detector_tracks
from kpirl_ocp.perception.tracking.admission import check_steps, good_until, moving_part, refusal
from kpirl_ocp.perception.tracking.pictures import draw_object, evenly, track_film, track_sheet
from kpirl_ocp.perception.tracking.tracks import Tracks, read_tracks, write_tracks
from kpirl_ocp.perception.tracking.watch import (
    Film,
    as_taken,
    extent,
    find_object,
    follow_hand,
    follow_object,
    seen_at_rest,
)
from kpirl_ocp.reporting import said_if_interrupted, table, write_metrics
from kpirl_ocp.types import Array

_SHOWN = 8  # frames of the contact sheet
_LEARNED_FROM = 5  # starts, so that the cost suits others, too


def main(args: Namespace) -> int:
    """Watch, learn, plan, execute; 1 if an execution is off the demonstration by more than a tenth of the way."""
    check(args)
    film = _film(args).steadied()
    if film.camera:
        print(f"camera:  moves its picture by up to {film.camera.reach:.0f} pixels; steadied on the background")
    tracks, length = _watch(args, film)
    with said_if_interrupted(lambda: _kept(args.out)):
        return _imitate(args, film, tracks, length)


def _film(args: Namespace) -> Film:
    """The part of the film between --start and --end for which there are tracks."""
    film = Film(args.film, args.source_rate if args.film.is_dir() else None, args.start, args.end or np.inf)
    check_film(args, film)
    if not args.tracks:
        return film
    times = read_tracks(args.tracks, rate=args.source_rate, size=film.first().shape[1::-1]).times
    return replace(film, start=float(max(film.start, times[0])))


def _kept(out: Path) -> str:
    cost = f", the learned cost in {out / 'cost.json'}, for --cost" if (out / "cost.json").exists() else ""
    return f"the tracks are in {out / 'tracks.npz'}, for --tracks{cost}"


def _imitate(args: Namespace, film: Film, tracks: Tracks, length: float | None) -> int:
    """Learn and execute; length: of the object [pixels], where it is known."""
    played = replace(tracks, times=film.start + tracks.times)
    print(f"sheet:   {track_sheet(args.out / 'tracks.png', _played(film), played, evenly(_SHOWN, len(played.times)))}")
    print(f"tracks:  {track_film(args.out / 'tracks.mp4', _played(film), played)}")
    _admit(args, film, played)
    shown, part = _part(film, tracks)
    check_steps(part, args.steps)
    if args.dynamics:
        return imitate(args, part)
    steps = part.at_rate(args.steps / float(part.times[-1]))
    scale = Scale(args.scale, args.object_size, length)
    arm, displacements = arm_for(args.robot or "iiwa", args.flange, steps.positions, scale)
    print(f"scale:   {arm.scale:.3g} pixels of the arm's camera per pixel of the film{_why_smaller(arm)}")
    learned = _learn(args, arm, displacements, args.steps / float(part.times[-1]))
    starts = other_starts(arm, args.starts, args.seed)
    runs = [execute(arm, learned, displacements, start) for start in starts]
    _report(args, learned, runs)
    far = [i for i, run in enumerate(runs) if run.reached >= ALLOWED]
    for i in far:
        print(f"start {i + 1}: {shortfall(arm, displacements, starts[i], runs[i], reused=bool(args.cost))}")
    print(f"figure:  {draw_paths(args.out / 'paths.png', runs)}")
    print(f"picture: {draw_imitation(args.out / 'imitation.png', part, runs[0])}")
    print(f"film:    {side_by_side(args.out / 'imitation.mp4', shown, part, arm, runs[0])}")
    if args.export:
        print(f"C:       {_export(args.out / 'c', learned, arm)}")
    return 1 if far else 0


def _why_smaller(arm: Arm) -> str:
    """The end of the sentence on the scale."""
    return f"; the path of an object of {BOTTLE_LENGTH} m would leave its image" if arm.smaller else ""


def _watch(args: Namespace, film: Film) -> tuple[Tracks, float | None]:
    """Tracks of the demonstration, written to OUT, and the length of the object [pixels] where it is known."""
    length = None
    if args.tracks:
        tracks = seen_at_rest(film, read_tracks(args.tracks, rate=args.source_rate, size=film.first().shape[1::-1]))
    elif args.hand:
        tracks = follow_hand(film)
    elif args.detector:
        tracks = detector_tracks(film, args.detector)
    else:
        mask = find_object(film, args.box, args.points)
        print(f"object:  {draw_object(args.out / 'object.png', film.first(), mask)}")
        length = extent(mask)
        tracks = follow_object(film, mask)
    write_tracks(args.out / "tracks.npz", as_taken(film, tracks))
    return tracks, length


def _played(film: Film) -> Iterator[tuple[float, Frames]]:
    """Its frames at the times that a player shows, and that --start and --end mean."""
    return ((film.start + time, image) for time, image in film.frames())


def _admit(args: Namespace, film: Film, tracks: Tracks) -> None:
    """Raise DemonstrationError, with the picture that shows why, if there is nothing to learn from.

    tracks: at the times of `_played`.
    """
    found = refusal(tracks)
    if found is not None:
        picture = track_sheet(args.out / "refused.png", _played(film), tracks, found.frames)
        raise DemonstrationError(f"{found.reason} See {picture}.{_guess(args)}{_until(tracks)}")


def _until(tracks: Tracks) -> str:
    """The option that leaves out what is refused, if a part before that can be learned from."""
    end = good_until(tracks)
    return "" if end is None else f" Until {end:g} s it is seen for sure and moves: --end {end:g} takes that part."


def _guess(args: Namespace) -> str:
    """Advice on what was marked or is detected, or for a film in which nothing was."""
    if args.box or args.points:
        return f" What was marked is outlined in {args.out / 'object.png'}: if that is not the object, mark it again."
    if args.detector:
        return " A detector finds what it was trained on: to follow something else, leave --detector out."
    if args.tracks or args.hand:
        return ""
    return (
        f" Nothing was marked, so whatever moves was followed: if {args.out / 'object.png'} does not outline the "
        "object alone, read its place off that picture and give it (--box X0,Y0,X1,Y1 or --points X,Y)."
    )


def _part(film: Film, tracks: Tracks) -> tuple[Film, Tracks]:
    """The part of the film in which something moves."""
    start, end = moving_part(tracks)
    return replace(film, start=film.start + start, end=film.start + end), tracks.between(start, end)


def _learn(args: Namespace, arm: Arm, displacements: Array, rate: float) -> LearnedCost:
    """The cost, written to OUT, or that of --cost."""
    check_reach(arm.setting, arm.robot, camera_demonstration(arm.setting, arm.robot, arm.start, displacements))
    if args.cost:
        return _reuse(args.cost, arm, displacements)
    starts = other_starts(arm, _LEARNED_FROM, (args.seed, 1))  # none of those that are executed but the first
    demonstrations = [camera_demonstration(arm.setting, arm.robot, start, displacements) for start in starts]
    learning = learn_in_image(arm.setting, arm.robot, demonstrations, rate, args.iterations)
    learning.cost.write(args.out / "cost.json")
    print(f"\nIRL {learning.history}; the plan is off the demonstration by {learning.distance:.1%} of the way")
    print(f"cost:    {args.out / 'cost.json'}\nfigure:  {draw_learning(args.out / 'learning.png', learning)}")
    return learning.cost


def _reuse(path: Path, arm: Arm, displacements: Array) -> LearnedCost:
    """A cost of another film, for the goal of this one. Raises OptionError if it does not fit."""
    learned = camera_cost(path, arm.name, len(displacements) - 1)
    check_cost_arm(path, learned, arm.setting.keypoints, arm.robot.n_joints)
    displacement = (displacements[-1] - displacements[0]).ravel() / arm.setting.unit
    return replace(learned, setting=arm.setting, displacement=displacement)


def _report(args: Namespace, learned: LearnedCost, runs: list[Executed]) -> None:
    rows = [[f"start {i + 1}", run.planned, run.reached, f"{run.rate} Hz"] for i, run in enumerate(runs)]
    print("\n" + table(["relative distance to the path", "planned", "executed", "steps at"], rows) + "\n")
    results = {
        "planned": [run.planned for run in runs],
        "executed": [run.reached for run in runs],
        "rates": [run.rate for run in runs],
        "demonstrated rate": learned.rate,
    }
    print(f"numbers: {write_metrics(args.out, vars(args), results)}")


def _export(folder: Path, learned: LearnedCost, arm: Arm) -> Path:
    s0 = learned.setting.state(arm.robot, arm.start)
    example, preview = [(s0, learned.goal(s0))], learned.preview()
    problem = learned.problem(arm.robot)
    return export_c(problem, learned.solver, folder, psi=learned.psi, examples=example, preview=preview)
