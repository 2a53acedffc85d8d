"""An arm's plan as a video, drawn without a display (extra `perception`)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from kpirl_ocp.ocp.models.robot import Robot
from kpirl_ocp.perception.data.encoding import write_video
from kpirl_ocp.perception.data.video import Frames
from kpirl_ocp.pictures import COLOURS, GREY, STYLE
from kpirl_ocp.types import Array
from kpirl_ocp.viewing.arm_motion import ArmMotion

_SIDE = 6.0  # [inch] at 100 dots per inch


def film_arm(path: str | Path, robot: Robot, joints: ArrayLike, rate: float, goal: ArrayLike | None = None) -> Path:
    """Write an .mp4 of the motion, seen from the side, and give its path back.

    Args:
        path: ending in .mp4.
        robot: the arm.
        joints: (T+1, n_joints) [rad].
        rate: steps per second [Hz].
        goal: keypoints (K, 3) or (3 K,) [m] to show as rings; None for none.

    Raises:
        ProblemError: shapes that do not fit the robot.
        EpisodeError: the file cannot be written.
    """
    motion = ArmMotion.of(robot, joints, rate)
    points = np.empty((0, 3)) if goal is None else np.asarray(goal, float).reshape(-1, 3)
    return write_video(path, _frames(motion, points), rate, codec="h264")


def _frames(motion: ArmMotion, goal: Array) -> Iterator[Frames]:
    with matplotlib.rc_context(dict(STYLE)):
        figure = Figure(figsize=(_SIDE, _SIDE), dpi=100)
        canvas = FigureCanvasAgg(figure)
        axes: Any = figure.add_subplot(projection="3d")
        for step in range(len(motion.times)):
            axes.clear()
            _draw(axes, motion, step, goal)
            canvas.draw()
            yield np.asarray(canvas.buffer_rgba())[:, :, :3].copy()


def _draw(axes: Any, motion: ArmMotion, step: int, goal: Array) -> None:
    lower, upper = motion.box()
    middle, half = (lower + upper) / 2, (upper - lower).max() / 2 + 0.05
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", title=f"t = {motion.times[step]:.1f} s")
    axes.set(**{f"{name}lim": (m - half, m + half) for name, m in zip("xyz", middle, strict=True)})
    axes.view_init(elev=18, azim=-70)
    axes.plot(*motion.skeletons[step].T, "-o", color=GREY, linewidth=5, markersize=6, solid_capstyle="round")
    for number, points in enumerate(motion.keypoints.transpose(1, 0, 2)):
        colour = COLOURS[number % len(COLOURS)]
        axes.plot(*points[: step + 1].T, color=colour, linewidth=1)
        axes.scatter(*points[step], color=colour, s=18, depthshade=False)
    if len(goal):
        axes.scatter(*goal.T, s=60, facecolors="none", edgecolors="black", depthshade=False)
