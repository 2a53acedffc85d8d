"""Imitate an expert's cart-pole in PyTorch: the published imitation task of DiffMPC (Adabag et al., 2025).

The expert plans 100 Euler steps of 0.05 s from 32 starting states with state weights [1, 2, 1.5, 1] and 0.05 on the
force. The weights are to be found from the expert's forces alone, from 20 published starting guesses:

    min_w  mean (u*(w) - u_expert)^2 / 2,      u*(w) the forces that are optimal for the weights w

There are many local minima. As published, the expert's solver begins at a straight line of states from the start to the
goal, the learner's at the expert's plan.
"""

from kpirl_ocp.cli.main import experiment
from kpirl_ocp.cli.parser import Parser
from kpirl_ocp.cli.values import whole


def add_options(parser: Parser) -> None:
    parser.add_argument("--starts", type=whole(1, 20), default=20, help="how many of the 20 (default: all)")


if __name__ == "__main__":
    experiment(str(__doc__), add_options, "experiments.imitate_expert")
