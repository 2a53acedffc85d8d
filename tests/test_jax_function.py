"""An OCP as a function in JAX: the numbers of the solver, and gradients that differences agree with."""

import numpy as np
import pytest
from problems import CASES

from kpirl_ocp import Riccati, sensitivity

jax = pytest.importorskip("jax")
import jax.numpy as jnp  # noqa: E402

from kpirl_ocp.bridges.jax_function import ocp_function  # noqa: E402


@pytest.fixture(autouse=True)
def double_precision():
    before = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", before)


def pendulum():
    case = CASES["pendulum"]()
    return case.problem, [jnp.asarray(x) for x in (case.psi, case.demonstration.s0, case.demonstration.context)]


def objective(plan):
    def value(*given):
        states, actions, _ = plan(*given)
        return jnp.sum(jnp.sin(states)) + jnp.sum(actions**2)

    return value


@pytest.mark.parametrize("compiled", [False, True], ids=["eager", "jit"])
def test_the_function_gives_the_solution_of_the_solver(compiled):
    problem, given = pendulum()
    plan = ocp_function(problem)
    states, actions, value = (jax.jit(plan) if compiled else plan)(*given)
    alone = Riccati().solve(problem, given[1], given[0], given[2])
    np.testing.assert_allclose(states, alone.states, rtol=0, atol=1e-12)
    np.testing.assert_allclose(actions, alone.actions, rtol=0, atol=1e-12)
    assert value == pytest.approx(alone.objective, rel=1e-12)


@pytest.mark.parametrize("compiled", [False, True], ids=["eager", "jit"])
def test_gradients_are_those_of_the_sensitivity_and_of_differences(compiled):
    problem, given = pendulum()
    value = objective(ocp_function(problem, Riccati(tolerance=1e-12)))
    slope = jax.grad(value, argnums=(0, 1))
    by_psi, by_s0 = (jax.jit(slope) if compiled else slope)(*given)
    solution = Riccati(tolerance=1e-12).solve(problem, given[1], given[0], given[2])
    expected = sensitivity(problem, solution).pull(np.cos(solution.states), 2 * solution.actions)
    np.testing.assert_allclose(by_psi, expected.psi, rtol=1e-9)
    np.testing.assert_allclose(by_s0, expected.s0, rtol=1e-9)
    h = 1e-5
    for index in range(len(by_psi)):
        moved = [value(given[0].at[index].add(sign * h), *given[1:]) for sign in (1, -1)]
        np.testing.assert_allclose(by_psi[index], (moved[0] - moved[1]) / (2 * h), rtol=1e-6)


def test_a_batch_of_vmap_is_its_instances():
    problem, (psi, s0, context) = pendulum()
    value = objective(ocp_function(problem))
    many = psi * jnp.linspace(0.95, 1.05, 5)[:, None]
    together = jax.vmap(jax.grad(value), in_axes=(0, None, None))(many, s0, context)
    alone = [jax.grad(value)(one, s0, context) for one in many]
    np.testing.assert_allclose(together, alone, rtol=1e-9)


def test_a_failed_solve_raises():
    problem, (psi, s0, context) = pendulum()
    with pytest.raises(Exception, match="1 of 1 solves failed"):
        jax.block_until_ready(ocp_function(problem)(psi * jnp.nan, s0, context))
