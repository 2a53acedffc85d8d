"""Run a script and write how long it waited for compilations: `timed_script.py RESULT SCRIPT ARGUMENTS ..`.

RESULT becomes {"functions": how many `compiler.compiled` compiled or found in the cache, "compile_s": seconds in there
and in `MachineCode.wait`}. What a compiler makes in the background, while the script goes on, is not in it.
"""

import json
import runpy
import sys
import time
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import kpirl_ocp
from kpirl_ocp.ocp.codegen import compiler as native
from kpirl_ocp.ocp.interior_point.machine_code import MachineCode

for name in kpirl_ocp.__all__:  # names are imported when used; from here on every module that compiles is there
    getattr(kpirl_ocp, name)

spent: dict[str, list[float]] = {}  # seconds of every call


def _timed(function: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(function)
    def timed(*arguments: Any) -> Any:
        started = time.perf_counter()
        try:
            return function(*arguments)
        finally:
            spent.setdefault(function.__name__, []).append(time.perf_counter() - started)

    return timed


_compiled = native.compiled
for module in list(sys.modules.values()):
    if getattr(module, "compiled", None) is _compiled:
        module.compiled = _timed(_compiled)
MachineCode.wait = _timed(MachineCode.wait)  # type: ignore[method-assign]

result, sys.argv = Path(sys.argv[1]), sys.argv[2:]
try:
    runpy.run_path(sys.argv[0], run_name="__main__")
except SystemExit as stop:
    if stop.code:
        raise
seconds = sum(map(sum, spent.values()))
result.write_text(json.dumps({"functions": len(spent.get("compiled", [])), "compile_s": seconds}))
