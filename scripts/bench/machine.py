"""The machine that the numbers were taken on."""

from __future__ import annotations

import os
import platform
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bench.one_thread import AVAILABLE
from bench.part import Numbers


def describe() -> Numbers:
    """Processor, compiler, and how busy the machine is: load averages over 1, 5 and 15 minutes."""
    return {
        "cpu": _processor(),
        "pinned_to": sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None,
        "compiler": _compiler(),
        "load": list(os.getloadavg()),
    }


@contextmanager
def all_cores() -> Iterator[None]:
    """Threads that are started in this context may use every core that the process was given."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, AVAILABLE)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def _processor() -> str:
    information = Path("/proc/cpuinfo")
    if information.exists():
        names = [line.split(":", 1)[1].strip() for line in information.read_text().splitlines() if "model name" in line]
        return names[0] if names else platform.machine()
    return platform.processor() or platform.machine()


def _compiler() -> str:
    try:
        return subprocess.run(["cc", "--version"], capture_output=True, text=True, check=True).stdout.splitlines()[0]
    except (OSError, subprocess.CalledProcessError):
        return "none"
