"""Generated C whose loops over the entries of arrays are joined.

CasADi writes one loop per operation, and every result goes through memory:

    w2 = w1 * w1,  w3 = 1 - w2     becomes one loop, in which w2 is a number unless it is needed later

A loop is moved to the last one before it of the same length, or that one to it, where nothing in between writes what it
mentions or mentions what it writes. Arrays of a function are the same or do not overlap, and compilers are told so.
What is computed from what stays as CasADi has it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Set
from dataclasses import dataclass

from kpirl_ocp.ocp.codegen.rewriting.copy_elision import FUNCTION

_LOOP = re.compile(r" *for \(i=0, rr=(\w+)(?:, cr=(\w+))?(?:, cs=(\w+))?; i<(\d+); \+\+i\) (?!for)(.*;)")
_ENTRY = re.compile(r"\(?\*(rr|cr|cs)\+\+\)?|(cs)\[i\]")
_FILL = re.compile(r" *casadi_fill\((\w+), (\d+), ([^;]+)\);")
_OPERATION = re.compile(r"entry_(\w+) *(\S*)= *(.*)")
# Statements that assign one pointer, number or array; others may do anything.
_ASSIGNMENT = re.compile(r" *(?:(w\w+) = .*|(?:kernel_\w+|casadi_copy)\(.*, (\w+)\));")
_NAME = re.compile(r"\bwr?\d+\b")
_COMMENT = re.compile(r" */\* #\d+: .*?\*/\n", re.DOTALL)


@dataclass
class _Step:
    """A statement, or a loop.

    lines: the statement, or operations in which `entry_w1` stands for an entry of w1.
    names: what it mentions. writes: what it writes; nothing if that is not known.
    length: number of rounds; None for a statement.
    """

    lines: list[str]
    names: set[str]
    writes: set[str]
    length: str | None = None

    def commutes(self, other: _Step) -> bool:
        """True if the two may change places."""
        known = self.writes and other.writes
        return bool(known) and not (self.writes & other.names or self.names & other.writes)


def with_joined_loops(source: str) -> str:
    """Generated C in which the loops of each function are joined."""
    return FUNCTION.sub(lambda found: _joined(_COMMENT.sub("", found[0])), source)


def _joined(function: str) -> str:
    steps: list[_Step] = []
    for step in map(_read, function.splitlines()):
        _add(steps, step)
    last = {name: i for i, step in enumerate(steps) for name in step.names}
    later = [{name for name in step.names if last[name] > i} for i, step in enumerate(steps)]
    return "".join(f"{line}\n" for i, step in enumerate(steps) for line in _written(step, function, later[i]))


def _add(steps: list[_Step], step: _Step) -> None:
    """Append a step, or join a loop with the last one of its length: there, or else here."""
    alike = (i for i in reversed(range(len(steps))) if steps[i].length == step.length)
    at = next(alike, None) if step.length else None
    if at is not None:
        earlier, between = steps[at], steps[at + 1 :]
        both = _Step(earlier.lines + step.lines, earlier.names | step.names, earlier.writes | step.writes, step.length)
        if all(map(step.commutes, between)):
            steps[at] = both
            return
        if all(map(earlier.commutes, between)):
            steps[at:] = [*between, both]
            return
    steps.append(step)


def _read(line: str) -> _Step:
    """The step of a line."""
    names = set(_NAME.findall(line))
    if found := _LOOP.fullmatch(line):
        arrays = dict(zip(("rr", "cr", "cs"), found.groups(), strict=False))
        operation = _ENTRY.sub(lambda entry: f"entry_{arrays[entry[1] or entry[2]]}", found[5])
        return _Step([operation], names, {found[1]}, found[4])
    if found := _FILL.fullmatch(line):
        return _Step([f"entry_{found[1]} = {found[3]};"], names, {found[1]}, found[2])
    found = _ASSIGNMENT.fullmatch(line)
    return _Step([line], names, {found[1] or found[2]} if found else set())


def _written(step: _Step, function: str, later: Set[str]) -> Iterator[str]:
    """Its lines. Entries of the work vector stay numbers, but for those that a later step mentions."""
    if step.length is None:
        yield from step.lines
        return
    loaded: dict[str, None] = {}
    computed: dict[str, None] = {}
    for target, operator, value in (found.groups() for found in map(_OPERATION.fullmatch, step.lines) if found):
        read = [target] * bool(operator) + re.findall(r"\bentry_(\w+)", value)
        loaded |= dict.fromkeys(name for name in read if name not in computed)
        computed[target] = None
    names = [f"entry_{name} = {name}[i]" for name in loaded]
    names += [f"entry_{name}" for name in computed if name not in loaded]
    yield f'  _Pragma("GCC ivdep")\n  for (casadi_int i=0; i<{step.length}; ++i) {{'  # CasADi's fill has no i
    yield f"    casadi_real {', '.join(names)};"
    yield from (f"    {line}" for line in step.lines)
    for name in computed:
        if f"*{name}=w+" not in function or name in later:
            yield f"    {name}[i] = entry_{name};"
    yield "  }"
