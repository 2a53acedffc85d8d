"""Collect camera data: for the keypoint detector, for the dynamics model, or as demonstrations.

keypoints: the arm goes to a random posture, and then only its last joint moves; for the detector.
sines, placing: for the dynamics of reaching and of placing.
reaching: demonstrations by the robot.   hand-placing, hand-wandering: videos of a hand that holds the bottle.

After an interruption, the same command resumes where it stopped. For test data, collect with another --seed.
"""

import math
from argparse import ArgumentParser

from kpirl_ocp.cli.values import MOST_PROCESSES, one_of, real, whole
from kpirl_ocp.sizes import LONGEST

MOTIONS = ("keypoints", "sines", "placing", "reaching", "hand-placing", "hand-wandering")
TURN = round(math.tau, 4)  # [rad]
SETTINGS = {  # name: type and help; each motion has its own defaults
    "rate": (whole(1, 1000), "frames per second"),
    "surroundings": (
        whole(0, 3),
        "0: white wall, 1: plain wall of any colour, 2: clutter, light, shake, noise and H.264, 3: any",
    ),
    "frames": (whole(2, LONGEST), "frames of a sequence (keypoints)"),
    "swing": (real(least=0, most=TURN), "largest amplitude of the last joint [rad] (keypoints)"),
    "off_plane": (
        real(least=0, most=TURN),
        "largest angle of joints 1, 3 and 5 from the camera's plane [rad] (keypoints)",
    ),
    "steps": (whole(1, LONGEST), "actions of an episode (sines, placing, reaching)"),
    "amplitude": (real(least=0, most=TURN), "largest amplitude of joints 2, 4 and 6 [rad] (sines)"),
    "noise": (real(least=0, most=TURN), "standard deviation added to the actions of joints 2, 4 and 6 [rad] (placing)"),
    "others": (real(least=0, most=TURN), "noise of the other joints [rad] (sines, placing)"),
    "seconds": (real(least=0.1, most=3600), "length of a clip (hand-placing, hand-wandering)"),
    "tremor": (real(least=0, most=1), "standard deviation of the hand's wander [m] (hand-placing, hand-wandering)"),
}


def add_options(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("motion", type=one_of(MOTIONS), metavar="MOTION", help=", ".join(MOTIONS))
    parser.add_argument("--episodes", type=whole(1, LONGEST), help="number of episodes (default: the paper's)")
    parser.add_argument("--seed", type=whole(0), default=0, help="(default: 0)")
    parser.add_argument("--jobs", type=whole(1, MOST_PROCESSES), default=2, help="processes (default: 2)")
    group = parser.add_argument_group("settings of the motion (default: the paper's)")
    for name, (kind, text) in SETTINGS.items():
        group.add_argument(f"--{name.replace('_', '-')}", type=kind, help=text)
