"""Processes that tests start import the package that the tests import, be it this clone's or an installed one, and are
ended by Ctrl-C, even if the tests themselves were started with interrupts ignored, as `nohup make test &` does. The
name of a test is the same in every process: workers in parallel must collect the same names. Garbage is searched for as
in commands of the package: less often than Python would, and not before the end. JAX, whose numbers ours are compared
with, compiles without optimisation, as it calls each of its functions a few times. OpenCV has one thread: workers in
parallel have the processors."""

import atexit
import gc
import os
import re
import signal
import sys
import tempfile
from importlib import import_module
from pathlib import Path

import pytest

import kpirl_ocp

os.environ["PYTHONPATH"] = str(Path(kpirl_ocp.__file__).parents[1])
if "KPIRL_TEST_OBJECTS" not in os.environ:  # a directory for all processes of the tests, as long as the first one lives
    object_files = tempfile.TemporaryDirectory()
    os.environ["KPIRL_TEST_OBJECTS"] = object_files.name
os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "1"
os.environ["OPENCV_FOR_THREADS_NUM"] = "1"
signal.signal(signal.SIGINT, signal.default_int_handler)
gc.set_threshold(10_000, 20, 20)
atexit.register(gc.freeze)


@pytest.fixture(scope="module")
def virtual_machine():
    """Gradient steps and their gradients are evaluated by CasADi's virtual machine.

    Where problems are small and many, compiling them would take most of the time; that machine code gives the same is
    what `test_compiler.py` and `test_network_planning.py` say.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("kpirl_ocp.ocp.solvers.gradient_descent.compiled", lambda function: function)
        patch.setattr("kpirl_ocp.irl.hypergradients.unrolled_code.compile_all", list)
        forget_gradient_steps()
        yield
    forget_gradient_steps()


def forget_gradient_steps():
    """What tests of one kind have built is not for those of the other."""
    for name, functions in (
        ("kpirl_ocp.ocp.solvers.gradient_descent", ["_descent"]),
        ("kpirl_ocp.irl.hypergradients.unrolled_code", ["_together", "_losses_alone"]),
    ):
        for function in functions:
            getattr(import_module(name), function).cache_clear()
    vars(import_module("kpirl_ocp.ocp.codegen.numpy_calls")._thread).clear()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup():
    """What earlier tests have left behind is undone.

    A command may have set two threads of torch, which wait for each other, busily. A cluster of Dask leaves a variable
    for which later processes give memory back to the system again and again, a sixth of the reproduction's time.
    """
    os.environ.pop("MALLOC_TRIM_THRESHOLD_", None)
    if torch := sys.modules.get("torch"):
        torch.set_num_threads(1)


def pytest_collection_modifyitems(items):
    if addressed := [item.nodeid for item in items if re.search(r"\bat 0x[0-9a-f]{6,}", item.nodeid)]:
        raise pytest.UsageError(f"the name of a test holds an address in memory; give it ids: {addressed[0]}")


def pytest_collection_finish():
    """What was imported lives as long as the tests: the search for garbage passes it by."""
    gc.freeze()
