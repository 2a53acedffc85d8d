"""Fast kernels in generated C: products, tanh, copies and extremes that a compiler turns into vector instructions.

CasADi's own `casadi_mtimes_dense`, z += x y, runs along rows and cannot be vectorised; it becomes that of
`kpirl_ocp.ocp.codegen.product_kernels`. Results are equal to those of CasADi's virtual machine to the last bit, except
where several partial sums hide the latency of low tiles; there, they differ by rounding. NaN and infinity propagate as
in any sum, and through tanh, which is exact to two units in the last place.
"""

from __future__ import annotations

import re

from kpirl_ocp.ocp.codegen.array_kernels import COPY, LARGER, LARGEST, LEAST, SMALLER, TANH
from kpirl_ocp.ocp.codegen.product_kernels import KINDS, PRODUCTS, tiles
from kpirl_ocp.ocp.codegen.rewriting.certain_calls import with_certain_calls
from kpirl_ocp.ocp.codegen.rewriting.copy_elision import with_earlier_outputs, with_fewer_copies
from kpirl_ocp.ocp.codegen.rewriting.loop_fusion import with_joined_loops

_BODIES = {
    "void casadi_mtimes_dense": PRODUCTS,
    "void casadi_copy": COPY,
    "casadi_real casadi_vfmin": LEAST,
    "casadi_real casadi_vfmax": LARGEST,
    "casadi_real casadi_fmin": SMALLER,
    "casadi_real casadi_fmax": LARGER,
}
_PLAIN = re.compile(r"casadi_mtimes_dense\(([^;]*), ([^,;]+), 0\);")
_PRODUCT = re.compile(r"kernel_mtimes_from\(([^,;]+), (\d+), (\d+), ([^,;]+), (\d+), ([^,;]+), ([^,;]+)\);")
_TANH_LOOP = re.compile(r"for \(i=0, rr=([^,]+), cs=([^;]+); i<(\d+); \+\+i\) \*rr\+\+ = tanh\( ?\*cs\+\+ ?\);")
_REALS = re.compile(r"#define casadi_int .*\n(#endif\n)?")  # defined before the kernels, which need it


def with_fast_kernels(source: str) -> str:
    """Generated C with its dense products, copies, extremes and tanh of arrays replaced; fewer copies, certain calls.

    Nothing is added for functions that it does not contain.
    """
    source, found = _TANH_LOOP.subn(r"kernel_tanh(\2, \3, \1);", _with_products(source))
    source = _apart(with_earlier_outputs(with_joined_loops(with_certain_calls(source))))
    return _begin_with(TANH, source) if found else source


def _apart(source: str) -> str:
    """Generated C whose functions stay functions: put into each other they take longer to compile, and to run."""
    return re.sub(r"^static int casadi_f", r"static __attribute__((noinline)) int casadi_f", source, flags=re.MULTILINE)


def with_ordered_kernels(source: str) -> str:
    """The same with results equal to those of CasADi's virtual machine to the last bit, if nothing is contracted."""
    return _begin_with("#define KERNEL_IN_ORDER\n", _with_products(source))


def _with_products(source: str) -> str:
    for name, body in _BODIES.items():
        start = source.find(f"{name}(")
        if start >= 0:
            end = source.index("\n}\n", start) + len("\n}\n")
            source = source[:start] + body + source[end:]
    return _by_shape(with_fewer_copies(source))


def _by_shape(source: str) -> str:
    """With one function for each shape of a product, in which compilers know all sizes."""
    before, kernel, after = source.partition(PRODUCTS)
    functions, heights = {}, {kind: set[int]() for kind, _ in KINDS}

    def shaped(found: re.Match[str]) -> str:
        x, rows, inner, y, columns, start, z = found.groups()
        name = f"kernel_mtimes_{rows}_{inner}_{columns}"
        for kind, vectors in tiles(int(rows), int(columns)):
            heights[kind].add(vectors)
        functions[name] = f"""
static void {name}(const casadi_real* x, const casadi_real* y, const casadi_real* start, casadi_real* z) {{
  kernel_mtimes_from(x, {rows}, {inner}, y, {columns}, start, z);
}}
"""
        return f"{name}({x}, {y}, {start}, {z});"

    after = _PRODUCT.sub(shaped, _PLAIN.sub(r"kernel_mtimes_from(\1, \2, \2);", after))
    assert "kernel_mtimes_from" not in after, "the shapes of products are numbers in generated C"
    for kind, found in heights.items():
        kernel = kernel.replace(f"@heights of {kind}s@", " ".join(f"TILE({height})" for height in sorted(found)))
    return "".join([before, kernel, *functions.values(), after])


def _begin_with(text: str, source: str) -> str:
    """Generated C with a text inserted after its types."""
    at = _REALS.search(source)
    assert at, "generated C defines casadi_int"
    return source[: at.end()] + text + source[at.end() :]
