"""An arm's plan as a recording for the Rerun viewer (extra `rerun`): `rerun plan.rrd`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
from numpy.typing import ArrayLike

from kpirl_ocp.ocp.models.robot import Robot
from kpirl_ocp.types import Array
from kpirl_ocp.viewing.arm_motion import ArmMotion


def write_rerun(path: str | Path, robot: Robot, joints: ArrayLike, rate: float, goal: ArrayLike | None = None) -> Path:
    """Write the motion, its keypoints and its joint positions over time, and give the path back.

    Args:
        path: ending in .rrd.
        robot: the arm.
        joints: (T+1, n_joints) [rad].
        rate: steps per second [Hz].
        goal: keypoints (K, 3) or (3 K,) [m]; None for none.

    Raises:
        ProblemError: shapes that do not fit the robot.
    """
    motion, theta = ArmMotion.of(robot, joints, rate), np.asarray(joints, float)
    with rr.RecordingStream("kpirl_ocp") as stream:
        stream.save(str(path))
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        if goal is not None:
            points: Array = np.asarray(goal, float).reshape(-1, 3)
            stream.log("world/goal", rr.Points3D(points, radii=0.02), static=True)
        for step, moment in enumerate(motion.times):
            stream.set_time("time", duration=float(moment))
            stream.log("world/arm", rr.LineStrips3D([motion.skeletons[step]], radii=0.015))
            stream.log("world/keypoints", rr.Points3D(motion.keypoints[step], radii=0.012))
            stream.log("joints", rr.Scalars(theta[step]))
        stream.flush()
    return Path(path)
