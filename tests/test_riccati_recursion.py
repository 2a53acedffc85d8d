"""The Riccati recursion of the C core, alone and under constraints, against dense solves of the same problems."""

import ctypes
from typing import NamedTuple

import numpy as np
import pytest
import scipy.linalg

from kpirl_ocp.ocp.interior_point import library as c

CORE = ctypes.CDLL(c.library()._name)  # another handle, whose functions are declared here
CORE.kpirl_mpc_system_solve.restype = CORE.kpirl_mpc_system_change.restype = ctypes.c_double
CORE.kpirl_mpc_log_sum.restype = ctypes.c_double
CORE.kpirl_mpc_kkt_init.restype = ctypes.c_size_t
EPSILON = np.finfo(float).eps


def run(name, *arguments):
    """A function of the core, with arrays and structures by their address."""

    def passed(argument):
        if isinstance(argument, np.ndarray):
            return ctypes.c_void_p(argument.ctypes.data)
        return ctypes.byref(argument) if isinstance(argument, ctypes.Structure) else argument

    return getattr(CORE, f"kpirl_mpc_{name}")(*(passed(argument) for argument in arguments))


class LQ(NamedTuple):
    """F (T, n_s, n_x), H (T, n_x, n_x), H_T, q (T n_x + n_s,), d (T, n_s), s_0 (n_s,) and its free entries."""

    F: np.ndarray
    H: np.ndarray
    H_last: np.ndarray
    q: np.ndarray
    d: np.ndarray
    s0: np.ndarray
    free: np.ndarray

    @property
    def sizes(self):
        """T, n_s, n_u and the length of x."""
        steps, n_s, n_x = self.F.shape
        return steps, n_s, n_x - n_s, steps * n_x + n_s

    @property
    def hessian(self):
        return scipy.linalg.block_diag(*self.H, self.H_last)

    @property
    def dynamics(self):
        """A (T n_s, n_w) with A x = F_t x_t - s_{t+1}."""
        steps, n_s, n_u, size = self.sizes
        A, n_x = np.zeros((steps * n_s, size)), n_s + n_u
        for t in range(steps):
            rows = slice(t * n_s, (t + 1) * n_s)
            A[rows, t * n_x : (t + 1) * n_x] = self.F[t]
            A[rows, (t + 1) * n_x : (t + 1) * n_x + n_s] -= np.eye(n_s)
        return A

    @property
    def given(self):
        """Entries of s_0 that are not free."""
        return np.setdiff1d(np.arange(len(self.s0)), self.free)

    @property
    def decisions(self):
        """Entries of x: free ones of s_0, then actions."""
        steps, n_s, n_u, _ = self.sizes
        actions = np.arange(steps)[:, None] * (n_s + n_u) + n_s + np.arange(n_u)
        return np.concatenate([self.free, actions.ravel()]).astype(int)

    @property
    def reduced(self):
        """Z (n_w, n_decisions), from decisions to what follows by the dynamics."""
        others = np.setdiff1d(np.arange(self.sizes[-1]), self.decisions)
        A, pinned = self.dynamics, np.eye(self.sizes[-1])[self.given]
        rows = np.vstack([pinned, A])
        Z = np.zeros((self.sizes[-1], len(self.decisions)))
        Z[self.decisions] = np.eye(len(self.decisions))
        Z[others] = np.linalg.solve(rows[:, others], -rows[:, self.decisions])
        return Z


def random_lq(steps, n_s, n_u, free=(), curvature=1.0, seed=0):
    """With dynamics that turn the state, shrink it a little and are moved by actions."""
    rng = np.random.default_rng(seed)
    n_x = n_s + n_u
    root = rng.normal(size=(steps, n_x, n_x))
    turn = np.linalg.qr(rng.normal(size=(steps, n_s, n_s)))[0]
    return LQ(
        F=np.concatenate([0.95 * turn, rng.normal(size=(steps, n_s, n_u)) / np.sqrt(n_s)], axis=2),
        H=root @ root.transpose(0, 2, 1) + curvature * np.eye(n_x),
        H_last=np.eye(n_s),
        q=rng.normal(size=steps * n_x + n_s),
        d=rng.normal(size=(steps, n_s)),
        s0=rng.normal(size=n_s),
        free=np.array(free, np.intc),
    )


def by_columns(matrices):
    return np.ascontiguousarray(np.swapaxes(matrices, -1, -2)).ravel()


def factors_of(lq):
    steps, n_s, n_u, _ = lq.sizes
    n_free = len(lq.free)
    sizes = {"P": (steps + 1, n_s, n_s), "W": (steps, n_u, n_u), "Y": (steps, n_u, n_s), "pivots": (steps, n_u)}
    sizes |= {"free_W": (n_free, n_free), "free_pivots": (n_free,)}
    arrays = {name: np.zeros(shape) for name, shape in sizes.items()}
    scratch = np.zeros(run("stage_scratch", n_s, n_u) + n_free**2)
    arrays["P"][-1] = lq.H_last
    for t in reversed(range(steps)):
        stage = [arrays[name][t] for name in ("P", "W", "Y", "pivots")]
        M = by_columns(np.tril(lq.H[t]))
        run("factor_stage", n_s, n_u, arrays["P"][t + 1], by_columns(lq.F[t]), M, scratch, *stage)
    structure = c.Factors(**{name: array.ctypes.data for name, array in arrays.items()})
    run("factor_start", n_s, n_free, lq.free, arrays["P"][0], scratch, structure)
    return arrays, structure


def solve(lq, factors):
    """x (n_w,) and costates (T n_s,)."""
    steps, n_s, n_u, size = lq.sizes
    x, costates = np.zeros(size), np.zeros(steps * n_s)
    scratch = np.zeros(run("substitute_scratch", steps, n_s, n_u))
    numbers = (by_columns(lq.F), factors, lq.q, lq.d, lq.s0, scratch, x, costates)
    run("substitute", steps, n_s, n_u, len(lq.free), lq.free, *numbers)
    return x, costates


def dense(lq):
    """The same from one KKT matrix."""
    rows = np.vstack([np.eye(lq.sizes[-1])[lq.given], lq.dynamics])
    zero = np.zeros((len(rows), len(rows)))
    right = np.concatenate([-lq.q, lq.s0[lq.given], -lq.d.ravel()])
    found = np.linalg.solve(np.block([[lq.hessian, rows.T], [rows, zero]]), right)
    return found[: lq.sizes[-1]], found[lq.sizes[-1] + len(lq.given) :]


def assert_close(found, expected, tolerance=1e-11):
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * max(1.0, np.abs(expected).max(initial=0.0)))


SHAPES = [(1, 1, 1, ()), (7, 3, 2, ()), (23, 4, 1, (0, 2)), (101, 2, 3, (0, 1)), (9, 3, 0, (0, 1, 2)), (6, 2, 0, ())]


@pytest.mark.parametrize("curvature", [1.0, -3.0], ids=["convex", "indefinite"])
@pytest.mark.parametrize(("steps", "n_s", "n_u", "free"), SHAPES)
def test_recursion_equals_the_dense_solve_also_at_a_saddle(steps, n_s, n_u, free, curvature):
    lq = random_lq(steps, n_s, n_u, free, curvature)
    arrays, factors = factors_of(lq)
    x, costates = solve(lq, factors)
    expected = dense(lq)
    assert_close(x, expected[0], 1e-9)
    assert_close(costates, expected[1], 1e-9)
    pivots = np.concatenate([arrays["pivots"].ravel(), arrays["free_pivots"]])
    values = np.linalg.eigvalsh(lq.reduced.T @ lq.hessian @ lq.reduced)
    assert np.sum(pivots < 0) == np.sum(values < 0)  # Sylvester's law of inertia
    assert_close(np.sum(np.log(np.abs(pivots))), np.sum(np.log(np.abs(values))), 1e-10)  # one determinant


@pytest.mark.parametrize(("steps", "n_s", "n_u", "free"), SHAPES)
def test_residuals_of_the_recursion_are_rounding(steps, n_s, n_u, free):
    lq = random_lq(steps, n_s, n_u, free)
    _kept, factors = factors_of(lq)
    x, costates = solve(lq, factors)
    A = lq.dynamics
    stationarity = lq.hessian @ x + lq.q + A.T @ costates
    sizes = np.abs(lq.hessian) @ np.abs(x) + np.abs(lq.q) + np.abs(A).T @ np.abs(costates)
    decided = np.setdiff1d(np.arange(len(x)), lq.given)
    assert np.abs(stationarity)[decided].max() <= 100 * EPSILON * sizes.max()
    defects = A @ x + lq.d.ravel()
    assert np.abs(defects).max() <= 10 * EPSILON * (np.abs(A) @ np.abs(x) + np.abs(lq.d.ravel())).max()
    np.testing.assert_array_equal(x[lq.given], lq.s0[lq.given])


def test_the_scalar_recursion_is_its_closed_form():
    """s' = a s + b u, cost (q s^2 + r u^2) / 2: P = q + a^2 r P' / (r + b^2 P') and u = -a b P' / (r + b^2 P') s."""
    a, b, q, r, steps = 1.2, 0.5, 0.7, 0.3, 40
    lq = random_lq(steps, 1, 1)._replace(
        F=np.tile([[a, b]], (steps, 1, 1)), H=np.tile(np.diag([q, r]), (steps, 1, 1)), H_last=np.array([[q]])
    )
    arrays, factors = factors_of(lq._replace(q=np.zeros(2 * steps + 1), d=np.zeros((steps, 1))))
    P, s, expected = q, 2.0, []
    values, gains = [q], []
    for _ in range(steps):
        gains.append(-a * b * P / (r + b**2 * P))
        P = q + a**2 * r * P / (r + b**2 * P)
        values.append(P)
    np.testing.assert_allclose(arrays["P"].ravel(), values[::-1], rtol=1e-13)
    for t, one in enumerate(reversed(gains)):
        fed = np.array([0.25])
        run("feedback", 1, 1, factors, t, np.array([2.0]), np.zeros(2), fed)
        np.testing.assert_allclose(fed, 0.25 + 2 * one, rtol=1e-13)
        expected += [s, one * s]
        s = a * s + b * one * s
    at_rest = lq._replace(q=np.zeros(2 * steps + 1), d=np.zeros((steps, 1)), s0=np.array([2.0]))
    np.testing.assert_allclose(solve(at_rest, factors)[0], [*expected, s], rtol=1e-11)


@pytest.mark.parametrize("size", [1e-300, 1e-6, 1.0, 1e300])
@pytest.mark.parametrize("count", [0, 1, 70, 1000])
def test_the_sum_of_logarithms_is_that_of_each(count, size):
    values = size * np.random.default_rng(count).uniform(0.5, 2, count)
    np.testing.assert_allclose(run("log_sum", values, count), np.log(values).sum(), rtol=1e-14, atol=1e-12)


@pytest.mark.parametrize(("one", "expected"), [(0.0, -np.inf), (-1.0, np.nan), (np.nan, np.nan), (np.inf, np.inf)])
def test_the_sum_of_logarithms_is_no_number_where_one_is_none(one, expected):
    np.testing.assert_equal(run("log_sum", np.array([0.5, one, 2.0]), 3), expected)


class Rows(NamedTuple):
    """Numbers of rows h and e of a stage, h_T and e_T; and entries of x that have a lower bound."""

    path: int = 0
    equality: int = 0
    terminal: int = 0
    terminal_equality: int = 0
    bounds: tuple[int, ...] = ()


CONSTRAINED = {
    "nothing": ((12, 3, 2, ()), Rows()),
    "bounds": ((12, 3, 2, ()), Rows(bounds=(3, 9, 23, 36))),
    "path": ((12, 3, 2, ()), Rows(path=2)),
    "equalities": ((12, 3, 2, ()), Rows(equality=1)),
    "terminal rows": ((12, 3, 2, ()), Rows(terminal=1, terminal_equality=2)),
    "all, free start": ((12, 4, 3, (0, 1, 3)), Rows(1, 1, 1, 1, (0, 5, 20))),
    "no action, free start": ((8, 3, 0, (0, 1, 2)), Rows(terminal=1, terminal_equality=1)),
    "no action, partly free start": ((8, 3, 0, (0, 2)), Rows(path=1, terminal_equality=1)),
}


class Constrained:
    """A random LQ problem with rows C x = c, some of them active, in the memory of the C core."""

    def __init__(self, shape, rows, seed):
        self.lq, rng = random_lq(*shape, seed=seed), np.random.default_rng(seed + 1)
        steps, n_s, n_u, n_w = self.lq.sizes
        n_x = n_s + n_u
        counts = [(rows.path, rows.terminal), (rows.equality, rows.terminal_equality)]
        self.G, self.E = ((rng.normal(size=(steps, n, n_x)), rng.normal(size=(last, n_s))) for n, last in counts)
        self.C = np.vstack([-np.eye(n_w)[list(rows.bounds)], self._dense(self.G), self._dense(self.E)])
        self.m, inequalities = len(self.C), len(rows.bounds) + steps * rows.path + rows.terminal
        self.active = np.zeros(self.m)
        self.active[: len(rows.bounds)] = 1
        self.active[len(rows.bounds) : inequalities : 7][: 2 * (n_u > 0)] = 1
        self.active[inequalities:] = 0
        self.active[inequalities:][np.arange(self.m - inequalities) % 4 == 0] = 1
        self.active[inequalities - rows.terminal : inequalities] = 1
        self.active[self.m - rows.terminal_equality :] = 1
        self.sigma = np.where((self.active == 0) & (np.arange(self.m) < inequalities), rng.uniform(0, 5, self.m), 0.0)
        self._keep(rows, steps, n_s, n_u, n_w, rng)

    def _dense(self, blocks):
        stages, last = blocks
        return scipy.linalg.block_diag(*stages, last).reshape(-1, self.lq.sizes[-1])

    def _keep(self, rows, steps, n_s, n_u, n_w, rng):
        lq = self.lq
        self.dimensions = c.Dimensions(
            horizon=steps,
            n_states=n_s,
            n_actions=n_u,
            n_path=rows.path,
            n_equality=rows.equality,
            n_terminal=rows.terminal,
            n_terminal_equality=rows.terminal_equality,
        )
        decisions, entries = lq.decisions.astype(np.intc), np.array(rows.bounds, np.intc)
        self.kept = {"free": lq.free, "entries": entries, "decisions": decisions, "signs": -np.ones(len(entries))}
        self.kept |= {"normal": rng.normal(size=max(n_w, self.m))}
        addresses = {name: array.ctypes.data for name, array in self.kept.items()}
        counts = {"n_free": len(lq.free), "n_bounds": len(entries), "n_decisions": len(decisions)}
        self.rows, self.kkt = c.Rows(**counts, **addresses), c.KKT()
        self.memory = np.zeros(run("kkt_init", self.kkt, self.dimensions, self.rows, None))
        run("kkt_init", self.kkt, self.dimensions, self.rows, self.memory)
        self.matrices = {
            "F": by_columns(lq.F),
            "H": np.concatenate([by_columns(lq.H), by_columns(lq.H_last)]),
            "G": np.concatenate([part.ravel() for part in self.G]),
            "E": np.concatenate([part.ravel() for part in self.E]),
        }
        numbers = {"sigma": self.sigma, "active": self.active, "sizes": np.ones(n_w), "roots": np.ones(len(decisions))}
        for name, array in (self.matrices | numbers).items():
            self.kept[name] = array
            setattr(self.kkt.system, name, array.ctypes.data)

    def solve(self, r, d, values, s0, corrections=12):
        """x, costates, forces and the relative residual."""
        assert not run("system_factor", self.kkt.system, self.kept["normal"])
        right, point = ([r, d, values, s0], [np.zeros_like(part) for part in (r, d, values, s0)])
        given, found = (c.Triple(*(part.ctypes.data for part in parts)) for parts in (right, point))
        residual = run("system_solve", self.kkt.system, given, ctypes.c_double(1e-15), corrections, found)
        return *point[:3], residual

    def dense(self, r, d, values, s0):
        """x, costates and forces from one KKT matrix."""
        lq, on = self.lq, self.active > 0
        H = lq.hessian + self.C.T @ (self.sigma[:, None] * self.C)
        rows = np.vstack([np.eye(len(r))[lq.given], lq.dynamics, self.C[on]])
        zero = np.zeros((len(rows), len(rows)))
        right = np.concatenate([r, s0[lq.given], d, values[on]])
        found = np.linalg.solve(np.block([[H, rows.T], [rows, zero]]), right)
        x, _, costates, pushed = np.split(found, np.cumsum([len(r), len(lq.given), len(d)]))
        forces = np.zeros(self.m)
        forces[on] = pushed
        return x, costates, forces


@pytest.mark.parametrize("name", CONSTRAINED)
@pytest.mark.parametrize("seed", range(3))
def test_constrained_systems_are_solved_as_by_one_dense_kkt_matrix(name, seed):
    shape, rows = CONSTRAINED[name]
    problem, rng = Constrained(shape, rows, seed=seed), np.random.default_rng(seed + 2)
    steps, n_s, _, n_w = problem.lq.sizes
    right = [rng.normal(size=size) for size in (n_w, steps * n_s, problem.m, n_s)]
    right[2] *= problem.active
    assert problem.active.any() == (name != "nothing")
    *found, residual = problem.solve(*right)
    for one, other in zip(found, problem.dense(*right), strict=True):
        assert_close(one, other, 1e-10)
    assert residual < 1e-13
    x, costates, forces = found
    H = problem.lq.hessian + problem.C.T @ (problem.sigma[:, None] * problem.C)
    balance = H @ x + problem.lq.dynamics.T @ costates + problem.C.T @ forces - right[0]
    balance[problem.lq.given] = 0
    scale = (
        np.abs(H) @ np.abs(x) + np.abs(problem.lq.dynamics).T @ np.abs(costates) + np.abs(problem.C).T @ np.abs(forces)
    )
    assert np.abs(balance).max() <= 200 * EPSILON * scale.max()
    on = problem.active > 0
    assert np.abs((problem.C @ x - right[2])[on]).max(initial=0.0) <= 200 * EPSILON * np.abs(x).max() * n_s


@pytest.mark.parametrize("shape", [(12, 3, 2, ()), (12, 4, 3, (0, 1, 3))])
@pytest.mark.parametrize("seed", range(3))
def test_a_first_substitution_holds_decisions_at_their_bounds(shape, seed):
    """They begin there, and are taken out by a pivot as large as 1 / rounding; other active rows take a second one."""
    n_x = shape[1] + shape[2]
    problem = Constrained(shape, Rows(bounds=(*shape[3][:2], shape[1], 2 * n_x + shape[1] + 1)), seed=seed)
    rng = np.random.default_rng(seed + 2)
    steps, n_s, _, n_w = problem.lq.sizes
    right = [rng.normal(size=size) for size in (n_w, steps * n_s, problem.m, n_s)]
    *found, residual = problem.solve(*right, corrections=1)
    assert problem.active.all()
    assert residual < 1e-13
    for one, other in zip(found, problem.dense(*right), strict=True):
        assert_close(one, other, 1e-10)
