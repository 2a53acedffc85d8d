"""Run a script and write how long it compiled: `timed_script.py RESULT SCRIPT ARGUMENTS ..`.

RESULT becomes {"functions": how many were compiled or found in the cache, "compile_s": seconds in `compiler.compiled`}.
"""

import json
import runpy
import sys
import time
from pathlib import Path

import casadi as ca

import kpirl_ocp
from kpirl_ocp.ocp.codegen import compiler as native

for name in kpirl_ocp.__all__:  # names are imported when used; from here on every module that compiles is there
    getattr(kpirl_ocp, name)

_compiled, spent = native.compiled, []


def _timed(function: ca.Function) -> ca.Function:
    started = time.perf_counter()
    try:
        return _compiled(function)
    finally:
        spent.append(time.perf_counter() - started)


for module in list(sys.modules.values()):
    if getattr(module, "compiled", None) is _compiled:
        module.compiled = _timed

result, sys.argv = Path(sys.argv[1]), sys.argv[2:]
try:
    runpy.run_path(sys.argv[0], run_name="__main__")
except SystemExit as stop:
    if stop.code:
        raise
result.write_text(json.dumps({"functions": len(spent), "compile_s": sum(spent)}))
