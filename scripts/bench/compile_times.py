"""Compilation times of `learn_cost.py`, with an empty cache and again with the one it left."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from bench.part import Numbers, Part, Table
from bench.settings import Preset

_TIMED, _SCRIPT = Path(__file__).with_name("timed_script.py"), Path(__file__).parents[1] / "learn_cost.py"


def measure(preset: Preset) -> Part:
    """Every method with a cache of its own."""
    numbers: Numbers = {}
    rows = []
    for method in preset.methods:
        numbers[method] = {}
        with tempfile.TemporaryDirectory() as scratch:
            for cache in ("empty", "full"):
                found = _learn(method, Path(scratch))
                numbers[method][cache] = found
                cells = f"{found['compile_s']:.2f}", f"{found['script_s']:.1f}"
                rows.append([method, cache, found["functions"], *cells])
    header = ["method", "cache", "functions", "compilation [s]", "whole script [s]"]
    note = (
        "Compilation that the script waits for: generating C, compiling it or finding it in the cache, loading; what a "
        "compiler makes in the background is not in it. One outer iteration."
    )
    return Part(numbers, [Table("Compilation in learn_cost.py", header, rows, note)])


def _learn(method: str, scratch: Path) -> Numbers:
    """One outer iteration in a process of its own. Raises RuntimeError, with what it said, if the script fails."""
    result = scratch / "result.json"
    arguments = ["--task", "placing", "--method", method, "--iterations", "1", "--out", str(scratch / "out")]
    command = [sys.executable, str(_TIMED), str(result), str(_SCRIPT), *arguments]
    environment = os.environ | {"XDG_CACHE_HOME": str(scratch / "cache")}
    started = time.perf_counter()
    done = subprocess.run(command, env=environment, check=False, capture_output=True, text=True)
    spent = time.perf_counter() - started
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr}")
    return json.loads(result.read_text()) | {"script_s": spent}
