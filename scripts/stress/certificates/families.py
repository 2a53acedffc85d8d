"""All families of cases; `draw` makes case number i, always the same one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kpirl_ocp import Ipopt, Riccati
from stress.certificates import (
    activity,
    bends,
    dependence,
    failing,
    folded,
    loss_kinks,
    minima,
    quadratic,
    smooth,
    steep_laws,
)
from stress.certificates.case import Case
from stress.certificates.dress import dress


def _solver(rng):
    return Ipopt() if rng.random() < 0.2 else Riccati()


def _of_laws(name: str, laws: Sequence, looks: Sequence = (None,)):
    def make(rng, scaled: bool) -> Case:
        law = laws[rng.integers(len(laws))](rng)
        return dress(name, law, rng, scaled, _solver(rng), looks[rng.integers(len(looks))])

    return make


def _early(rng, scaled: bool) -> Case:
    law = replace(failing.hurried(rng), due=False)
    return dress("unconverged", law, rng, scaled, failing.early_stop(rng))


def _steep(rng, scaled: bool) -> Case:
    of_the_plan = rng.random() < 0.8
    laws, looks = (steep_laws.LAWS, (None,)) if of_the_plan else ((steep_laws.plain,), steep_laws.LOOKS)
    return _of_laws("steep, but smooth", laws, looks)(rng, scaled)


FAMILIES = {
    "smooth": _of_laws("smooth", smooth.LAWS, (None, loss_kinks.bent, loss_kinks.reached)),
    "linear-quadratic with active constraints": quadratic.constrained,
    "constraints that begin to count": _of_laws("constraints that begin to count", activity.LAWS),
    "dependent and redundant constraints": _of_laws("dependent and redundant constraints", dependence.LAWS),
    "kinks and jumps in psi": _of_laws("kinks and jumps in psi", bends.LAWS),
    "kinks and jumps in the action, ReLU": _of_laws("kinks and jumps in the action, ReLU", folded.LAWS),
    "kinks and jumps of observation and loss": _of_laws(
        "kinks and jumps of observation and loss", smooth.LAWS, loss_kinks.KINKED
    ),
    "folds, maxima, saddles, flat minima": _of_laws("folds, maxima, saddles, flat minima", minima.LAWS),
    "infeasible, unbounded, NaN": _of_laws("infeasible, unbounded, NaN", failing.LAWS),
    "unconverged": _early,
    "steep, but smooth": _steep,
}
# The first two families are most of what people do. The last one has numbers of its own, a tenth of all.
_STEEP = 8, 13
_SHARES = np.array([4, 4, 3, 1, 3, 3, 3, 2, 1, 1])


def draw(index: int) -> Case:
    """Case number `index`; every other one is in drawn units."""
    rng = np.random.default_rng([2026, index])
    make = _steep if index % 20 in _STEEP else list(FAMILIES.values())[rng.choice(10, p=_SHARES / _SHARES.sum())]
    return make(rng, index % 2 == 1)
