"""The pieces that the linear-quadratic problems of a solver and of a gradient have in common, stage by stage."""

from __future__ import annotations

import casadi as ca

from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, Indices


def stiffen_stage(n_x: int, n_h: int) -> ca.Function:
    """(H, G, stiffness of x, weights of h) -> H + diag(stiffness) + G' weights G."""
    H, G = ca.MX.sym("H", n_x, n_x), ca.MX.sym("G", n_h, n_x)
    stiffness, weights = ca.MX.sym("stiffness", n_x), ca.MX.sym("weights", n_h)
    stiff = ca.MX(H)
    stiff.nz[:: n_x + 1] = H.nz[:: n_x + 1] + stiffness
    if n_h:
        stiff = ca.mac(G.T, ca.repmat(weights, 1, n_x) * G, stiff)
    return ca.Function("stiffen", [H, G, stiffness, weights], [stiff])


def push_stage(n_h: int, n_x: int) -> ca.Function:
    """(r, G, force on h) -> r + G' force."""
    r, G, force = ca.MX.sym("r", n_x), ca.MX.sym("G", n_h, n_x), ca.MX.sym("force", n_h)
    return ca.Function("push", [r, G, force], [ca.mac(force.T, G, r.T).T if n_h else r])


def path_product(rows: int, columns: int) -> ca.Function:
    """(G, x) -> G x, also when there is no row."""
    G, x = ca.MX.sym("G", rows, columns), ca.MX.sym("x", columns)
    return ca.Function("product", [G, x], [G @ x if rows else ca.MX(0, 1)])


def selection(problem: OCP, entries: Indices, signs: Array) -> ca.DM:
    """The sparse (n_w, m) matrix with one sign per column, in the row of its entry."""
    n_w = problem.horizon * (problem.n_states + problem.n_actions)
    if not len(entries):
        return ca.DM(n_w, 0)
    return ca.DM.triplet(entries.tolist(), list(range(len(entries))), ca.DM(signs), n_w, len(entries))


def by_stage(problem: OCP, w: ca.MX) -> tuple[ca.MX, ca.MX]:
    """w (n_w,) as columns x_t (n_x, T), with zeros for the given s_0, and s_T (n_s,)."""
    steps, n_s = problem.horizon, problem.n_states
    states = ca.horzcat(ca.MX.zeros(n_s, 1), ca.reshape(w[: steps * n_s], n_s, steps))
    return ca.vertcat(states[:, :steps], ca.reshape(w[steps * n_s :], problem.n_actions, steps)), states[:, steps]


def flat(problem: OCP, x: ca.MX, last: ca.MX) -> ca.MX:
    """w (n_w,) of x_t (n_x, T), of which s_0 is dropped, and s_T (n_s,)."""
    n_s = problem.n_states
    return ca.vertcat(ca.vec(x[:n_s, 1:]), last, ca.vec(x[n_s:, :]))


def matrices(problem: OCP) -> list[ca.MX]:
    """Symbols for F, G, H and H_T."""
    n_s, n_x, steps = problem.n_states, len_x(problem), problem.horizon
    shapes = {"F": (n_s, n_x * steps), "G": (problem.n_path, n_x * steps), "H": (n_x, n_x * steps), "H_T": (n_s, n_s)}
    return [ca.MX.sym(name, *shape) for name, shape in shapes.items()]


def len_x(problem: OCP) -> int:
    """n_x = n_s + n_u."""
    return problem.n_states + problem.n_actions
