"""Train the dynamics of keypoints on recordings of the robot, seen through a trained detector.

The score is the NMSE on held-out trajectories, compared with that of persistence ("nothing moves").
"""

from argparse import ArgumentParser

from kpirl_ocp.cli.values import existing_directory, existing_file, one_of, whole

ACTIVATIONS = ("relu", "tanh", "softplus", "silu")


def add_options(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--detector", type=existing_file, required=True, help="card of a trained detector (detector.json)"
    )
    parser.add_argument(
        "--data", type=existing_directory, nargs="+", required=True, help="directories of recordings of the robot"
    )
    parser.add_argument(
        "--test", type=existing_directory, nargs="+", required=True, help="directories of held-out recordings"
    )
    parser.add_argument(
        "--augment",
        action="store_true",
        help="add reversed motions and noise; for arms at rest whenever the camera looks",
    )
    parser.add_argument("--activation", type=one_of(ACTIVATIONS), help=f"{', '.join(ACTIVATIONS)} (the first)")
    parser.add_argument("--steps", type=whole(1), help="steps that the loss predicts (default: 1)")
    parser.add_argument("--epochs", type=whole(1), help="training epochs (default: 300)")
    parser.add_argument("--ahead", type=whole(1), default=10, help="steps to predict in the test (default: 10)")
    parser.add_argument("--seed", type=whole(0), default=0, help="for weights and batches (default: 0)")
