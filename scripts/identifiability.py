"""Are the intervals of learned weights honest, and does asking for the right demonstration pay?

On the reaching task of the simulation study (iiwa, exact kinematics, psi = the logarithm of nine weights, effort 1),
with demonstrations that are plans for known weights, seen with noise:

coverage: how many of the 90 % intervals hold the true value.
design: the error of learned weights over the number of demonstrations, the next one drawn at random or the one that is
    expected to teach most.
"""

from kpirl_ocp.cli.main import experiment
from kpirl_ocp.cli.parser import Parser
from kpirl_ocp.cli.values import MOST_DEMONSTRATIONS, real, whole


def add_options(parser: Parser) -> None:
    parser.add_argument(
        "--simulated", type=whole(1, MOST_DEMONSTRATIONS), default=200, help="demonstrations per row (default: 200)"
    )
    parser.add_argument("--design-repetitions", type=whole(1), default=20, help="of the design test (default: 20)")
    parser.add_argument(
        "--demonstrations", type=whole(1, MOST_DEMONSTRATIONS), default=8, help="most in the design test (default: 8)"
    )
    parser.add_argument(
        "--places", type=whole(5, MOST_DEMONSTRATIONS), default=24, help="starts and goals to choose from (default: 24)"
    )
    parser.add_argument("--noise", type=real(above=0), default=1e-3, help="on keypoints, coverage [m] (default: 0.001)")
    parser.add_argument(
        "--design-noise", type=real(above=0), default=5e-3, help="the same, design [m] (default: 0.005)"
    )
    parser.add_argument("--seed", type=whole(0), default=0, help="of all that is random (default: 0)")


if __name__ == "__main__":
    experiment(str(__doc__), add_options, "experiments.identifiability")
