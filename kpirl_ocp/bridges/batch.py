"""Solves and sensitivities of a batch in parallel threads: what the layers for PyTorch and JAX have in common."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np

from kpirl_ocp.bridges.values import value_of, value_slopes
from kpirl_ocp.errors import ProblemError, SolveError
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import BarrierSolver, Guess, Solver, StageDerivatives, solve_and_linearise
from kpirl_ocp.ocp.sensitivity.certificate import Certificate, check_policy
from kpirl_ocp.ocp.sensitivity.solution_sensitivity import sensitivity
from kpirl_ocp.types import Array, Solution

Policy = Literal["raise", "mask", "smooth"]
R = TypeVar("R")


class Solved(NamedTuple):
    """One solution, and the derivatives with which its sensitivity begins."""

    solution: Solution
    derivatives: StageDerivatives | None


@dataclass(frozen=True, eq=False)
class Batch:
    """A problem and how to solve and differentiate many of its instances.

    problem: the OCP.
    solver: any solver; the policy "smooth" needs one for the smoothed problem (Riccati, Ipopt).
    policy: of gradients that are not certified: "raise" an error; "mask" leaves the instance out, with a gradient of
        zero and its certificate to tell; "smooth" solves and differentiates the problem smoothed by a log barrier
        instead, always, so that trajectories and gradients agree.
    barrier: tau of "smooth".
    threads: that work at the same time; None: one per processor.

    Raises ProblemError for another policy, or a solver that cannot smooth.
    """

    problem: OCP
    solver: Solver
    policy: Policy
    barrier: float
    threads: int | None

    def __post_init__(self) -> None:
        check_policy(self.policy, ("raise", "mask", "smooth"))
        if self.policy == "smooth":
            if not isinstance(self.solver, BarrierSolver) or not self.barrier > 0:
                raise ProblemError(
                    "policy='smooth' needs barrier > 0 and a solver for the smoothed problem: Riccati() or Ipopt()."
                )
            object.__setattr__(self, "solver", self.solver.with_barrier(self.barrier))

    def __getstate__(self) -> dict[str, Any]:
        """For copies and files: threads are not part of them."""
        return {name: value for name, value in vars(self).items() if name != "_pool"}

    def solve(self, psi: Array, s0: Array, context: Array, guesses: Sequence[Guess]) -> list[Solved]:
        """Solve for psi (B, n_psi), s0 (B, n_s) and context (B, n_c), starting at the guesses.

        Raises SolveError for a solve that failed, unless the policy is "mask".
        """

        def one(s0: Array, psi: Array, context: Array, guess: Guess) -> Solved:
            return Solved(*solve_and_linearise(self.solver, self.problem, s0, psi, context, guess))

        solved = self._map(one, s0, psi, context, guesses)
        failed = [(index, found.solution) for index, found in enumerate(solved) if not found.solution.status.ok]
        if failed and self.policy != "mask":
            index, solution = failed[0]
            raise SolveError(f"{len(failed)} of {len(solved)} solves failed; number {index}: {solution}")
        return solved

    def outputs(self, solved: Sequence[Solved]) -> tuple[Array, Array, Array]:
        """States (B, T+1, n_s), actions (B, T, n_u) and optimal costs (B,)."""
        plans = [found.solution for found in solved]
        values = [value_of(self.problem, plan) for plan in plans]
        return np.array([plan.states for plan in plans]), np.array([plan.actions for plan in plans]), np.array(values)

    def pull(
        self, solved: Sequence[Solved], by_states: Array, by_actions: Array, by_values: Array
    ) -> tuple[Array, Array, Array, list[Certificate]]:
        """Gradients by psi (B, n_psi), s0 (B, n_s) and context (B, n_c), each with its certificate.

        Args:
            solved: of `solve`.
            by_states: slopes of a function of the trajectories (B, T+1, n_s).
            by_actions: the same by actions (B, T, n_u).
            by_values: the same by the optimal costs (B,).

        Raises:
            CertificateError: a gradient is not certified, unless the policy is "mask"; then it is zero.
        """
        policy: Literal["raise", "flag"] = "flag" if self.policy == "mask" else "raise"

        def one(found: Solved, states: Array, actions: Array, value: float) -> Any:
            plan = sensitivity(self.problem, found.solution, policy, found.derivatives).pull(states, actions)
            total = [plan.psi, plan.s0, plan.context]
            if value:
                slopes = value_slopes(self.problem, found.solution)
                total = [part + value * slope for part, slope in zip(total, slopes, strict=True)]
            return *total, plan.certificate

        *gradients, certificates = zip(*self._map(one, solved, by_states, by_actions, by_values), strict=True)
        kept = np.array([certificate.certified for certificate in certificates])[:, None]
        psi, s0, context = (np.where(kept, np.array(rows), 0.0) for rows in gradients)
        return psi, s0, context, list(certificates)

    def _map(self, function: Callable[..., R], *columns: Iterable[Any]) -> list[R]:
        return list(self._pool.map(function, *columns))

    @cached_property
    def _pool(self) -> ThreadPoolExecutor:
        """Threads that stay, because each keeps its own memory and functions of the problem."""
        return ThreadPoolExecutor(self.threads or os.cpu_count(), thread_name_prefix="ocp")
