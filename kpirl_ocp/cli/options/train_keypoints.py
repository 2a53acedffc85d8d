"""Train the keypoint detector on camera data without labels, and score it on data it has not seen.

After an interruption, the same command resumes from its last checkpoint. Presets: tiny (for tests), default, full (the
paper's scale), minderer (the published losses alone).
"""

from argparse import ArgumentParser

from kpirl_ocp.cli.values import MOST_PROCESSES, existing, existing_directory, existing_file, one_of, whole

PRESETS = ("tiny", "default", "full", "minderer")


def add_options(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--data", type=existing_directory, required=True, help="directory of clips (`kpirl collect keypoints`)"
    )
    parser.add_argument("--videos", type=existing, nargs="*", default=[], help="more clips: videos, or directories")
    parser.add_argument(
        "--test", type=existing_directory, nargs="*", default=[], help="directories of held-out clips to score on"
    )
    parser.add_argument("--preset", type=one_of(PRESETS), default="default", help=", ".join(PRESETS))
    parser.add_argument("--steps", type=whole(1), help="training steps (default: the preset's)")
    parser.add_argument("--seed", type=whole(0), default=0, help="for weights and batches (default: 0)")
    parser.add_argument(
        "--start", type=existing_file, help="card of a trained detector of the same preset, to continue from"
    )
    parser.add_argument(
        "--device", default="auto", help="device of torch: auto (a GPU if there is one), cpu, cuda, ..."
    )
    parser.add_argument("--threads", type=whole(1, MOST_PROCESSES), default=2, help="threads of torch (default: 2)")
