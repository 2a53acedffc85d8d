"""Solves and sensitivities of a batch over threads: what the layers for PyTorch and JAX have in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from kpirl_ocp.bridges.values import value_of, value_slopes
from kpirl_ocp.errors import ProblemError, SolveError
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import BarrierSolver, Guess, Solver
from kpirl_ocp.ocp.sensitivity.certificate import Certificate, check_policy
from kpirl_ocp.ocp.solvers.many import pull_many, solve_many
from kpirl_ocp.types import Array, Solution

Policy = Literal["raise", "mask", "smooth"]


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

    def solve(self, psi: Array, s0: Array, context: Array, guesses: Sequence[Guess]) -> list[Solution]:
        """Solve for psi (B, n_psi), s0 (B, n_s) and context (B, n_c), starting at the guesses.

        Raises SolveError for a solve that failed, unless the policy is "mask".
        """
        solved = solve_many(self.problem, s0, psi, context, guesses, self.solver, self.threads)
        failed = [(index, solution) for index, solution in enumerate(solved) if not solution.status.ok]
        if failed and self.policy != "mask":
            index, solution = failed[0]
            raise SolveError(f"{len(failed)} of {len(solved)} solves failed; number {index}: {solution}")
        return solved

    def outputs(self, plans: Sequence[Solution]) -> tuple[Array, Array, Array]:
        """States (B, T+1, n_s), actions (B, T, n_u) and optimal costs (B,)."""
        values = [value_of(self.problem, plan) for plan in plans]
        return np.array([plan.states for plan in plans]), np.array([plan.actions for plan in plans]), np.array(values)

    def pull(
        self, plans: Sequence[Solution], by_states: Array, by_actions: Array, by_values: Array
    ) -> tuple[Array, Array, Array, list[Certificate]]:
        """Gradients by psi (B, n_psi), s0 (B, n_s) and context (B, n_c), each with its certificate.

        Args:
            plans: of `solve`.
            by_states: slopes of a function of the trajectories (B, T+1, n_s).
            by_actions: the same by actions (B, T, n_u).
            by_values: the same by the optimal costs (B,).

        Raises:
            CertificateError: a gradient is not certified, unless the policy is "mask"; then it is zero.
        """
        policy: Literal["raise", "flag"] = "flag" if self.policy == "mask" else "raise"
        found = pull_many(self.problem, plans, by_states, by_actions, policy, self.threads)
        gradients = [np.array([getattr(each, name) for each in found]) for name in ("psi", "s0", "context")]
        for i in np.flatnonzero(by_values).tolist():
            for rows, slope in zip(gradients, value_slopes(self.problem, plans[i]), strict=True):
                rows[i] += by_values[i] * slope
        certificates: list[Certificate] = [each.certificate for each in found]
        kept = np.array([certificate.certified for certificate in certificates])[:, None]
        psi, s0, context = (np.where(kept, rows, 0.0) for rows in gradients)
        return psi, s0, context, certificates
