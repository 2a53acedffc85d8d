"""Learn from a film of a person what mattered, and do it with an arm.

The object is followed through the film (or the tracks of another program are read), a cost is learned that explains
its path, and the arm plans with it and executes the plan in the scene, from several starts. The tracks are drawn into
the film; a film that shows no demonstration is refused, with a picture of the reason.
Try: kpirl learn-video my_placing.mp4 --robot iiwa --out out/mine

Pixels are those of frames whose longer side has at most 640 pixels, as in the pictures that are written.
"""

from argparse import ArgumentParser, ArgumentTypeError
from collections.abc import Callable
from pathlib import Path

from kpirl_ocp.cli.values import MOST_DEMONSTRATIONS, existing_file, name, real, whole
from kpirl_ocp.sizes import LONGEST


def add_options(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("film", type=Path, help="a video, or a folder of pictures with --source-rate")
    watch = parser.add_argument_group("what to watch")
    watch.add_argument("--start", type=real(least=0), default=0.0, help="start of the demonstration [s] (default: 0)")
    watch.add_argument("--end", type=real(above=0), help="its end [s] (default: that of the film)")
    watch.add_argument("--source-rate", type=real(above=0), help="rate of a folder of pictures, or of --tracks [Hz]")
    which = watch.add_mutually_exclusive_group()
    which.add_argument("--box", type=pixels(4), metavar="X0,Y0,X1,Y1", help="around the object in the first frame")
    which.add_argument("--points", type=pixels(2), nargs="+", metavar="X,Y", help="on the object in the first frame")
    which.add_argument("--hand", action="store_true", help="follow the hand itself (needs the extra `hands`)")
    which.add_argument("--tracks", type=existing_file, help=".npz or .csv with tracks of the object's keypoints")
    which.add_argument("--detector", type=existing_file, help="card of a trained keypoint detector")
    arm = parser.add_argument_group("the arm")
    arm.add_argument(
        "--robot", type=name, help="iiwa (default), a name of example-robot-data, or a .urdf file; of --recording, too"
    )
    arm.add_argument("--flange", type=name, metavar="LINK", help="link that holds the bottle (default: the arm's tool)")
    size = arm.add_mutually_exclusive_group()
    size.add_argument(
        "--object-size", type=real(above=0), help="length of the object [m] (default: 0.25, the arm's bottle)"
    )
    size.add_argument("--scale", type=real(above=0), help="pixels of the arm's camera per pixel of the film")
    arm.add_argument(
        "--starts", type=whole(1, MOST_DEMONSTRATIONS), default=3, help="number of starts to execute from (default: 3)"
    )
    own = parser.add_argument_group("dynamics learned from recordings of the arm, instead of a model of it")
    own.add_argument("--dynamics", type=existing_file, help="card of `kpirl train-dynamics`; with --detector")
    own.add_argument("--recording", type=existing_file, help=".npz episode of the arm: plan from its first frame")
    learning = parser.add_argument_group("learning")
    learning.add_argument("--steps", type=whole(3, LONGEST), default=15, help="steps T of the plan (default: 15)")
    learning.add_argument("--iterations", type=whole(1), default=150, help="iterations at most (default: 150)")
    learning.add_argument("--cost", type=existing_file, help="cost.json to evaluate on this film instead of learning")
    learning.add_argument("--seed", type=whole(0), default=0, help="for the starts (default: 0)")
    learning.add_argument("--export", action="store_true", help="write the controller as C to OUT/c")


def pixels(count: int) -> Callable[[str], list[float]]:
    """A parser of this many finite numbers, separated by commas."""

    def parse(word: str) -> list[float]:
        number, parts = real(), word.split(",")
        if len(parts) != count:
            raise ArgumentTypeError(f"expected {count} numbers separated by commas, got {word!r}")
        return [number(part.strip()) for part in parts]

    return parse
