"""The Riccati recursion against one dense solve of the same linear-quadratic problem."""

from typing import NamedTuple

import numpy as np
import pytest

from kpirl_ocp.ocp.linear.riccati_recursion import condense, factorise, substitute


class Sizes(NamedTuple):
    n_states: int
    n_actions: int
    horizon: int


RNG = np.random.default_rng(0)


def lq(n, m, steps, curvature=1.0):
    """Random F (T, n, n+m), H (T, n+m, n+m), H_T, q (T, n+m), q_T, d (T, n) and s_0."""
    F = 0.4 * RNG.normal(size=(steps, n, n + m))
    root = RNG.normal(size=(steps, n + m, n + m))
    H = root @ root.transpose(0, 2, 1) + curvature * np.eye(n + m)
    return (
        F,
        H,
        np.eye(n),
        RNG.normal(size=(steps, n + m)),
        RNG.normal(size=n),
        RNG.normal(size=(steps, n)),
        RNG.normal(size=n),
    )


def dense(F, H, H_last, q, q_last, d, s0):
    """States (T+1, n), actions (T, m), costates (T, n) and the condensed Hessian (T m, T m), all by one KKT matrix."""
    steps, n, n_x = F.shape
    size = steps * n_x + n
    hessian, slope = np.zeros((size, size)), np.concatenate([q.ravel(), q_last])
    rows, right = np.zeros(((steps + 1) * n, size)), np.concatenate([s0, -d.ravel()])
    rows[:n, :n] = np.eye(n)
    for t in range(steps):
        at, row = slice(t * n_x, (t + 1) * n_x), slice((t + 1) * n, (t + 2) * n)
        hessian[at, at], rows[row, at] = H[t], F[t]
        rows[row, (t + 1) * n_x : (t + 1) * n_x + n] -= np.eye(n)
    hessian[-n:, -n:] = H_last
    zero = np.zeros((len(rows), len(rows)))
    solution = np.linalg.solve(np.block([[hessian, rows.T], [rows, zero]]), np.concatenate([-slope, right]))
    x, costates = solution[:size], solution[size:].reshape(steps + 1, n)[1:]
    stages = x[: steps * n_x].reshape(steps, n_x)
    is_action = np.append(np.tile(np.arange(n_x) >= n, steps), np.zeros(n, bool))
    follow = np.linalg.solve(rows[:, ~is_action], -rows[:, is_action])
    Z = np.zeros((size, is_action.sum()))
    Z[is_action], Z[~is_action] = np.eye(is_action.sum()), follow
    return np.vstack([stages[:, :n], x[-n:]]), stages[:, n:], costates, Z.T @ hessian @ Z


def side_by_side(blocks):
    return np.hstack(list(blocks))


@pytest.mark.parametrize("curvature", [1.0, -3.0], ids=["convex", "indefinite"])
@pytest.mark.parametrize(("n", "m", "steps"), [(1, 1, 1), (3, 2, 7), (4, 1, 23), (2, 3, 101)])
def test_recursion_equals_the_dense_solve_also_at_a_saddle(n, m, steps, curvature):
    F, H, H_last, q, q_last, d, s0 = data = lq(n, m, steps, curvature)
    P, W, Y, pivots = factorise(Sizes(n, m, steps))(side_by_side(F), side_by_side(H), H_last)
    found = substitute(Sizes(n, m, steps))(side_by_side(F), P, W, Y, pivots, q.T, q_last, d.T, s0)
    states, actions, costates, condensed = dense(*data)
    for value, expected in zip(found, (states, actions, costates), strict=True):
        np.testing.assert_allclose(np.array(value).T, expected, rtol=0, atol=1e-9 * max(1, np.abs(expected).max()))
    negative = np.sum(np.linalg.eigvalsh(condensed) < 0)
    assert np.sum(np.array(pivots) < 0) == negative  # Sylvester's law of inertia
    assert (negative > 0) == (curvature < 0)


def test_condensed_product_equals_the_dense_matrix():
    n, m, steps = 3, 2, 13
    F, H, H_last, *_ = data = lq(n, m, steps)
    u = RNG.normal(size=(m, steps))
    found = condense(Sizes(n, m, steps))(side_by_side(F), side_by_side(H), H_last, u)
    expected = dense(*data)[3] @ u.T.ravel()
    np.testing.assert_allclose(np.array(found).T.ravel(), expected, rtol=0, atol=1e-12 * np.abs(expected).max())
