"""Several demonstrations at once: ours and JAX `vmap`."""

from __future__ import annotations

from bench.contenders import JAX, OURS
from bench.part import Part, Table
from bench.problem import single
from bench.race import race
from bench.settings import Preset


def measure(preset: Preset) -> Part:
    """Mean loss and gradient over all demonstrations, at the paper's N and T; and ours one by one."""
    count = preset.demonstrations
    numbers, rows = {}, []
    for data in preset.models("relu", count=count):
        results = race(data, (*JAX, OURS), preset)
        alone = race(single(data, 0), (OURS,), preset)[OURS]
        numbers[data.name] = {name: r.numbers for name, r in results.items()} | {"ours, one": alone.numbers}
        rows += [[data.name, name.replace("jit,", "vmap,"), r, f"{r.error:.0e}"] for name, r in results.items()]
        rows.append([data.name, f"ours, one of the {count}", alone, ""])
    note = (
        "One call for all of them; ours with certificates, which may take the steps twice more, JAX's without. The "
        "last row of each model is one demonstration alone."
    )
    title = f"{count} demonstrations together, T = {preset.paper_horizon}, N = {preset.paper_steps}"
    return Part(numbers, [Table(title, ["weights", "", "time [ms]", "difference from ours"], rows, note)])
