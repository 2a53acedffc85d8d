"""Generated C with fewer copies: what CasADi's code generator moves in memory although it need not.

    product    w = start; w += x y     becomes  w = start + x y, one pass over w; zeros are not even written
    output     w = ..; res[k] = w      becomes  res[k] = .., with w another name for the place that the caller wants

Both concern one function at a time. The second holds because a caller within the same file never hands over one place
as argument and as result; for functions that others call, nothing is assumed.
"""

from __future__ import annotations

import re

_FUNCTION = re.compile(r"^static int (casadi_f\d+)\(const casadi_real\*\* arg.*?^}\n", re.MULTILINE | re.DOTALL)
_ENTRY = re.compile(r"return (casadi_f\d+)\(arg, res, iw, w, mem\);")
_START = re.compile(r"^ *casadi_(?:clear\((w\d+), \d+|copy\((\w+), \d+, (w\d+))\);\n", re.MULTILINE)
_OUTPUT = re.compile(r"^  (?:if \(res\[\d+\]\) )?casadi_copy\((w\d+), \d+, res\[(\d+)\](\+\d+)?\);\n", re.MULTILINE)


def with_fewer_copies(source: str) -> str:
    """The same functions, with the same results to the last bit."""
    entries = set(_ENTRY.findall(source))

    def shorter(function: re.Match[str]) -> str:
        text = _products(function[0])
        return text if function[1] in entries else _outputs(text)

    return _FUNCTION.sub(shorter, source)


def _products(text: str) -> str:
    """Products that begin with what was copied or cleared for them."""
    for found in reversed(list(_START.finditer(text))):
        name, start = found[1] or found[3], found[2] or "0"
        before, after = text[: found.start()], text[found.end() :]
        use = re.search(rf"^.*\b{name}\b.*\n", after, re.MULTILINE)
        product = use and re.fullmatch(rf" *casadi_mtimes_dense\(((?:(?!\b{name}\b).)*), {name}, 0\);\n", use[0])
        if use and product and (start == "0" or use.start() == 0):
            fused = f"  casadi_mtimes_from({product[1]}, {start}, {name});\n"
            text = before + after[: use.start()] + fused + after[use.end() :]
    return text


def _outputs(text: str) -> str:
    """Arrays of the work vector that are copied to an output once and not used after that."""
    for found in list(_OUTPUT.finditer(text)):
        name, index, offset = found[1], found[2], found[3] or ""
        place = rf"\*{name}=(w\+\d+)"
        if len(re.findall(rf"\b{name}\b", text[text.index(found[0]) :])) > 1 or not re.search(place, text):
            continue
        text = text.replace(found[0], "")
        text = re.sub(place, rf"*{name}=res[{index}] ? res[{index}]{offset} : \1", text, count=1)
    return text
