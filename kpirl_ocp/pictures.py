"""The pictures that results show in a notebook, the text that records show in a console, and the style of all figures.

matplotlib takes as long to import as the rest of the package, so it is loaded when something is drawn.
"""

from __future__ import annotations

import html
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from importlib import import_module
from types import FunctionType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's palette, legible for colour-blind readers.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
GREY = "#888888"
_FEW = 8  # numbers that a text shows

# Sizes in points for figures of at most PAGE inches, which are shown as wide as they are.
PAGE = 10.0
STYLE: Mapping[str, Any] = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.labelsize": 9,
    "legend.fontsize": 8,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "grid.alpha": 0.3,
    "lines.linewidth": 1.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.prop_cycle": "cycler('color', ['{}'])".format("', '".join(COLOURS)),
    "figure.constrained_layout.h_pad": 0.1,  # [inch], so that no title touches the panel above
    "svg.hashsalt": "kpirl_ocp",  # the same figure gives the same file
}
_PLAIN = 1e-3, 1e4  # logarithmic axes within these limits have plain numbers
_MOST_LINES = 10  # with a legend entry each


@dataclass(frozen=True)
class Panel:
    """Numbers over time: values (n, k), a line each.

    names: (k,) of the lines. stairs: values hold until the next step, as actions do. log: logarithmic values.
    """

    title: str
    values: NDArray[np.float64]
    names: Sequence[str] = ()
    xlabel: str = "time step t"
    stairs: bool = False
    log: bool = False


@lru_cache(maxsize=1)
def figure_class() -> type[Figure]:
    """matplotlib's Figure, which a notebook shows without pyplot, too."""

    class Picture(import_module("matplotlib.figure").Figure):  # type: ignore[misc]
        def _repr_svg_(self) -> str:
            return svg(self)

    return Picture


@lru_cache(maxsize=1)
def _plain_numbers() -> type[Any]:
    """Labels of logarithmic axes where matplotlib has them, but as 60 and 0.2, not as 6 x 10^1 and 2 x 10^-1."""

    class Plain(import_module("matplotlib.ticker").LogFormatterSciNotation):  # type: ignore[misc]
        def __call__(self, x: float, pos: int | None = None) -> str:
            return f"{x:g}" if super().__call__(x, pos) else ""

    return Plain


def write_out_numbers(figure: Figure) -> None:
    """Plain numbers on logarithmic axes that hold no very small or large ones, unless they have labels of their own."""
    own = import_module("matplotlib.ticker").LogFormatterSciNotation
    for axis in (axis for axes in figure.axes for axis in (axes.xaxis, axes.yaxis)):
        low, high = sorted(axis.get_view_interval())
        if low >= _PLAIN[0] and high <= _PLAIN[1] and type(axis.get_major_formatter()) is own:
            axis.set_major_formatter(_plain_numbers()())
            axis.set_minor_formatter(_plain_numbers()(labelOnlyBase=False))


def draw(panels: Sequence[Panel], width: float = 3.6, height: float = 2.5) -> Figure:
    """One set of axes per panel, side by side."""
    with import_module("matplotlib").rc_context(dict(STYLE)):
        figure = figure_class()(figsize=(width * len(panels), height), layout="constrained")
        for axes, panel in zip(np.ravel(figure.subplots(1, len(panels))), panels, strict=True):
            _draw_panel(axes, panel)
        write_out_numbers(figure)
    return figure


def _draw_panel(axes: Axes, panel: Panel) -> None:
    values = np.asarray(panel.values, float).reshape(len(panel.values), -1)
    names = list(panel.names) or [f"{panel.title[0]}{i}" for i in range(values.shape[1])]
    for index, (line, name) in enumerate(zip(values.T, names, strict=True)):
        style = {"color": COLOURS[index % len(COLOURS)], "ls": ("-", "--", ":")[index // len(COLOURS) % 3]}
        if panel.stairs:
            axes.stairs(line, label=name, baseline=None, **style)
        else:
            axes.plot(line, label=name, **style)
    axes.grid(True)
    axes.set(title=panel.title, xlabel=panel.xlabel, yscale="log" if panel.log else "linear")
    if 1 < values.shape[1] <= _MOST_LINES:
        axes.legend(ncols=2 if values.shape[1] > 4 else 1)


def svg_file(figure: Figure) -> str:
    """The content of a file with the figure; the same figure gives the same content."""
    write_out_numbers(figure)
    buffer = io.StringIO()
    with import_module("matplotlib").rc_context(dict(STYLE)):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def svg(figure: Figure) -> str:
    """The figure as an element to put into a page; it shrinks with the page."""
    text = svg_file(figure)
    return text[text.index("<svg") :].replace("<svg ", '<svg style="max-width: 100%; height: auto" ', 1)


def card(headline: str, facts: Mapping[str, str], picture: str) -> str:
    """HTML: a headline, a table of facts, and a picture."""
    rows = "".join(f"<tr><td>{html.escape(k)}</td><td>{html.escape(v)}</td></tr>" for k, v in facts.items())
    return f"<div><strong>{html.escape(headline)}</strong><table>{rows}</table>{picture}</div>"


class Brief:
    """For dataclasses with `repr=False`: their text has the shapes of arrays, and the numbers of short ones."""

    def __repr__(self) -> str:
        shown = [f"{field.name}={brief(getattr(self, field.name))}" for field in fields(self) if field.repr]  # type: ignore[arg-type]
        return f"{type(self).__name__}({', '.join(shown)})"


def brief(value: Any) -> str:
    """The text of a value: shapes of arrays, and the numbers of short ones; of functions their names."""
    if isinstance(value, FunctionType):
        return value.__qualname__
    if hasattr(value, "shape"):
        shape = tuple(value.shape)
        short = math.prod(shape) <= _FEW and 0 not in shape[:-1] + shape[1:]
        return str(value.tolist()) if short else f"<array {shape}>"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{name!r}: {brief(part)}" for name, part in value.items()) + "}"
    if isinstance(value, list | tuple) and len(value) > 1:
        return f"<{len(value)} {type(value[0]).__name__}>"
    return repr(value)
