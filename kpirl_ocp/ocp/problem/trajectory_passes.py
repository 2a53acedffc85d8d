"""Passes along trajectories: the rollout, its tangent, and the adjoint with its own tangent.

    rollout          s_{t+1} = f(s_t, u_t)
    tangent          ds_{t+1} = f_s ds_t + f_u du_t,                            ds_0 = 0
    adjoint          lambda_t = q_t + f_s^T lambda_{t+1},                       lambda_T = q_T
    adjoint tangent  mu_t = q_t + f_s^T mu_{t+1} + (lambda_{t+1} . f)_sx dx_t,  mu_T = q_T

With q the derivatives of a cost along the trajectory, r_t + f_u^T lambda_{t+1} is its gradient in the actions. B
trajectories run side by side: the columns of an array (n, T B) are ordered by time, then by trajectory.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple, Protocol

import casadi as ca

from kpirl_ocp.ocp.problem.dynamics import DynamicsDerivatives

Memory = tuple[ca.MX, ...]
"""Whatever a pass wants to hand to a later one: arrays (n, T B)."""


class Rollout(NamedTuple):
    """States (n_s, (T+1) B), actions (n_u, T B), and what the derivatives want to know beside them."""

    states: ca.MX
    actions: ca.MX
    memory: Memory


class Adjoint(NamedTuple):
    """Costates lambda_1 .. lambda_T (n_s, T B), f_u^T lambda (n_u, T B) and sum_t f_psi^T lambda (n_psi, B).

    memory: what the adjoint's tangent wants to know of the costates.
    """

    costates: ca.MX
    by_actions: ca.MX
    by_parameters: ca.MX
    memory: Memory


class Sweeps(Protocol):
    """The four passes as expressions; psi is (n_psi, B)."""

    def rollout(self, s0: ca.MX, actions: ca.MX, psi: ca.MX) -> Rollout:
        """Of s0 (n_s, B) and actions (n_u, T B)."""
        ...

    def tangent(self, at: Rollout, psi: ca.MX, dU: ca.MX) -> ca.MX:
        """dS (n_s, (T+1) B) for dU (n_u, T B)."""
        ...

    def adjoint(self, at: Rollout, psi: ca.MX, Q: ca.MX) -> Adjoint:
        """For q_0 .. q_T as Q (n_s, (T+1) B)."""
        ...

    def adjoint_tangent(self, at: Rollout, psi: ca.MX, memory: Memory, dS: ca.MX, dU: ca.MX, Q: ca.MX) -> Adjoint:
        """How `adjoint` changes along (dS, dU), when its q changes by Q; `memory` is that of `adjoint`."""
        ...


@dataclass(frozen=True, eq=False)
class StageSweeps:
    """The passes of any dynamics, from the derivatives of one stage; nothing beside the trajectory is remembered."""

    dynamics: ca.Function
    derivatives: DynamicsDerivatives
    horizon: int
    columns: int

    def rollout(self, s0: ca.MX, actions: ca.MX, psi: ca.MX) -> Rollout:
        """See `Sweeps`."""
        (states,) = self._along(self.dynamics, s0, actions, psi)
        return Rollout(ca.horzcat(s0, states), actions, ())

    def tangent(self, at: Rollout, psi: ca.MX, dU: ca.MX) -> ca.MX:
        """See `Sweeps`."""
        zero = ca.MX.zeros(self.dynamics.size1_in(0), self.columns)
        return ca.horzcat(zero, *self._along(self._tangent, zero, *self._points(at), psi, dU))

    def adjoint(self, at: Rollout, psi: ca.MX, Q: ca.MX) -> Adjoint:
        """See `Sweeps`."""
        return self._backwards(self._adjoint, Q, *self._points(at), psi)

    def adjoint_tangent(self, at: Rollout, psi: ca.MX, memory: Memory, dS: ca.MX, dU: ca.MX, Q: ca.MX) -> Adjoint:
        """See `Sweeps`."""
        direction = dS[:, : dU.size2()], dU
        return self._backwards(self._adjoint_tangent, Q, *self._points(at), psi, *memory, *direction)

    def _along(self, stage: ca.Function, start: ca.MX, *inputs: ca.MX, backwards: bool = False) -> list[ca.MX]:
        return along(stage.map(self.columns), start, inputs, self.horizon, backwards)

    def _backwards(self, stage: ca.Function, Q: ca.MX, *inputs: ca.MX) -> Adjoint:
        """Accumulate a stage (lambda, q, ...) -> lambda, f_u^T lambda, f_psi^T lambda from the last to the first."""
        B = self.columns
        swept, by_actions, by_parameters = self._along(stage, Q[:, -B:], Q[:, :-B], *inputs, backwards=True)
        costates = ca.horzcat(swept[:, B:], Q[:, -B:])
        return Adjoint(costates, by_actions, sum_blocks(by_parameters, B), memory=(costates,))

    def _points(self, at: Rollout) -> tuple[ca.MX, ca.MX]:
        return at.states[:, : at.actions.size2()], at.actions

    @cached_property
    def _symbols(self) -> tuple[ca.MX, ...]:
        """s, u, psi, lambda, ds, du, mu, q."""
        s, u, psi = (self.dynamics.size1_in(i) for i in range(3))
        sizes = {"s": s, "u": u, "psi": psi, "lam": s, "ds": s, "du": u, "mu": s, "q": s}
        return tuple(ca.MX.sym(name, size) for name, size in sizes.items())

    @cached_property
    def _tangent(self) -> ca.Function:
        s, u, psi, _, ds, du, *_ = self._symbols
        return ca.Function("tangent", [ds, s, u, psi, du], [self.derivatives.jvp(s, u, psi, ds, du)])

    @cached_property
    def _adjoint(self) -> ca.Function:
        s, u, psi, lam, _, _, _, q = self._symbols
        by_s, by_u, by_psi = self.derivatives.vjp(s, u, psi, lam)
        return ca.Function("adjoint", [lam, q, s, u, psi], [q + by_s, by_u, by_psi])

    @cached_property
    def _adjoint_tangent(self) -> ca.Function:
        s, u, psi, lam, ds, du, mu, q = self._symbols
        pulled = ca.vertcat(*self.derivatives.vjp(s, u, psi, lam))
        moved = ca.jtimes(pulled, ca.vertcat(s, u, lam), ca.vertcat(ds, du, mu))
        by_s, by_u, by_psi = ca.vertsplit(moved, [0, s.numel(), s.numel() + u.numel(), moved.numel()])
        return ca.Function("adjoint_tangent", [mu, q, s, u, psi, lam, ds, du], [q + by_s, by_u, by_psi])


def reverse(array: ca.MX, width: int) -> ca.MX:
    """The blocks of `width` columns in opposite order."""
    if width == 1:
        return array[:, ::-1]
    return ca.horzcat(*reversed(ca.horzsplit(array, width)))


def sum_blocks(array: ca.MX, width: int) -> ca.MX:
    """The sum of all blocks of `width` columns."""
    rows = array.size1()
    return ca.reshape(ca.sum2(ca.reshape(array, rows * width, array.size2() // width)), rows, width)


def along(
    stage: ca.Function, start: ca.MX, inputs: Sequence[ca.MX], steps: int, backwards: bool = False
) -> list[ca.MX]:
    """Carry the first output of a stage to its first input, from the first to the last block or from the last on.

    Inputs and outputs (n, T B) are ordered by time either way; an input (n, B) is the same at every step. What
    `mapaccum` does, but with a single copy. Many steps are taken in groups, with a copy more: compilers take more than
    twice the time for a function of twice the length.
    """
    size = 1 if steps <= _ALONE else math.isqrt(steps)
    ends = [*range(0, steps, size), steps]
    lengths = [end - begin for begin, end in pairwise(ends)]
    same = [array.size2() == start.size2() for array in inputs]
    groups = {length: stage if size == 1 else _group(stage, length, backwards, same) for length in lengths}
    blocks = [
        [array] * len(lengths) if alike else ca.horzsplit(array, [end * (array.size2() // steps) for end in ends])
        for array, alike in zip(inputs, same, strict=True)
    ]
    rows: list[list[ca.MX]] = [[] for _ in lengths]
    for i in reversed(range(len(lengths))) if backwards else range(len(lengths)):
        outputs = groups[lengths[i]].call([start, *(block[i] for block in blocks)])
        start, rows[i] = outputs[0], outputs if size == 1 else outputs[1:]
    return [ca.horzcat(*column) for column in zip(*rows, strict=True)]


def _group(stage: ca.Function, length: int, backwards: bool, same: Sequence[bool]) -> ca.Function:
    """Some steps: (carried, inputs as for `along`) -> what is carried on, and all outputs side by side."""
    start, *inputs = stage.mx_in()
    widths = [array.size2() * (1 if alike else length) for array, alike in zip(inputs, same, strict=True)]
    wide = [ca.MX.sym("x", array.size1(), width) for array, width in zip(inputs, widths, strict=True)]
    outputs = along(stage, start, wide, length, backwards)
    width = start.size2()
    carried = outputs[0][:, :width] if backwards else outputs[0][:, -width:]
    return ca.Function("group", [start, *wide], [carried, *outputs])


_ALONE = 32  # so many steps, and no more, are written out one by one
