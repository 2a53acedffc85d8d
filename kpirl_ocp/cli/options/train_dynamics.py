"""Train the dynamics of keypoints on recordings of the robot, seen through a trained detector.

Scores are NMSE on held-out trajectories, beside persistence ("nothing moves").
"""

from argparse import ArgumentParser

from kpirl_ocp.cli.values import existing_directory, existing_file, one_of, whole

ACTIVATIONS = ("relu", "tanh", "softplus", "silu")


def add_options(parser: ArgumentParser) -> None:
    """Declare them."""
    parser.add_argument("--detector", type=existing_file, required=True, help="card of a trained one (detector.json)")
    parser.add_argument(
        "--data", type=existing_directory, nargs="+", required=True, help="directories of recordings of the robot"
    )
    parser.add_argument(
        "--test", type=existing_directory, nargs="+", required=True, help="directories of held-out recordings"
    )
    parser.add_argument(
        "--augment", action="store_true", help="motions backwards, too, and noise; for arms that rest at every look"
    )
    parser.add_argument("--activation", type=one_of(ACTIVATIONS), help=f"{', '.join(ACTIVATIONS)} (the first)")
    parser.add_argument("--steps", type=whole(1), help="predicted in the loss (default: 1)")
    parser.add_argument("--epochs", type=whole(1), help="(default: 300)")
    parser.add_argument("--ahead", type=whole(1), default=10, help="steps to predict in the test (default: 10)")
    parser.add_argument("--seed", type=whole(0), default=0, help="of weights and batches (default: 0)")
