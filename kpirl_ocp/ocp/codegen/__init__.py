"""From CasADi to C, from C to machine code, and from machine code to numpy."""

from kpirl_ocp.ocp.codegen.compiler import compile_all, compile_folder, compiled
from kpirl_ocp.ocp.codegen.numpy_calls import Call, call, call_built, call_one_of

__all__ = ["Call", "call", "call_built", "call_one_of", "compile_all", "compile_folder", "compiled"]
