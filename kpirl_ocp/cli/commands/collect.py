"""Collect camera data."""

from __future__ import annotations

import warnings
from argparse import Namespace
from dataclasses import fields

from kpirl_ocp.cli.options.collect import SETTINGS
from kpirl_ocp.errors import OptionError
from kpirl_ocp.perception.data.collection import collect
from kpirl_ocp.perception.data.motions import MOTIONS, HandMotion
from kpirl_ocp.reporting import said_if_interrupted


def main(args: Namespace) -> None:
    """Collect, or resume an earlier collection."""
    kind = MOTIONS[args.motion]
    given = {name: getattr(args, name) for name in SETTINGS if getattr(args, name) is not None}
    known = [field.name for field in fields(kind)]  # type: ignore[arg-type]
    for name in given.keys() - known:
        options = ", ".join(f"--{other.replace('_', '-')}" for other in known)
        raise OptionError(f"--{name.replace('_', '-')} is not for {args.motion}, which has {options}")
    motion = kind(**given)
    if isinstance(motion, HandMotion) and round(motion.seconds * motion.rate) < 1:
        raise OptionError(f"--seconds, --rate: {motion.seconds:g} s at {motion.rate:g} Hz are a clip of one frame")
    warnings.filterwarnings("ignore", message=".*still being processed by the workers have been cancelled")  # on Ctrl-C
    with said_if_interrupted(lambda: f"finished episodes are in {args.out}; the same command resumes"):
        print(f"episodes: {collect(args.out, motion, args.episodes or kind.episodes, args.seed, args.jobs)}")
