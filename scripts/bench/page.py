"""The page docs/results/benchmark.md and the README's table, written from the numbers of one run."""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

from bench.control import OURS, PEERS
from bench.part import Numbers, Table

ROOT = Path(__file__).parents[2]
PAGE, FIGURE, README = (ROOT / name for name in ("docs/results/benchmark.md", "docs/images/benchmark.png", "README.md"))
_PROSE = Path(__file__).with_name("page.md")
_MARKS = "<!-- benchmark -->", "<!-- end of benchmark -->"
_DESCRIPTIONS = {
    "control": "Ordinary control problems",
    "qps": "Many QPs at once",
    "implicit": "The implicit gradient beside its solve",
    "hypergradients": "The paper's network, unrolled",
    "batches": "Several demonstrations",
    "solvers": "Solvers on the paper's network",
    "growth": "Long horizons",
    "real_time": "The real-time iteration",
    "export": "Exported controllers",
    "memory": "Memory",
    "compile_times": "Compilation",
    "iiwa": "The iiwa",
    "ceilings": "Ceilings of the machine",
}


def write(tables: Mapping[str, Sequence[Table]], bars: Table, results: Mapping[str, Numbers], figure: Path) -> None:
    """All of these; parts that were not run are left out of the page, and without `control` the README stays."""
    parts = [
        f"## {title}\n\n" + "\n\n".join(map(str, tables[name]))
        for name, title in _DESCRIPTIONS.items()
        if name in tables
    ]
    picture = f"![Parts of the benchmark that are drawn, one panel each](../images/{FIGURE.name})"
    heading, where = _PROSE.read_text().split("<!-- tables -->")
    PAGE.write_text("\n\n".join([heading.strip(), str(bars), picture, where.strip(), *parts]) + "\n")
    shutil.copyfile(figure, FIGURE)
    if "control" in results:
        README.write_text(in_readme(README.read_text(), results["control"]))


def in_readme(text: str, control: Numbers) -> str:
    """The README with its table renewed, between two comments. Raises ValueError where they are missing."""
    begin, end = map(re.escape, _MARKS)
    pattern = re.compile(f"{begin}.*?{end}", re.DOTALL)
    if not pattern.search(text):
        raise ValueError(f"README.md has no lines {' and '.join(_MARKS)}.")
    return pattern.sub(lambda _: f"{_MARKS[0]}\n{readme_table(control)}\n{_MARKS[1]}", text)


def readme_table(control: Numbers) -> str:
    """Milliseconds of every problem, a column each; the fastest peer by name."""
    header = ["", *control]
    ours = ["`Riccati`", *(_two_digits(found[OURS]["median_ms"]) for found in control.values())]
    peers = ["fastest peer", *(_peer(found) for found in control.values())]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (header, ["---"] * len(header), ours, peers))


def _peer(found: Numbers) -> str:
    peer = fastest_peer(found)
    return "" if peer is None else f"{_two_digits(found[peer]['median_ms'])} ({peer.split(',')[0]})"


def _two_digits(number: float) -> str:
    return f"{float(f'{number:.2g}'):g}"


def fastest_peer(found: Numbers) -> str | None:
    """The peer with the lowest median among those that took part."""
    return min((name for name in PEERS if name in found), key=lambda name: found[name]["median_ms"], default=None)
