"""Collect camera data: for the keypoint detector, for the dynamics model, and demonstrations.

The same command run again goes on where it was interrupted. Test data is a collection with another --seed.
"""

import argparse
from dataclasses import fields

from kpirl_ocp.perception.data.collection import collect
from kpirl_ocp.perception.data.motions import MOTIONS
from kpirl_ocp.reporting import run


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    kinds = parser.add_subparsers(dest="motion", required=True)
    for name, motion in MOTIONS.items():
        text = str(motion.__doc__)
        sub = kinds.add_parser(name, help=text.splitlines()[0], description=text)
        sub.add_argument("--episodes", type=int, default=motion.episodes, help="how many (default: %(default)s)")
        for field in fields(motion):
            help_text = f"{field.metadata['help']} (default: %(default)s)"
            sub.add_argument(
                f"--{field.name.replace('_', '-')}", type=type(field.default), default=field.default, help=help_text
            )
        sub.add_argument("--seed", type=int, default=0, help="(default: 0)")
        sub.add_argument("--jobs", type=int, default=2, help="processes (default: 2)")
        sub.add_argument("--out", required=True, help="directory to write")
    return parser.parse_args()


def main() -> None:
    args = parse()
    kind = MOTIONS[args.motion]
    motion = kind(**{field.name: getattr(args, field.name) for field in fields(kind)})
    print(f"episodes: {collect(args.out, motion, args.episodes, args.seed, args.jobs)}")


if __name__ == "__main__":
    run(main)
