"""Iterations of `Riccati` and `Ipopt` on the classic problems, in units that are drawn."""

from __future__ import annotations

from functools import partial

import numpy as np
from bench.part import Part
from reference import REFERENCES, Instance
from reference.checks import coarse
from units import drawn_units, in_units, start_in_units

from stress.settings import Profile
from stress.starts.board import REPORTED, part, race, reported
from stress.starts.systems import Start

_NOTE = (
    f"Seeds from {REPORTED} on. About 40 steps; units between 1e-3 and 1e3 for the cost, the constraints, and every "
    "state and action on its own. The guess is that of the reference suite."
)


def measure(profile: Profile) -> Part:
    """Ratios of iterations by problem, at seeds that are reported."""
    systems = {reference.name: partial(start, coarse(reference)) for reference in REFERENCES}
    pairs = race(systems, reported(profile.units))
    return part("Iterations in units that are drawn, Riccati / Ipopt", "problem", pairs, _NOTE)


def start(case: Instance, seed: int) -> Start:
    """The problem, its initial state and its guess in the units of this seed."""
    units = drawn_units(case.problem, seed)
    s0, guess = start_in_units(case.problem, case.problem.inputs(case.s0, case.psi, ())[0], case.guess, units)
    return Start(in_units(case.problem, **units), s0, case.psi, np.zeros(0), guess)
