"""Ctrl-C and SIGTERM end what a command does, wherever they come; learning that they ended is not done."""

import json
import os
import signal
import threading
import time

import casadi as ca
import pytest

from kpirl_ocp import OCP, Implicit, learn
from kpirl_ocp.cli.main import run
from kpirl_ocp.cli.signals import stoppable
from kpirl_ocp.irl.cases.examples import CASES, unconstrained
from kpirl_ocp.irl.learning.comparison import learn_with_each
from kpirl_ocp.irl.learning.learn import Learner
from kpirl_ocp.irl.learning.optimisers import Adam
from kpirl_ocp.irl.visual.camera_learning import learn_on
from kpirl_ocp.ocp.solvers.ipopt import Ipopt

BOTH = pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGTERM], ids=lambda by: by.name)


class Signalling:
    """A number for CasADi, which drops exceptions while it asks for it."""

    def __init__(self, by):
        self.by = by

    def __DM__(self):
        signal.raise_signal(self.by)
        return ca.DM(1)


@BOTH
def test_a_signal_that_comes_while_casadi_reads_a_number_is_not_lost(by):
    def sine():
        assert ca.sin(Signalling(by)) == ca.sin(1)
        time.sleep(10)

    with pytest.raises(KeyboardInterrupt), stoppable():
        sine()


@BOTH
def test_a_signal_ends_a_solve_of_ipopt(by):
    s, u = ca.SX.sym("s", 2), ca.SX.sym("u")
    rugged = OCP.from_expressions(
        state=s,
        action=u,
        dynamics=s + 0.1 * ca.vertcat(s[1], u),
        stage_cost=ca.sin(30 * s[0]) ** 2 + 0.001 * u**2,
        horizon=200,
        action_bounds=(-3, 3),
    )

    def solves():
        for _ in range(1000):
            Ipopt().solve(rugged, [0.5, 0.0])

    threading.Timer(0.3, os.kill, (os.getpid(), by)).start()
    with pytest.raises(KeyboardInterrupt), stoppable():
        solves()


def test_sigterm_ends_what_was_started_with_ctrl_c_ignored():
    """As shells start jobs in the background."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with stoppable():
            signal.raise_signal(signal.SIGINT)
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGTERM)
        assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_handlers_and_timers_are_as_before_afterwards():
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)]
    with stoppable():
        assert signal.getsignal(signal.SIGTERM) != handlers[1]
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)] == handlers
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


@pytest.fixture
def interrupted(monkeypatch):
    """Learning gets Ctrl-C in its first step."""

    def step(learner, state):
        raise KeyboardInterrupt

    monkeypatch.setattr(Learner, "step", step)


@pytest.mark.usefixtures("interrupted")
def test_learning_that_was_interrupted_is_not_taken_for_done():
    lqr = CASES["lqr"]()
    result = learn(lqr.problem, [lqr.demonstration], lqr.psi, Implicit(), Adam(), steps=3, progress=False)
    assert result.interrupted
    with pytest.raises(KeyboardInterrupt):
        result.raise_if_interrupted()
    with pytest.raises(KeyboardInterrupt):
        learn_on(lqr.problem, [lqr.demonstration], lqr.psi, iterations=3)
    with pytest.raises(KeyboardInterrupt):
        learn_with_each(unconstrained(lqr), [1, 2], 3, 0.01)


@pytest.mark.usefixtures("interrupted")
def test_a_comparison_that_is_interrupted_while_it_learns_keeps_its_measurements(tmp_path, capsys):
    assert run(["compare", "--problem", "lqr", "--steps", "1", "--out", str(tmp_path)]) == 130
    assert f"interrupted: 5 of 5 measurements are in {tmp_path}/metrics.json." in capsys.readouterr().err
    results = json.loads((tmp_path / "metrics.json").read_text())["results"]
    assert [m["method"] for m in results["measurements"]][-1] == "finite difference"


def test_learning_that_was_not_interrupted_is_what_it_is():
    lqr = CASES["lqr"]()
    result = learn(lqr.problem, [lqr.demonstration], lqr.psi, Implicit(), Adam(), steps=1, progress=False)
    assert result.raise_if_interrupted() is result
