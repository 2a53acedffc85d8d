"""An optimal-control problem as a layer in PyTorch (extra `torch`).

    plan = OCPLayer(problem)(psi, s0, context)        # plan.states (B, T+1, n_s), plan.actions (B, T, n_u)
    loss(plan.states, plan.actions).backward()        # slopes by psi, s0 and context
    plan.values.sum().backward()                      # the same of the optimal costs (B,)

Backward is one adjoint solve with the KKT matrix per instance: the derivative of the optimum, whatever way the solver
took to it. It cannot be differentiated a second time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch

from kpirl_ocp.bridges.batch import Batch, Policy
from kpirl_ocp.bridges.first_action import with_first_action
from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Guess, Solver
from kpirl_ocp.ocp.problem.statement.checks import shown
from kpirl_ocp.ocp.sensitivity.certificate import Certificate
from kpirl_ocp.ocp.solvers.riccati import Riccati
from kpirl_ocp.pictures import Brief
from kpirl_ocp.types import Solution, Trajectory

Tensor = torch.Tensor


@dataclass(frozen=True, eq=False, repr=False)
class Plan(Brief):
    """A batch of optimal trajectories.

    states: (B, T+1, n_s), actions: (B, T, n_u), in the type of the inputs; functions of psi, s0 and context.
    values: (B,) optimal costs V(s0; psi, context), functions of the same; under the policy "smooth" those with the
        barrier, J - tau sum log(slack).
    solutions: B of them, in float64, each with status and KKT residuals.
    certificates: B of them for each backward pass through this plan, the latest last; empty before the first.
    """

    states: Tensor
    actions: Tensor
    values: Tensor
    solutions: tuple[Solution, ...]
    certificates: list[list[Certificate]] = field(repr=False)

    @property
    def solved(self) -> Tensor:
        """(B,) bool: the solver converged."""
        return torch.tensor([solution.status.ok for solution in self.solutions], device=self.states.device)


class OCPLayer(torch.nn.Module):
    """Solves a batch of OCPs forward, and differentiates their solutions backward.

    Args:
        problem: the OCP; psi, s0 and context are the inputs of the layer.
        solver: any solver of the package.
        policy: of gradients that are not certified: "raise" CertificateError, and SolveError for a solve that fails;
            "mask" leaves the instance out: its gradient is zero, and `Plan.certificates` says why; "smooth" solves and
            differentiates the problem smoothed by a log barrier instead, always.
        barrier: tau of "smooth".
        threads: that solve at the same time; None: one per processor.

    Raises:
        ProblemError: another policy, or a solver that cannot smooth.
    """

    def __init__(
        self,
        problem: OCP,
        solver: Solver | None = None,
        *,
        policy: Policy = "raise",
        barrier: float = 1e-4,
        threads: int | None = None,
    ) -> None:
        super().__init__()
        self.batch = Batch(problem, solver or Riccati(), policy, barrier, threads)

    def forward(
        self,
        psi: Tensor,
        s0: Tensor,
        context: Tensor | None = None,
        guess: Plan | Sequence[Guess] | None = None,
        *,
        u0: Tensor | None = None,
    ) -> Plan:
        """The optimal trajectories.

        Args:
            psi: (B, n_psi), or (n_psi,) for all.
            s0: (B, n_s), or (n_s,) for all.
            context: (B, n_c), or (n_c,) for all; None for a problem without one.
            guess: where to start: a former plan, or B solutions, trajectories or None.
            u0: (B, n_u), or (n_u,) for all: the first action, given and not bounded, so that `Plan.values` are
                state-action values Q(s0, u0), functions of u0, too. None: the best first action.

        Raises:
            ProblemError: shapes that do not fit.
            SolveError: a solve failed; not under the policy "mask".
        """
        batch = self.batch if u0 is None else self._given_action
        sizes = self._sizes
        for name, tensor in zip(sizes, (psi, s0, context, u0), strict=True):
            if not isinstance(tensor, Tensor) and (tensor is not None or name in ("psi", "s0")):
                raise ProblemError(f"{name} must be a tensor, got {shown(tensor)}.")
        context = psi.new_zeros(0) if context is None else context
        given = [psi, s0, context] if u0 is None else [psi, s0, context, u0]
        count = max((len(tensor) for tensor in given if tensor.ndim == 2), default=1)
        rows = [_rows(name, x, count, size) for x, (name, size) in zip(given, sizes.items(), strict=False)]
        guesses = _guesses(batch.problem, guess, count)
        solved: list[Solution] = []
        certificates: list[list[Certificate]] = []
        inputs = (*rows[:2], torch.cat(rows[2:], dim=1))
        states, actions, values = _Solve.apply(batch, guesses, solved, certificates, *inputs)
        return Plan(states, actions, values, tuple(solved), certificates)

    @property
    def _sizes(self) -> dict[str, int]:
        problem = self.batch.problem
        sizes = {"psi": problem.n_parameters, "s0": problem.n_states}
        return sizes | {"context": problem.n_context, "u0": problem.n_stated_actions}

    @cached_property
    def _given_action(self) -> Batch:
        return replace(self.batch, problem=with_first_action(self.batch.problem))

    def extra_repr(self) -> str:
        """The settings."""
        return f"{self.batch.solver}, policy={self.batch.policy!r}"


class _Solve(torch.autograd.Function):
    """(psi, s0, context) -> (states, actions, values)."""

    @staticmethod
    def forward(
        ctx: Any,
        batch: Batch,
        guesses: Sequence[Guess],
        solved: list[Solution],
        certificates: list[list[Certificate]],
        *rows: Tensor,
    ) -> tuple[Tensor, ...]:
        psi, s0, context = (row.detach().cpu().double().numpy() for row in rows)
        solved += batch.solve(psi, s0, context, guesses)
        ctx.batch, ctx.solved, ctx.certificates = batch, solved, certificates
        ctx.types = [(row.dtype, row.device) for row in rows]
        dtype, device = torch.promote_types(rows[0].dtype, rows[1].dtype), rows[0].device
        return tuple(torch.tensor(output, dtype=dtype, device=device) for output in batch.outputs(solved))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *by_outputs: Tensor) -> tuple[Tensor | None, ...]:
        *gradients, certificates = ctx.batch.pull(
            ctx.solved, *(by.detach().cpu().double().numpy() for by in by_outputs)
        )
        ctx.certificates.append(certificates)
        pairs = zip(gradients, ctx.types, strict=True)
        return None, None, None, None, *(torch.tensor(g, dtype=t, device=device) for g, (t, device) in pairs)


def guesses_of(actions: Tensor, states: Tensor) -> list[Trajectory]:
    """Guesses from actions (B, T, n_u) and states (B, T+1, n_s)."""
    pairs = zip(states.detach().cpu().double(), actions.detach().cpu().double(), strict=True)
    return [Trajectory(s.numpy(), u.numpy()) for s, u in pairs]


def _guesses(problem: OCP, guess: Plan | Sequence[Guess] | None, count: int) -> Sequence[Guess]:
    """One for every instance; plans with and without a given first action are guesses for each other by trajectory."""
    if guess is None:
        return [None] * count
    given = len(guess.solutions if isinstance(guess, Plan) else guess)
    if given != count:
        raise ProblemError(f"a batch of {count} needs as many guesses, got {given}.")
    if not isinstance(guess, Plan):
        return guess
    same = [s.multipliers.path_equality.shape[1] == problem.n_path_equality for s in guess.solutions]
    return [s if kept else s.trajectory for s, kept in zip(guess.solutions, same, strict=True)]


def _rows(name: str, tensor: Tensor, count: int, size: int) -> Tensor:
    """(B, size) of a tensor for all or for each. Raises ProblemError for another shape."""
    if tensor.ndim not in (1, 2) or tensor.shape[-1] != size or (tensor.ndim == 2 and len(tensor) != count):
        expected = f"({size},) or ({count}, {size})"
        raise ProblemError(f"{name} must be {expected} for a batch of {count}, got {tuple(tensor.shape)}.")
    if not tensor.is_floating_point():
        raise ProblemError(f"{name} must be of a floating-point type, not {tensor.dtype}.")
    return tensor.expand(count, size)
