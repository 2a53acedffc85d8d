"""Imitation with learned dynamics: one detector sees the person and the arm, and a network says how its keypoints move.

The arm is that of a recording (the dynamics were learned from such), for which a plan is written; without a recording
it is the iiwa of the scene, which also does it.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from kpirl_ocp import figures
from kpirl_ocp.cli.sentences import of_option
from kpirl_ocp.episodes import KeypointTrack, stored, write_episode
from kpirl_ocp.errors import OptionError
from kpirl_ocp.irl.cases.cost_files import robot_called
from kpirl_ocp.irl.cases.planar_arm import planar_dynamics
from kpirl_ocp.irl.learning.learn import LearningResult
from kpirl_ocp.irl.visual.camera_learning import FIRST_WEIGHTS, cheapest, learn_on, path_distance
from kpirl_ocp.irl.visual.closed_loop import KeypointController
from kpirl_ocp.irl.visual.demonstrations import positions, transferred_demonstration
from kpirl_ocp.irl.visual.learning import CONVERGED
from kpirl_ocp.irl.visual.planning_costs import (
    ArmLimits,
    PlanningCost,
    all_weights,
    limited_network_ocp,
    read_planning_cost,
    write_planning_cost,
)
from kpirl_ocp.ocp.export.folder import export_c
from kpirl_ocp.ocp.models.dynamics_files import load_dynamics
from kpirl_ocp.ocp.models.keypoint_costs import KeypointCost, TimeDependent
from kpirl_ocp.ocp.models.keypoint_dynamics import NetworkDynamics
from kpirl_ocp.perception.data.recordings import read_arm_film
from kpirl_ocp.perception.detector.detector import KeypointDetector
from kpirl_ocp.perception.detector.keypoints import to_pixels
from kpirl_ocp.perception.detector.track_images import keypoint_paths
from kpirl_ocp.perception.plant.camera_plant import CameraPlant
from kpirl_ocp.perception.plant.starts import placing_starts
from kpirl_ocp.perception.scene.camera import Camera
from kpirl_ocp.perception.scene.scene import Scene
from kpirl_ocp.perception.tracking.tracks import Tracks
from kpirl_ocp.reporting import table, write_metrics
from kpirl_ocp.types import Array, Demonstration, Solution

_SIDE = Camera().height  # [pixels]
_OTHERS = 2  # starts that the cost is learned from beside the first, so that it suits others, too


@dataclass(frozen=True, eq=False)
class SeenArm:
    """An arm at rest as the detector sees it: keypoints (K, 3) and joints (n_joints,) [rad]."""

    keypoints: Array
    joints: Array


@dataclass(frozen=True, eq=False)
class Plan:
    """A plan of T steps as a file: keypoints (T+1, K, 2) [half an image], joints (T+1, n_joints) and actions [rad]."""

    keypoints: Array = stored("observation.keypoints", np.float64, "T+1", "K", 2)
    joints: Array = stored("observation.state", np.float64, "T+1", "n_joints")
    actions: Array = stored("action", np.float64, "T", "n_joints")
    times: Array = stored("timestamp", np.float64, "T+1")


def check(args: Namespace) -> None:
    """Raise the error of the dynamics, recording, robot or cost that does not fit the others."""
    with of_option("--dynamics"):
        dynamics = _dynamics(args)
        _rate(dynamics)
    with of_option("--robot"):
        _limits(args, dynamics)
    if args.recording:
        with of_option("--recording"):
            read_arm_film(args.recording)
    if args.cost:
        _known_cost(args, dynamics)


def imitate(args: Namespace, tracks: Tracks) -> int:
    """Learn, plan and, in the scene, execute; 1 if the path is off the demonstration by more than a tenth of the way.

    Raises:
        ProblemError: person and arm have different numbers of keypoints.
        SolveError: there is no plan from a start.
    """
    detector = KeypointDetector.load(args.detector)
    dynamics = _dynamics(args)
    person = in_half_images(tracks, args.steps, 1.0 if args.scale is None else args.scale)
    arms = [_recorded(detector, args.recording)] if args.recording else _in_scene(detector, person, args)
    demonstrations = [transferred_demonstration(dynamics, person, arm.keypoints, arm.joints) for arm in arms]
    demonstrations, others = demonstrations[: args.starts], demonstrations[args.starts :]
    cost, history = _cost(args, dynamics, [demonstrations[0], *others])
    controller = KeypointController.build(dynamics, cost)
    plans = plans_from(controller, demonstrations)
    files = [_as_file(plan, dynamics) for plan in plans]
    paths = [plan.keypoints.reshape(len(plan.keypoints), -1) for plan in files]
    done = [] if args.recording else [_execute(detector, plan.joints, _rate(dynamics)) for plan in files]
    shown = [demonstration.observations for demonstration in demonstrations]
    planned, executed = (list(map(path_distance, ways, shown)) for ways in (paths, done))
    write_episode(args.out / "plan.npz", files[0])
    print(f"plan:    {args.out / 'plan.npz'}")
    print(f"figure:  {_draw(args.out / 'paths.png', demonstrations, done or paths)}")
    _report(args, cost, history, planned, executed)
    if args.export:
        print(f"C:       {_export(args.out / 'c', controller, demonstrations[0])}")
    return 0 if all(distance < 0.1 for distance in executed or planned) else 1


def _export(folder: Path, controller: KeypointController, first: Demonstration) -> Path:
    """The controller as C, with the start and the goal of the first demonstration as its example."""
    cost = controller.cost
    preview = all_weights(cost.horizon).preview(cost.horizon)
    example = [(first.s0, first.context)]
    return export_c(controller.problem, CONVERGED, folder, psi=cost.psi, examples=example, preview=preview)


def plans_from(controller: KeypointController, demonstrations: Sequence[Demonstration]) -> list[Solution]:
    """A plan from the start of each: the cheaper of those from no action, and from the plan from the first start.

    Raises SolveError if there is none from the first start, or neither of the two.
    """
    first = controller.plan(demonstrations[0].s0, demonstrations[0].context).raise_if_failed()
    plans = [first]
    for demo in demonstrations[1:]:
        both = [controller.plan(demo.s0, demo.context, guess=guess) for guess in (None, first)]
        plans.append(cheapest(both).raise_if_failed())
    return plans


def _dynamics(args: Namespace) -> NetworkDynamics:
    return load_dynamics(args.dynamics) if args.recording else planar_dynamics(args.dynamics)


def _cost(
    args: Namespace, dynamics: NetworkDynamics, demonstrations: Sequence[Demonstration]
) -> tuple[PlanningCost, LearningResult | None]:
    """Learned time-dependent weights, written to OUT; or the cost of --cost.

    A cost means the same times any factor: where the effort weight was learned, too, L-BFGS went along it without end.
    """
    if args.cost:
        return _known_cost(args, dynamics), None
    horizon = demonstrations[0].horizon
    family = KeypointCost(TimeDependent(), effort=1.0, positivity="softplus")
    limits = _limits(args, dynamics)
    problem = limited_network_ocp(dynamics, family, horizon, limits)
    psi0 = family.initial(horizon, dynamics.n_z, FIRST_WEIGHTS)
    history = learn_on(problem, demonstrations, psi0, args.iterations)
    cost = replace(PlanningCost.of(family, history.psi, horizon, dynamics.n_z, CONVERGED), limits=limits)
    print(f"cost:    {write_planning_cost(args.out / 'cost.json', cost, dynamics)}")
    return cost, history


def _known_cost(args: Namespace, dynamics: NetworkDynamics) -> PlanningCost:
    """That of --cost. Raises OptionError if it is for another number of steps or another robot."""
    with of_option("--cost"):
        cost = read_planning_cost(args.cost, dynamics)
    if cost.horizon != args.steps:
        raise OptionError(f"--cost: {args.cost} has T = {cost.horizon}, --steps says {args.steps}")
    if args.robot and cost.limits and cost.limits.robot != args.robot:
        raise OptionError(f"--cost: {args.cost} is for the robot {cost.limits.robot!r}, not {args.robot!r}")
    return cost


def _limits(args: Namespace, dynamics: NetworkDynamics) -> ArmLimits | None:
    """The arm and its limits; None for recordings of an arm that is not named."""
    if args.robot is None and args.recording:
        return None
    name = args.robot or "iiwa"
    robot = robot_called(name)
    if robot.n_joints != dynamics.n_joints:
        raise OptionError(f"--robot: {name} has {robot.n_joints} joints, the dynamics have {dynamics.n_joints}")
    lower, upper = (tuple(row.tolist()) for row in robot.joint_limits)
    return ArmLimits(name, lower, upper)


def _rate(dynamics: NetworkDynamics) -> float:
    """[Hz] of the steps."""
    if dynamics.rate is None:
        raise OptionError("--dynamics: the card does not say the rate of its steps")
    return dynamics.rate


def in_half_images(tracks: Tracks, steps: int, scale: float) -> KeypointTrack:
    """The tracks at steps + 1 times in units of the detector: the largest square in the middle is 2 wide.

    scale: of the displacements.
    """
    part = tracks.at_rate(steps / float(tracks.times[-1]))
    width, height = part.size
    places = (part.positions - np.array([width, height]) / 2) / (min(width, height) / 2)
    places = places[0] + scale * (places - places[0])
    return KeypointTrack(np.concatenate([places, part.confidence[..., None]], axis=-1), part.times)


def _recorded(detector: KeypointDetector, path: Path) -> SeenArm:
    """The arm in the first frame of a recording."""
    film = read_arm_film(path)
    return SeenArm(detector.detect(film.images[:1])[0], film.joints[0])


def _in_scene(detector: KeypointDetector, person: KeypointTrack, args: Namespace) -> list[SeenArm]:
    """The iiwa with its keypoints where the person's began, other starts near there, and those to learn from."""
    places, rng = _middles(person.keypoints), np.random.default_rng([args.seed, 7])
    off = _middles(placing_starts(detector, places, rng).keypoints) - places[0]  # keypoints are not the bottle's middle
    count = args.starts + (0 if args.cost else _OTHERS)
    starts = [placing_starts(detector, places - off, rng) for _ in range(count)]
    return [SeenArm(start.keypoints, start.joints[0]) for start in starts]


def _middles(keypoints: Array) -> Array:
    """(..., 2) middles of keypoints (..., K, 3) [pixels of the scene's camera]."""
    return to_pixels(keypoints.mean(axis=-2), _SIDE)


def _execute(detector: KeypointDetector, joints: Array, rate: float) -> Array:
    """The keypoints (T+1, n_z) that are seen while the arm in the scene follows joints (T+1, n_joints) [rad]."""
    with Scene(rate=round(rate)) as scene:
        scene.reset(joints[0])
        plant = CameraPlant(scene, detector)
        sights = [plant.look()]
        for target in joints[1:]:
            plant.act(target - sights[-1].joints)
            sights.append(plant.look())
    return positions([sight.keypoints for sight in sights])


def _as_file(plan: Solution, dynamics: NetworkDynamics) -> Plan:
    n_z, n_q = dynamics.n_z, dynamics.n_joints
    return Plan(
        keypoints=plan.states[:, :n_z].reshape(len(plan.states), -1, 2),
        joints=plan.states[:, n_z : n_z + n_q],
        actions=plan.actions,
        times=np.arange(len(plan.states)) / _rate(dynamics),
    )


def _draw(path: Path, demonstrations: list[Demonstration], paths: list[Array]) -> Path:
    """The demonstrated paths and those of the arm, one panel per start."""
    figure, axes = figures.new_figure(1, len(paths), height=4.0)
    for axis, demo, done in zip(np.atleast_1d(axes), demonstrations, paths, strict=True):
        keypoint_paths(axis, demo.observations, done, _SIDE)
    return figures.save(figure, path)


def _report(
    args: Namespace, cost: PlanningCost, history: LearningResult | None, planned: list[float], executed: list[float]
) -> None:
    rows = [[f"start {i + 1}", far, executed[i] if executed else "-"] for i, far in enumerate(planned)]
    print(f"\nIRL {history}\n" if history else "")
    print(table(["relative distance to the path", "planned", "executed"], rows) + "\n")
    results = {"planned": planned, "executed": executed, "losses": history.losses if history else []}
    results |= {"weights": cost.weights, "efforts": cost.efforts}
    print(f"numbers: {write_metrics(args.out, vars(args), results)}")
