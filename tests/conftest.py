"""Processes that tests start import the package that the tests import, be it this clone's or an installed one."""

import os
from pathlib import Path

import kpirl_ocp

os.environ["PYTHONPATH"] = str(Path(kpirl_ocp.__file__).parents[1])
