"""Watch a person place a bottle, learn what mattered, plan, and do it with the simulated arm."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from kpirl_ocp import figures
from kpirl_ocp.assets import shipped_model
from kpirl_ocp.episodes import KeypointTrack
from kpirl_ocp.irl.cases.planar_arm import planar_dynamics
from kpirl_ocp.irl.visual.closed_loop import Execution, KeypointController
from kpirl_ocp.irl.visual.demonstrations import positions, transferred_demonstration
from kpirl_ocp.irl.visual.learning import COSTS, InnerLoop, LearnedPlan, learn_unrolled
from kpirl_ocp.ocp.models import NetworkDynamics
from kpirl_ocp.perception.data.encoding import write_video
from kpirl_ocp.perception.data.video import Frames, sample_indices
from kpirl_ocp.perception.detector.detector import KeypointDetector
from kpirl_ocp.perception.detector.track_images import image_strips, keypoint_paths, with_tracks
from kpirl_ocp.perception.plant.camera_plant import CameraPlant
from kpirl_ocp.perception.plant.starts import RATE, PlacingStarts, placing_starts
from kpirl_ocp.perception.scene.hand import RATE as FILM_RATE
from kpirl_ocp.perception.scene.hand import HandScene, placing_path
from kpirl_ocp.perception.scene.scene import Scene
from kpirl_ocp.reporting import table, write_metrics
from kpirl_ocp.types import Array, Demonstration

INNER = InnerLoop(10, 1e-3)  # chosen by scripts/reproduce_paper.py on validation demonstrations
DEMONSTRATION_RATE = 5  # [Hz]; two seconds are the ten steps of the plan
FRAME_RATE = 2  # [Hz] of the video


@dataclass(frozen=True, eq=False)
class Clip:
    """A person's demonstration: frames (T+1, H, W, 3), detected keypoints, places of the bottle (T+1, 2) [pixels]."""

    images: Frames
    track: KeypointTrack
    places: Array


def watch(detector: KeypointDetector, seed: int) -> Clip:
    """Film a person who places the bottle."""
    path = placing_path(np.random.default_rng(seed))
    with HandScene() as scene:
        frames = [scene.look(place) for place in path[sample_indices(len(path), FILM_RATE, DEMONSTRATION_RATE)]]
    images = np.array([frame.rgb for frame in frames])
    track = KeypointTrack(detector.detect(images), np.arange(len(images)) / DEMONSTRATION_RATE)
    return Clip(images, track, np.array([frame.place for frame in frames]))


def act(
    detector: KeypointDetector, dynamics: NetworkDynamics, learned: LearnedPlan, starts: PlacingStarts, goal: Array
) -> tuple[Execution, CameraPlant]:
    """Plan, take the first action, look, plan again, to the end."""
    controller = KeypointController.build(dynamics, learned.cost)
    with Scene(rate=RATE) as scene:
        scene.reset(starts.joints[0])
        plant = CameraPlant(scene, detector)
        return controller.run(plant, goal), plant


def draw(
    learned: LearnedPlan, clip: Clip, demonstration: Demonstration, done: Execution, robot: Frames, out: Path
) -> list[Path]:
    """Person and robot side by side; losses, weights and paths."""
    shown = [0, len(robot) // 2, len(robot) - 1]
    columns = {
        "person": (clip.images[shown], clip.track.keypoints[shown], positions(clip.track.keypoints[-1])),
        "robot": (robot[shown], done.keypoints[shown], demonstration.context),
    }
    return [
        figures.save(image_strips(columns, shown), out / "placing.png"),
        figures.save(draw_learning(learned, demonstration, done, robot.shape[1]), out / "learning.png"),
    ]


def draw_learning(learned: LearnedPlan, demonstration: Demonstration, done: Execution, size: int) -> Figure:
    """Losses, weights, and the paths of the keypoints."""
    figure, (loss_axes, weight_axes, path_axes) = figures.new_figure(1, 3)
    loss_axes.semilogy(learned.losses, color=figures.COLOURS[0])
    loss_axes.set(xlabel="outer iteration", ylabel="IRL loss [(image half-widths)²]", title="training loss")
    loss_axes.grid(alpha=0.3, which="both")
    figures.weights(weight_axes, learned.cost.weights, "learned weights", dimensions=2)
    keypoint_paths(path_axes, demonstration.observations, positions(done.keypoints), size)
    return figure


def main(args: Namespace) -> None:
    """Watch, learn, act."""
    torch.set_num_threads(1)
    out = args.out
    detector = KeypointDetector.load(shipped_model("detector"))
    dynamics = planar_dynamics(shipped_model("placing"))
    print("watch: a person places a bottle", flush=True)
    clip = watch(detector, args.seed)
    starts = placing_starts(detector, clip.places, np.random.default_rng([args.seed, 7]))
    demonstration = transferred_demonstration(dynamics, clip.track, starts.keypoints, starts.joints[0])
    print(f"learn: {args.cost} cost, {args.iterations} outer iterations", flush=True)
    rng = np.random.default_rng(args.seed)
    learned = learn_unrolled(dynamics, [demonstration], COSTS[args.cost], INNER, args.iterations, rng)
    print("act:   plan, move, look, plan again", flush=True)
    done, plant = act(detector, dynamics, learned, starts, demonstration.context)

    robot = np.array(plant.images)
    start, end = (np.linalg.norm(plant.places[i] - starts.goal) for i in (0, -1))
    missed = (positions(done.keypoints) - demonstration.context) * robot.shape[1] / 2  # [pixels]
    away = np.linalg.norm(missed.reshape(len(missed), -1, 2), axis=-1).mean(axis=1)
    rows = [["keypoints (mean), as seen", *map(float, away[[0, -1]])], ["bottle, true", float(start), float(end)]]
    print("\n" + table(["distance to the goal [px]", "at the start", "at the end"], rows))
    results = {"losses": learned.losses, "keypoints_px": away, "bottle_px": [start, end]}
    results |= {"weights": learned.cost.weights, "actions": done.actions}
    print(f"\nIRL loss {learned.losses[0]:.3g} to {learned.losses.min():.3g} in {learned.seconds:.1f} s")
    print(f"numbers: {write_metrics(out, vars(args), results)}")
    for path in draw(learned, clip, demonstration, done, robot, out):
        print(f"figure:  {path}")
    both = [with_tracks(clip.images, clip.track.keypoints), with_tracks(robot, done.keypoints)]
    video = write_video(out / "placing.mp4", np.concatenate(both, axis=2), FRAME_RATE, codec="h264")
    print(f"video:   {video}")
