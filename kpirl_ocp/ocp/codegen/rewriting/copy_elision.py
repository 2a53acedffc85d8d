"""Generated C with fewer copies: needless moves through memory that CasADi's code generator makes.

    product   w = start; w += x y     becomes  w = start + x y    one pass over w; zeros are not even written
    output    w = ...; res[k] = w     becomes  res[k] = ...       w is another name for the caller's array
    earlier   the same where w is written anew after that         w has another name until then

The results are the same to the last bit. Each concerns one function. The last two need results that overlap neither
each other nor the arguments. CasADi finds places for the results of a call before it frees its arguments; whoever calls
the functions that a file is generated for has to do the same.
"""

from __future__ import annotations

import re

FUNCTION = re.compile(r"^static int (casadi_f\d+)\(const casadi_real\*\* arg.*?^}\n", re.MULTILINE | re.DOTALL)
_START = re.compile(r"^ *casadi_(?:clear\((w\d+), \d+|copy\((\w+), \d+, (w\d+))\);\n", re.MULTILINE)
_OUTPUT = re.compile(r"^ *(?:if \(res\[\d+\]\) )?casadi_copy\((w\d+), \d+, res\[(\d+)\](\+\d+)?\);\n", re.MULTILINE)


def with_fewer_copies(source: str) -> str:
    """Generated C with the first two; products call `kernel_mtimes_from` of `kpirl_ocp.ocp.codegen.kernels`."""
    return FUNCTION.sub(lambda found: _outputs(_products(found[0])), source)


def _products(text: str) -> str:
    """Products into an array that was copied right before, or cleared and not touched since."""
    for found in reversed(list(_START.finditer(text))):
        name, start = found[1] or found[3], found[2] or "0"
        before, after = text[: found.start()], text[found.end() :]
        use = re.search(rf"^.*\b{name}\b.*\n", after, re.MULTILINE)
        product = use and re.fullmatch(rf" *casadi_mtimes_dense\(((?:(?!\b{name}\b).)*), {name}, 0\);\n", use[0])
        if use and product and (found[1] or use.start() == 0):
            fused = f"  kernel_mtimes_from({product[1]}, {start}, {name});\n"
            text = before + after[: use.start()] + fused + after[use.end() :]
    return text


def _outputs(text: str) -> str:
    """Arrays in the work vector that end as an output: not mentioned again after they were copied there."""
    for found in list(_OUTPUT.finditer(text)):
        name, place = found[1], rf"res[{found[2]}] ? res[{found[2]}]{found[3] or ''}"
        before, after = text.split(found[0], maxsplit=1)
        before, renamed = re.subn(rf"\*{name}=(w\+\d+)", rf"*{name}={place} : \1", before)
        if renamed == 1 and not re.search(rf"\b{name}\b", after):
            text = before + after
    return text


def with_earlier_outputs(source: str) -> str:
    """Generated C whose loops are joined, with the last of these replacements."""
    return FUNCTION.sub(lambda found: _earlier_outputs(found[0]), source)


def _earlier_outputs(text: str) -> str:
    """Arrays that end as an output, in memory that the next loop to mention it fills anew."""
    for found in reversed(list(_OUTPUT.finditer(text))):
        name, place = found[1], f"res[{found[2]}]{found[3] or ''}"
        before, _, after = text.partition(found[0])
        declared = re.search(rf"\*{name}=[^,;]*", before)
        use = re.search(rf"^.*\b{name}\b.*$", after, re.MULTILINE)
        if declared and use and use[0] == f"    {name}[i] = entry_{name};":
            earlier = re.sub(rf"\b{name}\b", f"{name}0", before[declared.end() :])  # all names are of one length
            declaration = f"{declared[0]}, *{name}0=res[{found[2]}] ? {place} : {name}"
            text = before[: declared.start()] + declaration + earlier + after
    return text
