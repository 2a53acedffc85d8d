"""Generated C in which functions that cannot fail are called without a test for failure.

CasADi tests after every call whether it failed. Compilers take a failure for likely enough that what follows dozens of
calls counts as hardly ever reached, and leave its loops without vector instructions.
"""

from __future__ import annotations

import re

from kpirl_ocp.ocp.codegen.rewriting.copy_elision import FUNCTION

_ENTRY = re.compile(r"return (casadi_f\d+)\(arg, res, iw, w, mem\);")
_CALL = re.compile(r"if \((casadi_f\d+\(arg\d*, res\d*, iw, w, 0\))\) return 1;")


def with_certain_calls(source: str) -> str:
    """The source without these tests, or as it is if a function in it can fail for another reason than a call.

    The functions that a file is generated for keep their tests: they run once, and what is compiled for speed takes
    longer to compile.
    """
    entries = set(_ENTRY.findall(source))
    certain = FUNCTION.sub(lambda found: found[0] if found[1] in entries else _CALL.sub(r"\1;", found[0]), source)
    inner = (found[0] for found in FUNCTION.finditer(certain) if found[1] not in entries)
    return source if any("return 1;" in text for text in inner) else certain
