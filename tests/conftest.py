"""Processes that tests start import the package that the tests import, be it this clone's or an installed one, and are
ended by Ctrl-C, even if the tests themselves were started with interrupts ignored, as `nohup make test &` does."""

import os
import signal
from pathlib import Path

import kpirl_ocp

os.environ["PYTHONPATH"] = str(Path(kpirl_ocp.__file__).parents[1])
signal.signal(signal.SIGINT, signal.default_int_handler)
