"""Make a keypoint detector robust to its surroundings, from one that was trained in front of a white wall.

It is shown rendered frames in random surroundings (walls, colours, light, size, noise, compression), and learns to find
the keypoints where its teacher finds them in front of the white wall, without labels. After an interruption, the same
command resumes from its last checkpoint.
"""

from argparse import ArgumentParser

from kpirl_ocp.cli.values import MOST_PROCESSES, existing_directory, existing_file, real, whole


def add_options(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--teacher", type=existing_file, required=True, help="card of the detector to learn from")
    parser.add_argument(
        "--test", type=existing_directory, nargs="*", default=[], help="directories of held-out clips to score on"
    )
    parser.add_argument(
        "--clips", type=real(above=0, most=1000), default=1.0, help="share of the usual 410 clips (default: 1)"
    )
    parser.add_argument("--steps", type=whole(1), default=400, help="training steps (default: 400)")
    parser.add_argument("--batch", type=whole(1), default=48, help="frames per step (default: 48)")
    parser.add_argument("--seed", type=whole(0), default=0, help="for clips and batches (default: 0)")
    parser.add_argument(
        "--device", default="auto", help="device of torch: auto (a GPU if there is one), cpu, cuda, ..."
    )
    parser.add_argument("--threads", type=whole(1, MOST_PROCESSES), default=2, help="threads of torch (default: 2)")
