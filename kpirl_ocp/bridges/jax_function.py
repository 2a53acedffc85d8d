"""An optimal-control problem as a differentiable function in JAX.

    plan = ocp_function(problem)
    states, actions, value = plan(psi, s0, context)   # under jit, grad and vmap

Solves run outside JAX (`jax.pure_callback`), a batch over threads; needs `jax.config.update("jax_enable_x64",
True)` for float64, without which numbers are rounded to float32 on the way in and out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from kpirl_ocp.bridges.batch import Batch, Policy
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import Solver
from kpirl_ocp.ocp.solvers.riccati import Riccati
from kpirl_ocp.types import Array, Solution

Plan = Callable[[jax.Array, jax.Array, jax.Array], tuple[jax.Array, ...]]


def ocp_function(
    problem: OCP,
    solver: Solver | None = None,
    *,
    policy: Policy = "raise",
    barrier: float = 1e-4,
    threads: int | None = None,
) -> Plan:
    """(psi (n_psi,), s0 (n_s,), context (n_c,)) -> states (T+1, n_s), actions (T, n_u), the optimal cost.

    It has a reverse derivative, of first order.

    Args:
        problem: the OCP.
        solver: any solver of the package; by default Riccati().
        policy: of solves that fail and gradients that are not certified: "raise" an error, which JAX passes on as a
            JaxRuntimeError; "mask" gives them a gradient of zero; "smooth" as in `kpirl_ocp.bridges.batch.Batch`.
        barrier: tau of "smooth".
        threads: that solve a batch of `jax.vmap`; None: one per processor.

    Raises:
        ProblemError: another policy, or a solver that cannot smooth.
    """
    batch = Batch(problem, solver or Riccati(), policy, barrier, threads)
    sizes = problem.n_parameters, problem.n_states, problem.n_context
    steps = problem.horizon

    def solved(given: tuple[Array, ...]) -> tuple[tuple[int, ...], list[Solution]]:
        """The leading axes of a batch, and its solutions."""
        lead, (psi, s0, context) = _rows(given, sizes)
        return lead, batch.solve(psi, s0, context, [None] * len(psi))

    def solve(*given: Array) -> tuple[Array, ...]:
        lead, solutions = solved(given)
        outputs = batch.outputs(solutions)
        return _like(given[0], *(output.reshape((*lead, *output.shape[1:])) for output in outputs))

    def pull(psi: Array, s0: Array, context: Array, *by_outputs: Array) -> tuple[Array, ...]:
        lead, solutions = solved((psi, s0, context))
        slopes = (np.asarray(x, float).reshape((len(solutions), *np.shape(x)[len(lead) :])) for x in by_outputs)
        *gradients, _ = batch.pull(solutions, *slopes)
        return _like(psi, *(g.reshape(*lead, g.shape[1]) for g in gradients))

    @jax.custom_vjp
    def plan(psi: jax.Array, s0: jax.Array, context: jax.Array) -> tuple[jax.Array, ...]:
        shapes = [(steps + 1, problem.n_states), (steps, problem.n_actions), ()]
        return _call(solve, shapes, psi, s0, context)

    def forward(*given: jax.Array) -> tuple[tuple[jax.Array, ...], tuple[jax.Array, ...]]:
        return plan(*given), given

    def backward(given: tuple[jax.Array, ...], slopes: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        return _call(pull, [(size,) for size in sizes], *given, *slopes)

    plan.defvjp(forward, backward)
    return plan


def _call(function: Callable[..., tuple[Array, ...]], shapes: Sequence[tuple[int, ...]], *given: jax.Array) -> tuple:
    """A function of numpy arrays, of a whole batch at once under vmap."""
    given = tuple(map(jnp.asarray, given))
    results = [jax.ShapeDtypeStruct(shape, given[0].dtype) for shape in shapes]
    return tuple(jax.pure_callback(function, results, *given, vmap_method="broadcast_all"))


def _rows(arrays: tuple[Array, ...], sizes: tuple[int, ...]) -> tuple[tuple[int, ...], list[Array]]:
    """The leading axes of a batch, and the arrays (B, size) in float64."""
    lead = np.shape(arrays[0])[:-1]
    count = int(np.prod(lead))
    return lead, [np.asarray(x, float).reshape(count, size) for x, size in zip(arrays, sizes, strict=True)]


def _like(example: Array, *arrays: Array) -> tuple[Array, ...]:
    return tuple(array.astype(np.asarray(example).dtype) for array in arrays)
