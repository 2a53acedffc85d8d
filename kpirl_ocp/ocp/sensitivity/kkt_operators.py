"""Operators of the KKT system with its inequalities, as expressions, for `refinement` and `conditioning`.

Inequalities are listed as in `Inequalities`; entries that belong to some of them only are zero for the others. F, G, H
and H_T lie side by side as in `kpirl_ocp.ocp.conditions.stage_derivatives`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import casadi as ca

from kpirl_ocp.ocp.conditions.nlp import bound_rows
from kpirl_ocp.ocp.linear.riccati_recursion import factorise
from kpirl_ocp.ocp.linear.stage_operators import by_stage, flat, len_x, path_product, selection, stiffen_stage
from kpirl_ocp.ocp.problem.ocp import OCP


class Operator(Protocol):
    """Products with the derivatives of all stages, stored or not; x is (n_x, T)."""

    def path(self, x: ca.MX) -> ca.MX:
        """G_t x_t (n_h, T)."""
        ...

    def balance(self, x: ca.MX, last: ca.MX, costates: ca.MX, forces: ca.MX) -> tuple[ca.MX, ca.MX]:
        """H_t x_t + F_t' lambda_t + G_t' mu_t (n_x, T), and H_T s_T (n_s,); lambda is (n_s, T), mu (n_h, T)."""
        ...

    def F_times(self, x: ca.MX) -> ca.MX:
        """F_t x_t (n_s, T)."""
        ...


@dataclass(frozen=True)
class Stored:
    """Products with matrices; an `Operator`."""

    problem: OCP
    F: ca.MX
    G: ca.MX
    H: ca.MX
    last: ca.MX

    def path(self, x: ca.MX) -> ca.MX:
        """G_t x_t (n_h, T)."""
        return path_product(self.problem.n_path, len_x(self.problem)).map(self.problem.horizon)(self.G, x)

    def balance(self, x: ca.MX, last: ca.MX, costates: ca.MX, forces: ca.MX) -> tuple[ca.MX, ca.MX]:
        """H_t x_t + F_t' lambda_t + G_t' mu_t (n_x, T), and H_T s_T (n_s,)."""
        n_s, n_x = self.problem.n_states, len_x(self.problem)
        shapes = {"F": (n_s, n_x), "H": (n_x, n_x), "x": (n_x, 1), "lambda": (n_s, 1)}
        F_t, H_t, x_t, costate = (ca.MX.sym(name, *shape) for name, shape in shapes.items())
        stage = ca.Function("balance", [F_t, H_t, x_t, costate], [ca.mac(H_t, x_t, (costate.T @ F_t).T)])
        balance = stage.map(self.problem.horizon)(self.F, self.H, x, costates)
        if self.problem.n_path:
            balance = balance + pull_path(self.problem, self.G, forces)
        return balance, self.last @ last

    def F_times(self, x: ca.MX) -> ca.MX:
        """F_t x_t (n_s, T)."""
        return path_product(self.problem.n_states, len_x(self.problem)).map(self.problem.horizon)(self.F, x)


def stiffened(problem: OCP, F: ca.MX, G: ca.MX, H: ca.MX, last: ca.MX, weights: ca.MX) -> list[ca.MX]:
    """`factorise` of H + rows' weights rows; H of all stages, or (n_x, n_x) the same for all."""
    n_x, n_h, steps = len_x(problem), problem.n_path, problem.horizon
    bounds, path = split(problem, weights)
    B = bound_columns(problem)
    stiff, stiff_last = by_stage(problem, (B * B) @ bounds)
    wide = H if H.size2() == n_x * steps else ca.repmat(H, 1, steps)
    H_stiff = stiffen_stage(n_x, n_h).map(steps)(wide, G, stiff, path)
    return list(factorise(problem)(F, H_stiff, last + ca.diag(stiff_last)))


def rows(problem: OCP, operator: Operator, w: ca.MX) -> ca.MX:
    """rows w (n_ineq,)."""
    path = operator.path(by_stage(problem, w)[0])
    return ca.densify(ca.vertcat(bound_columns(problem).T @ w, ca.vec(path)))


def transposed_rows(problem: OCP, G: ca.MX, forces: ca.MX) -> ca.MX:
    """rows' forces (n_w,)."""
    bounds, path = split(problem, forces)
    pushed = bound_columns(problem) @ bounds
    if problem.n_path:
        pushed = pushed + flat(problem, pull_path(problem, G, path), ca.MX.zeros(problem.n_states))
    return ca.densify(pushed)


def pull_path(problem: OCP, G: ca.MX, forces: ca.MX) -> ca.MX:
    """G_t' mu_t (n_x, T)."""
    force, G_t = ca.MX.sym("force", problem.n_path), ca.MX.sym("G", problem.n_path, len_x(problem))
    return ca.Function("pull", [G_t, force], [(force.T @ G_t).T]).map(problem.horizon)(G, forces)


def split(problem: OCP, values: ca.MX) -> tuple[ca.MX, ca.MX]:
    """Of the bounds (n_bounds,), and of the path constraints (n_h, T)."""
    bounds, path = ca.vertsplit(values, [0, len(bound_rows(problem).entries), values.numel()])
    return bounds, ca.reshape(path, problem.n_path, problem.horizon)


def bound_columns(problem: OCP) -> ca.DM:
    """The transposed rows of the bounds (n_w, n_bounds)."""
    at = bound_rows(problem)
    return selection(problem, at.entries, at.signs)


def n_rows(problem: OCP) -> int:
    """The number of inequalities."""
    return len(bound_rows(problem).entries) + problem.horizon * problem.n_path
