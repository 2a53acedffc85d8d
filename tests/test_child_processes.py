"""Child processes never hear Ctrl-C or SIGTERM; what comes to their parent while they start acts when they have."""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import asdict
from importlib import import_module
from pathlib import Path

import joblib
import pytest

from kpirl_ocp import Fatrop, Status
from kpirl_ocp.cli.main import run
from kpirl_ocp.cli.signals import stoppable
from kpirl_ocp.irl.cases.examples import CASES
from kpirl_ocp.irl.learning import comparison
from kpirl_ocp.reporting import deaf_children, pool_ending

BOTH = pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGTERM], ids=lambda by: by.name)
SLEEPER = [sys.executable, "-c", "import time; print('started', flush=True); time.sleep(60)"]
SCRIPTS = Path(__file__).parents[1] / "scripts"


def handling():
    """What this process does on each signal, and which ones wait."""
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    return handlers, signal.pthread_sigmask(signal.SIG_BLOCK, ())


@pytest.mark.parametrize("to", ["this process", "another thread"])  # which the mask of this one does not keep out
@BOTH
def test_a_signal_that_comes_while_children_start_is_heard_when_they_have(by, to):
    reached, before, over = [], handling(), threading.Event()
    other = threading.Thread(target=over.wait)
    other.start()

    def begin():
        with deaf_children():
            signal.pthread_kill(other.ident, by) if to == "another thread" else os.kill(os.getpid(), by)
            time.sleep(0.05)
            reached.append("the end of the block")
        reached.append("what follows")

    with pytest.raises(KeyboardInterrupt), stoppable():
        begin()
    over.set()
    assert reached == ["the end of the block"]
    assert handling() == before


def test_a_block_that_fails_is_left_as_one_that_does_not():
    before = handling()
    with pytest.raises(ZeroDivisionError), deaf_children():
        raise ZeroDivisionError
    assert handling() == before


def test_what_was_ignored_before_is_not_heard():
    """As shells start jobs in the background."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with deaf_children():
            os.kill(os.getpid(), signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_sigterm_without_a_handler_ends_the_process_after_the_block():
    code = "import os; from kpirl_ocp.reporting import deaf_children\nwith deaf_children():"
    code += "\n    os.kill(os.getpid(), 15); print('in', flush=True)\nprint('after')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGTERM, "in\n", "")


def start():
    """A child that has started."""
    child = subprocess.Popen(SLEEPER, stdout=subprocess.PIPE)
    assert child.stdout.readline() == b"started\n"
    return child


@BOTH
@pytest.mark.parametrize("within", ["main thread", "other thread"])
def test_children_that_start_in_the_block_survive(within, by):
    children = []
    with deaf_children():
        children.append(start())
        thread = threading.Thread(target=lambda: children.append(start()))
        thread.start()
        thread.join()
    child = children[["main thread", "other thread"].index(within)]
    child.send_signal(by)
    with pytest.raises(subprocess.TimeoutExpired):
        child.wait(0.3)
    for child in children:
        child.kill()
        child.communicate()


def test_children_of_another_thread_survive_although_only_the_main_thread_has_handlers():
    children = []

    def begin():
        with deaf_children():
            children.append(start())

    thread = threading.Thread(target=begin)
    thread.start()
    thread.join()
    children[0].send_signal(signal.SIGINT)
    with pytest.raises(subprocess.TimeoutExpired):
        children[0].wait(0.3)
    children[0].kill()
    children[0].communicate()


POOL = """
import signal
from concurrent.futures import ProcessPoolExecutor
from joblib.externals import loky
from kpirl_ocp.reporting import deaf_pool

if __name__ == "__main__":
    with deaf_pool():
        pool = {pool}
        mask = pool.submit(signal.pthread_sigmask, signal.SIG_BLOCK, ())
    print(sorted(number.name for number in mask.result()), signal.pthread_sigmask(signal.SIG_BLOCK, ()))
    pool.shutdown()
"""


@pytest.mark.parametrize("pool", ["loky.ProcessPoolExecutor(1)", "ProcessPoolExecutor(1, get_context('spawn'))"])
def test_the_first_pool_of_a_process_is_deaf(pool, tmp_path):
    """Although Python starts its tracker of resources with it, and unblocks the signals when it has."""
    (tmp_path / "pool.py").write_text("from multiprocessing import get_context\n" + POOL.format(pool=pool))
    done = subprocess.run([sys.executable, tmp_path / "pool.py"], capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("['SIGINT', 'SIGTERM'] set()\n", "")


FATROP = """
import time
from kpirl_ocp import Fatrop, Status
from kpirl_ocp.irl.cases.examples import CASES
case = CASES["lqr"]()
for _ in range(2):
    try:
        print(Fatrop().solve(case.problem, case.demonstration.s0, case.psi).status.name, flush=True)
        time.sleep(60)
    except KeyboardInterrupt:
        print("interrupted", flush=True)
"""


def test_ctrl_c_does_not_reach_the_process_in_which_fatrop_solves():
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "start_new_session": True}
    process = subprocess.Popen([sys.executable, "-c", FATROP], **options)
    first = process.stdout.readline()
    os.killpg(process.pid, signal.SIGINT)
    second = [process.stdout.readline() for _ in range(2)]
    os.killpg(process.pid, signal.SIGINT)
    rest = process.communicate(timeout=60)
    assert (first, second, rest) == (b"CONVERGED\n", [b"interrupted\n", b"CONVERGED\n"], (b"interrupted\n", b""))


def test_fatrop_solves_after_a_signal_that_came_while_its_process_started(monkeypatch):
    module, case = import_module("kpirl_ocp.ocp.solvers.child_process"), CASES["lqr"]()
    child = module.ChildProcess()
    monkeypatch.setattr("kpirl_ocp.ocp.solvers.fatrop._CHILD", child)
    with monkeypatch.context() as patch:
        signalled(patch, module, "_started", signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            Fatrop().solve(case.problem, case.demonstration.s0, case.psi)
    assert Fatrop().solve(case.problem, case.demonstration.s0, case.psi).status.name == "CONVERGED"
    child._end()


def signalled(patch, place, name, by):
    """Let a function get a signal each time when it is called."""
    function = getattr(place, name)

    def called(*arguments, **more):
        os.kill(os.getpid(), by)
        return function(*arguments, **more)

    patch.setattr(place, name, called)


@BOTH
@pytest.mark.parametrize("name", ["__init__", "submit"])
def test_a_comparison_whose_pool_starts_ends_in_one_line(name, by, monkeypatch, tmp_path, capsys):
    signalled(monkeypatch, comparison.ProcessPoolExecutor, name, by)
    assert run(["compare", "--problem", "lqr", "--steps", "1", "--out", str(tmp_path)]) == 130
    lines = [line for line in capsys.readouterr().err.replace("\r", "\n").splitlines() if line and "%|" not in line]
    assert lines == [f"interrupted: 0 of 5 measurements are in {tmp_path}/metrics.json."]


def test_sigterm_is_heard_although_ctrl_c_is_ignored_and_it_comes_while_handlers_change(monkeypatch):
    """As it may in a job in the background."""
    change, before = signal.signal, signal.signal(signal.SIGINT, signal.SIG_IGN)
    to_come = [signal.SIGTERM]

    def changed(number, handler):
        if number in to_come:
            to_come.remove(number)
            os.kill(os.getpid(), number)
        return change(number, handler)

    def ended():
        monkeypatch.setattr(signal, "signal", changed)
        with pool_ending():
            pass

    try:
        with stoppable(), pytest.raises(KeyboardInterrupt):
            ended()
    finally:
        change(signal.SIGINT, before)


def test_threads_that_fed_the_processes_of_a_pool_have_ended_with_it():
    over, ended = threading.Event(), threading.Event()
    feeder = threading.Thread(target=lambda: (over.wait(), time.sleep(0.1), ended.set()), daemon=True)
    feeder.name = "QueueFeederThread"
    feeder.start()
    with pool_ending():  # that of another pool goes on
        pass
    assert not ended.is_set()
    with pool_ending():
        over.set()
    assert ended.is_set()


@pytest.mark.parametrize(
    ("name", "kind", "said"),
    [("ExecutorManagerThread", KeyError, 0), ("ExecutorManagerThread", OSError, 1), ("another", KeyError, 1)],
)
def test_a_task_that_was_dropped_is_no_error_of_a_pool_that_ends(name, kind, said, monkeypatch):
    heard = []
    monkeypatch.setattr(threading, "excepthook", heard.append)

    def fail():
        raise kind

    thread = threading.Thread(target=fail, name=name)
    with pool_ending():
        thread.start()
        thread.join()
    assert len(heard) == said


@BOTH
def test_a_comparison_whose_pool_ends_leaves_no_process_behind(by, monkeypatch, tmp_path, capsys):
    """A wait for the thread that kills them, if a signal interrupts it, takes that thread for ended."""
    shutdown, workers = comparison.ProcessPoolExecutor.shutdown, []

    def noted(pool, **more):
        workers.extend(pool._processes.values())
        os.kill(os.getpid(), by)
        shutdown(pool, **more)

    monkeypatch.setattr(comparison.ProcessPoolExecutor, "shutdown", noted)
    assert run(["compare", "--problem", "lqr", "--steps", "1", "--out", str(tmp_path)]) == 130
    assert capsys.readouterr().err.endswith(f"interrupted: 1 of 5 measurements are in {tmp_path}/metrics.json.\n")
    assert [worker.is_alive() for worker in workers] == [False]


@BOTH
def test_a_collection_whose_processes_start_ends_in_one_line(by, monkeypatch, tmp_path, capsys):
    pytest.importorskip("pybullet")
    signalled(monkeypatch, joblib.Parallel, "__call__", by)
    words = ["collect", "sines", "--steps", "6", "--episodes", "3", "--jobs", "2", "--out", str(tmp_path)]
    assert run(words) == 130
    lines = [line for line in capsys.readouterr().err.replace("\r", "\n").splitlines() if line and "%|" not in line]
    assert lines == [f"interrupted: finished episodes are in {tmp_path}; the same command resumes."]


@pytest.mark.parametrize("backend", ["loky", "dask"])
@BOTH
def test_a_sweep_whose_processes_start_is_interrupted_and_leaves_none_of_them(backend, by, monkeypatch, tmp_path):
    place = (joblib.Parallel, "__call__")
    if backend == "dask":
        place = (pytest.importorskip("dask.distributed").LocalCluster, "__init__")
    monkeypatch.syspath_prepend(SCRIPTS)
    sweep = import_module("reproduction.sweep")
    signalled(monkeypatch, *place, by)
    jobs = [sweep.Job(f"{number}", asdict, {"obj": Status.CONVERGED}) for number in range(3)]
    before = set(multiprocessing.active_children())
    with pytest.raises(KeyboardInterrupt), stoppable(), sweep.backend(backend, None, 2) as runner:
        sweep.run_sweep("test", jobs, tmp_path, runner)
    assert set(multiprocessing.active_children()) <= before


def test_sigterm_while_ray_begins_is_an_interruption(monkeypatch):
    """Its own handler ends the process without a word."""
    ray = pytest.importorskip("ray")

    def init(**settings):
        signal.signal(signal.SIGTERM, lambda number, _: sys.exit(number))
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.syspath_prepend(SCRIPTS)
    sweep, before = import_module("reproduction.sweep"), handling()
    monkeypatch.setattr(ray, "init", init)
    with pytest.raises(KeyboardInterrupt), sweep.backend("ray", None, 1):
        pass
    assert handling() == before
