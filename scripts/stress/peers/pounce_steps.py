"""POUNCE's parametric step: psi as variables that equalities pin; its own verdicts are asked."""

import casadi as ca
import numpy as np
import pounce

from stress.peers.program import Program, Refused


class _Callbacks:
    """In the style of cyipopt, over y = (x, p)."""

    def __init__(self, program: Program) -> None:
        y = ca.vertcat(program.x, program.p)
        g = ca.vertcat(program.g, program.p)
        self._numel, force = g.numel(), ca.SX.sym("lam", g.numel())
        factor = ca.SX.sym("factor")
        jacobian = ca.jacobian(g, y)
        hessian = ca.tril(ca.hessian(factor * program.f + ca.dot(force, g), y)[0])
        self._jacobian, self._hessian = jacobian.sparsity(), hessian.sparsity()
        self._f, self._df = (ca.Function("f", [y], [e]) for e in (program.f, ca.gradient(program.f, y)))
        self._g = ca.Function("g", [y], [ca.densify(g)])
        self._dg = ca.Function("dg", [y], [jacobian])
        self._h = ca.Function("h", [y, force, factor], [hessian])

    def objective(self, y):
        return float(self._f(y))

    def gradient(self, y):
        return np.array(self._df(y)).ravel()

    def constraints(self, y):
        return np.array(self._g(y)).ravel()

    def jacobianstructure(self):
        return tuple(map(np.array, self._jacobian.get_triplet()))

    def jacobian(self, y):
        return np.array(self._dg(y).nonzeros())

    def hessianstructure(self):
        return tuple(map(np.array, self._hessian.get_triplet()))

    def hessian(self, y, force, factor):
        return np.array(self._h(y, force, factor).nonzeros())


def gradient(program: Program):
    """dL/dp and the plan."""
    psi, n = program.case.psi, program.x.numel()
    free = np.full(len(psi), np.inf)
    problem = pounce.Problem(
        n=n + len(psi),
        m=len(program.ubg) + len(psi),
        problem_obj=_Callbacks(program),
        lb=np.concatenate([program.lbx, -free]),
        ub=np.concatenate([program.ubx, free]),
        cl=np.concatenate([program.lbg, psi]),
        cu=np.concatenate([program.ubg, psi]),
    )
    for name, value in (
        ("tol", 1e-10),
        ("print_level", 0),
        ("max_iter", 500),
        ("bound_relax_factor", 0.0),
        ("sb", "yes"),
    ):
        problem.add_option(name, value)
    solver = pounce.Solver(problem)
    y, info = solver.solve(np.concatenate([program.start, psi]))
    if info["status"] != 0 or not solver.converged:
        raise Refused(str(info["status_msg"]))
    activity = solver.classify_activity()
    doubts = {"weakly_active", "ambiguous"} & {*activity["var_status"], *activity["row_status"]}
    if doubts or np.any(solver.kkt_perturbations):
        raise Refused("weakly active, or the factor is regularised")
    pins = [len(program.ubg) + i for i in range(len(psi))]
    tangent = [solver.parametric_step(pins, list(unit))[:n] for unit in np.eye(len(psi))]
    return program.chain(np.array(y[:n]), np.array(tangent).T), program.plan(np.array(y[:n]))
