"""Processes that tests start import the package that the tests import, be it this clone's or an installed one, and are
ended by Ctrl-C, even if the tests themselves were started with interrupts ignored, as `nohup make test &` does. The
name of a test is the same in every process: workers in parallel must collect the same names."""

import gc
import os
import re
import signal
from pathlib import Path

import pytest

import kpirl_ocp

os.environ["PYTHONPATH"] = str(Path(kpirl_ocp.__file__).parents[1])
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items):
    if addressed := [item.nodeid for item in items if re.search(r"\bat 0x[0-9a-f]{6,}", item.nodeid)]:
        raise pytest.UsageError(f"the name of a test holds an address in memory; give it ids: {addressed[0]}")


def pytest_collection_finish():
    """What was imported lives as long as the tests: the search for garbage passes it by, and comes less often."""
    gc.freeze()
    gc.set_threshold(10_000, 20, 20)
