"""Rates of silently wrong answers, peer by peer."""

from __future__ import annotations

import contextlib
import importlib
import io
import logging
import warnings
from collections import Counter
from enum import Enum
from importlib.metadata import version

import numpy as np
from bench.part import Part, Table
from tqdm import tqdm

from stress.certificates.case import Case
from stress.certificates.families import draw
from stress.peers.program import CannotState, Program
from stress.settings import Profile

PEERS = {
    "CasADi, derivatives of nlpsol": ("casadi_sensitivities", "casadi"),
    "do-mpc, NLPDifferentiator": ("do_mpc_differentiator", "do-mpc"),
    "POUNCE, parametric step": ("pounce_steps", "pounce-solver"),
    "cvxpylayers": ("cvxpy_layers", "cvxpylayers"),
    "mpc.pytorch": ("mpc_pytorch", "mpc"),
}
_NOTE = (
    "Each peer gets the cases of the contest that it can state (convex ones for cvxpylayers, bounded linear-quadratic "
    "ones for mpc.pytorch), with Ipopt's tolerance at 1e-10 and all checks that it offers. Exceptions, NaN, a solver's "
    "failure and its own flags count as refusals. Silently wrong: a number that is not the gradient, or where there is "
    "none. Smooth problems in odd units are among the cases."
)


class Answer(Enum):
    """Of a peer."""

    RIGHT = "right"
    SILENTLY_WRONG = "silently wrong"
    REFUSED = "failed or flagged by itself"
    CANNOT_STATE = "cannot state"


def available(name: str):
    """The gradient function of a peer; None if it is not installed."""
    try:
        return importlib.import_module(f"stress.peers.{PEERS[name][0]}").gradient
    except ImportError:
        return None


def answer(gradient, case: Case) -> Answer:
    """Verdict of a peer on one case; exceptions, NaN and its own flags count as refusals."""
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        logging.disable(logging.CRITICAL)
        try:
            found, plan = gradient(Program(case))
        except CannotState:
            return Answer.CANNOT_STATE
        except Exception:  # whatever a peer raises is no silent answer
            return Answer.REFUSED
        finally:
            logging.disable(logging.NOTSET)
    if not np.isfinite(found).all():
        return Answer.REFUSED
    return Answer.RIGHT if case.truth(plan).agrees(found) else Answer.SILENTLY_WRONG


def silent_share(counts: Counter) -> float:
    """Of the cases that it can state."""
    stated = sum(counts.values()) - counts[Answer.CANNOT_STATE]
    return counts[Answer.SILENTLY_WRONG] / max(stated, 1)


def measure(profile: Profile) -> Part:
    """The same cases, every `profile.every`-th, by every peer that is installed, and by this package."""
    indices = range(0, profile.cases, profile.every)
    rows, numbers = [], {}
    for name, (_, package) in PEERS.items():
        gradient = available(name)
        if gradient is None:
            rows.append([name, "not installed", *[""] * 5])
            continue
        counts = Counter(answer(gradient, draw(index)) for index in tqdm(indices, name, unit="case"))
        stated = sum(counts.values()) - counts[Answer.CANNOT_STATE]
        numbers[name] = {kind.name: counts[kind] for kind in Answer} | {"version": version(package)}
        share = f"{100 * silent_share(counts):.1f} %"
        kinds = (counts[kind] for kind in (Answer.RIGHT, Answer.REFUSED, Answer.SILENTLY_WRONG))
        rows.append([name, version(package), stated, *kinds, share])
    header = [
        "peer",
        "version",
        "cases it can state",
        *(a.value for a in (Answer.RIGHT, Answer.REFUSED)),
        "silently wrong",
        "share",
    ]
    return Part(numbers, [Table("What others answer", header, rows, _NOTE)])
