"""Claims of the package about its speed, held against the measurements of the same run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from bench.contenders import ALONE, JAX, OURS, TORCH
from bench.control import EXPORTED, FIRST, FIRST_PEER, PEERS, WITHOUT
from bench.control import GRADIENT as PULL
from bench.control import OURS as CONTROL
from bench.export import FLOAT, REAL_TIME
from bench.implicit import BOTH, GRADIENT, SOLVE
from bench.memory import IMPLICIT
from bench.part import Numbers, Table
from bench.qp_peers import HPIPM
from bench.qps import ONE, PEER, SOLVES_ONE, SOLVES_TWO, TIGHT, TWO, WIDE
from bench.real_time import PUBLIC
from bench.solvers import PLAIN, RICCATI, SAME, same_optimum

Results = Mapping[str, Numbers]
_NOTE = "Ratios of medians. The bars are for the full preset: a tiny problem is all overhead."


@dataclass(frozen=True)
class Bar:
    """`measured` should be at most `limit`; None where a peer or a part is missing, or nothing comparable was found."""

    claim: str
    limit: float
    measured: float | None
    unit: str = ""
    note: str = ""

    @property
    def verdict(self) -> str:
        """met, missed or not measured."""
        if self.measured is None:
            return "not measured"
        return "met" if self.measured <= self.limit else "missed"

    @property
    def cells(self) -> list[str]:
        """A row of the table."""
        measured = "" if self.measured is None else f"{self.measured:.3g}{self.unit}"
        return [self.claim, f"{self.limit:.3g}{self.unit}", measured, self.verdict, self.note]


def table(found: list[Bar]) -> Table:
    """All bars, first those that are missed; ratios are those of medians."""
    title = "Bars: what is measured should be at most the bar"
    rows = [bar.cells for bar in sorted(found, key=lambda bar: bar.verdict != "missed")]
    met = sum(bar.verdict == "met" for bar in found)
    return Table(title, ["claim", "bar", "measured", "", "note"], rows, f"{met} of {len(found)} are met. {_NOTE}")


def bars(results: Results) -> list[Bar]:
    """Every claim whose part was run."""
    sources = {
        "control": _control,
        "qps": _qps,
        "hypergradients": _hypergradients,
        "batches": _batches,
        "solvers": _solvers,
        "implicit": _implicit,
        "growth": _growth,
        "memory": _memory,
        "real_time": _real_time,
        "compile_times": _compile_times,
        "export": _export,
    }
    return [bar for part, claims in sources.items() if part in results for bar in claims(results[part])]


def _control(numbers: Numbers) -> Iterator[Bar]:
    for name, found in numbers.items():
        own = found[CONTROL]
        peers = [found[peer] for peer in PEERS if peer in found]
        fastest = min(peers, key=lambda peer: peer["median_ms"], default={"left_out": "no peer took part"})
        if HPIPM in found:
            note = f"{_otherwise(own, found[HPIPM])}; {_ratio(own, fastest):.3g} of the best peer"
            yield Bar(f"{name}: solve / HPIPM", 1.0, _ratio(own, found[HPIPM]), note=note)
        else:
            yield Bar(f"{name}: solve / best peer", 0.5, _ratio(own, fastest), note=_otherwise(own, fastest))
        yield Bar(f"{name}: solve / exported controller", 1.2, _ratio(own, found.get(EXPORTED, {})))
        yield Bar(f"{name}: without a compiler / with one", 10.0, _ratio(found[WITHOUT], own))
        yield Bar(f"{name}: first solve / Ipopt's first", 0.5, found[FIRST] / found[FIRST_PEER])
        yield Bar(f"{name}: gradient and certificate / solve", 0.4, _ratio(found[PULL], own))


def _qps(numbers: Numbers) -> Iterator[Bar]:
    wide, tight = numbers[WIDE], numbers[TIGHT]
    both = f"QPs, {WIDE}: solve and gradient, two threads"
    yield Bar(f"{both} / mpc.pytorch", 0.5, _ratio(wide[TWO], wide[PEER]), note=_otherwise(wide[TWO], wide[PEER]))
    each = 2 * tight[TWO]["median_ms"] / int(tight["count"])
    yield Bar(f"QPs, {TIGHT}: solve and gradient, per problem and thread", 1.0, each, " ms")
    yield Bar(f"{both} / one", 1 / 1.8, _ratio(wide[TWO], wide[ONE]))
    yield Bar(f"QPs, {WIDE}: solves, two threads / one", 1 / 1.8, _ratio(wide[SOLVES_TWO], wide[SOLVES_ONE]))


def _hypergradients(numbers: Numbers) -> Iterator[Bar]:
    for name, results in numbers["paper"].items():
        jax, alone = _fastest(results, JAX), _ratio(results[ALONE], _fastest(results, JAX))
        note = f"{_otherwise(results[OURS], jax)}"
        if alone is not None:
            note += f"; compiled function alone {alone:.2f}"
        yield Bar(f"unrolled / JAX jit ({name})", 0.5, _ratio(results[OURS], jax), note=note)
        torch = results[TORCH]
        yield Bar(
            f"unrolled / torch ({name})", 0.01, _ratio(results[OURS], torch), note=_otherwise(results[OURS], torch)
        )


def _batches(numbers: Numbers) -> Iterator[Bar]:
    for name, results in numbers.items():
        jax = _fastest(results, JAX)
        yield Bar(
            f"demonstrations together / JAX vmap ({name})",
            0.5,
            _ratio(results[OURS], jax),
            note=_otherwise(results[OURS], jax),
        )


def _solvers(numbers: Numbers) -> Iterator[Bar]:
    """The loosest tolerance of ours that ends at the same optimum."""
    for name, results in numbers.items():
        ours = next((label for label in RICCATI.values() if same_optimum(results[label])), None)
        claim, measured = f"bounded solve / Ipopt on plain MX ({name})", None
        note = f"no solve of ours has an objective within {SAME:.0e} of the reference"
        if ours and same_optimum(results[PLAIN]):
            measured = _ratio(_totals(results[ours]), _totals(results[PLAIN]))
            note = f"{ours}; {_otherwise(*(_totals(results[label]) for label in (ours, PLAIN)))}"
        yield Bar(claim, 1 / 25, measured, note=note)


def _implicit(numbers: Numbers) -> Iterator[Bar]:
    for name, results in numbers.items():
        note = f"{_otherwise(results[GRADIENT], results[SOLVE])}; {'' if results['certified'] else 'not '}certified"
        yield Bar(f"implicit gradient / solve ({name})", 0.2, _ratio(results[GRADIENT], results[SOLVE]), note=note)
        yield Bar(
            f"solve and gradient / unrolled, N = {results['N']} ({name})",
            1.0,
            _ratio(results[BOTH], results["unrolled"]),
            note=_otherwise(results[BOTH], results["unrolled"]),
        )


def _growth(numbers: Numbers) -> Iterator[Bar]:
    (short, first), (long, last) = list(numbers.items())[-2:]
    limit = 1.15 * int(long) / int(short)  # 4.6 for a factor of 4
    step = f"T = {short} to {long}"
    yield Bar(f"one iteration, {step}", limit, last["iteration_ms"] / first["iteration_ms"])
    yield Bar(f"implicit gradient, {step}", limit, _ratio(last["gradient"], first["gradient"]))


def _memory(numbers: Numbers) -> Iterator[Bar]:
    few, *_, many = [*numbers["iterations"][IMPLICIT].items()] * 2  # the same, if there is only one
    claim = f"memory of the implicit gradient, {few[0]} to {many[0]} iterations"
    yield Bar(claim, 1.05, many[1] / few[1], note="within 5 %: what memory pages leave uncertain")


def _real_time(numbers: Numbers) -> Iterator[Bar]:
    for name, results in numbers.items():
        note = f"least {results[PUBLIC]['minimum_ms']:.2f} ms; absolute, so it depends on the machine"
        yield Bar(f"real-time iteration ({name})", 1.5, results[PUBLIC]["median_ms"], " ms", note)


def _compile_times(numbers: Numbers) -> Iterator[Bar]:
    for cache, limit in (("empty", 20.0), ("full", 0.5)):
        slowest = max(numbers, key=lambda method: numbers[method][cache]["compile_s"])
        claim = f"compilation in learn_cost.py, {cache} cache"
        yield Bar(claim, limit, numbers[slowest][cache]["compile_s"], " s", f"slowest method: {slowest}")


def _export(numbers: Numbers) -> Iterator[Bar]:
    for horizon, found in numbers.items():
        for build in ("portable", "native"):
            result, claim = found[f"C, {REAL_TIME}, {build}"], f"exported real-time iteration, T = {horizon}, {build}"
            note = f"least {result['minimum_ms']:.2f} ms; absolute, so it depends on the machine"
            short = int(horizon) <= 10
            yield Bar(claim, 0.5 if short else 1.5, result["median_ms"], " ms", note)
            if short:
                yield Bar(f"{claim}, 99 %", 1.0, result["p99_ms"], " ms", note)
    compiled = [result for found in numbers.values() for result in found.values() if "compile_s" in result]
    yield Bar("compilation of an exported controller", 15.0, max(r["compile_s"] for r in compiled), " s")
    yield Bar("library of an exported controller", 400.0, max(r["library_bytes"] for r in compiled) / 1000, " kB")
    shortest = min(numbers, key=int)
    memory = numbers[shortest][f"C, {REAL_TIME}, {FLOAT}"]["bytes"] / 1000
    yield Bar(f"memory of an exported controller, single precision, T = {shortest}", 256.0, memory, " kB")


def _totals(starts: list[Numbers]) -> Numbers:
    """Times, summed over the starts."""
    return {key: sum(start[key] for start in starts) for key in ("median_ms", "minimum_ms", "processor_ms")}


def _fastest(results: Mapping[str, Numbers], names: tuple[str, ...]) -> Numbers:
    """The contender with the lowest median; or, if none took part, why the first did not."""
    present = [results[name] for name in names if "median_ms" in results[name]]
    return min(present, key=lambda numbers: numbers["median_ms"], default=results[names[0]])


def _ratio(ours: Numbers, other: Numbers, key: str = "median_ms") -> float | None:
    return ours[key] / other[key] if key in ours and key in other else None


def _otherwise(ours: Numbers, other: Numbers) -> str:
    """The ratios of minima and of processor times, or why there are none."""
    least, processor = (_ratio(ours, other, key) for key in ("minimum_ms", "processor_ms"))
    if least is None or processor is None:
        return str(other.get("left_out", ""))
    return f"{least:.3g} by minima, {processor:.3g} by processor time"
