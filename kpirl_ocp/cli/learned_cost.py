"""The learned cost that `kpirl evaluate` and `kpirl export` take."""

from __future__ import annotations

import shlex
from pathlib import Path

from kpirl_ocp.cli.sentences import of_option
from kpirl_ocp.errors import FileError
from kpirl_ocp.irl.cases.cost_files import LearnedCost
from kpirl_ocp.ocp.models import Robot


def cost_of_the_iiwa(path: Path, robot: Robot) -> LearnedCost:
    """The cost of a file that `kpirl learn` wrote. Raises OptionError if it is none, or is for something else."""
    with of_option("--cost"):
        learned = LearnedCost.read(path)
        setting = learned.setting
        if setting.robot != "iiwa" or setting.keypoints or setting.camera:
            command = shlex.join(["kpirl", "learn-video", "FILM", "--robot", setting.robot, "--cost", str(path)])
            raise FileError(
                f"{path} is for {setting.robot} as in a film, not for the iiwa's own keypoints: "
                f"use `{command}`, with --export for a controller in C."
            )
        needed = learned.problem(robot).n_parameters
        if learned.psi.size != needed:
            raise FileError(f"{path} holds {learned.psi.size} numbers psi, and its cost has {needed}.")
    return learned
