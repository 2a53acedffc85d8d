"""An arm's plan in the browser, with a time slider, by viser (extra `viewer`)."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import viser
from numpy.typing import ArrayLike

from kpirl_ocp.ocp.models.robot import Robot
from kpirl_ocp.pictures import COLOURS
from kpirl_ocp.types import Array
from kpirl_ocp.viewing.arm_motion import ArmMotion


def show_arm(
    robot: Robot, joints: ArrayLike, rate: float, goal: ArrayLike | None = None, *, port: int = 8080
) -> ArmViewer:
    """Serve the motion at http://localhost:PORT until `stop()` or the end of the program.

    Args:
        robot: the arm.
        joints: (T+1, n_joints) [rad].
        rate: steps per second [Hz] at which it is played.
        goal: keypoints (K, 3) or (3 K,) [m] to show as grey balls; None for none.
        port: of the server; the next free one is taken.

    Raises:
        ProblemError: shapes that do not fit the robot.
    """
    return ArmViewer(ArmMotion.of(robot, joints, rate), goal, port)


class ArmViewer:
    """A running viewer; `server` is viser's, to add things of one's own to its scene."""

    def __init__(self, motion: ArmMotion, goal: ArrayLike | None, port: int) -> None:
        self.motion = motion
        self.server = viser.ViserServer(port=port, verbose=False)
        scene = self.server.scene
        scene.set_up_direction("+z")
        lower, upper = motion.box()
        middle, size = (lower + upper) / 2, float((upper - lower).max())
        self.server.initial_camera.look_at = tuple(middle)
        self.server.initial_camera.position = tuple(middle + size * np.array([0.6, -1.6, 0.6]))
        scene.add_grid("floor", width=2.0, height=2.0, cell_size=0.1)
        for number in range(motion.keypoints.shape[1]):
            path, colour = motion.keypoints[:, number], _rgb(COLOURS[number % len(COLOURS)])
            if len(path) > 1:
                scene.add_line_segments(
                    f"paths/{number}",
                    np.stack([path[:-1], path[1:]], axis=1),
                    colors=colour,
                    thickness=2.0,
                    thickness_units="screen",
                )
        if goal is not None:
            for number, point in enumerate(np.asarray(goal, float).reshape(-1, 3)):
                scene.add_icosphere(f"goal/{number}", 0.02, color=(40, 40, 40), opacity=0.5, position=tuple(point))
        last = len(motion.times) - 1
        self.slider = self.server.gui.add_slider("step", 0, max(last, 1), 1, 0)
        self._play = self.server.gui.add_button("play")
        self.slider.on_update(lambda _: self._draw(int(self.slider.value)))
        self._play.on_click(lambda _: self.play())
        self.show(0)

    @property
    def url(self) -> str:
        """Where to look."""
        return f"http://localhost:{self.server.get_port()}"

    def show(self, step: int) -> None:
        """The arm at one time step, where the slider then stands."""
        self.slider.value = min(step, len(self.motion.times) - 1)
        self._draw(self.slider.value)

    def _draw(self, step: int) -> None:
        step = min(step, len(self.motion.times) - 1)  # a motion of one step has a slider of two
        skeleton, keypoints = self.motion.skeletons[step], self.motion.keypoints[step]
        lines = np.stack([skeleton[:-1], skeleton[1:]], axis=1)
        self.server.scene.add_line_segments(
            "arm", lines, colors=_rgb("#555555"), thickness=8.0, thickness_units="screen"
        )
        dots = (("joints", skeleton[:-1], 0.035, ("#222222",)), ("keypoints", keypoints, 0.025, COLOURS))
        for name, points, size, palette in dots:
            colours = np.array([_rgb(palette[i % len(palette)]) for i in range(len(points))])
            self.server.scene.add_point_cloud(name, points, colours, point_size=size, point_shape="circle")

    def play(self) -> None:
        """The whole motion once, at its rate."""
        pauses = np.diff(self.motion.times, append=self.motion.times[-1])
        for step, pause in enumerate(pauses):
            self.slider.value = step
            time.sleep(pause)

    def stop(self) -> None:
        """End the server."""
        self.server.stop()


def _rgb(colour: str) -> Any:
    values: Array = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
    return tuple(int(value) for value in values)
