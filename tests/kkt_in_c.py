"""Functions of the C code on KKT systems that the package calls only from C: linearisations, products, Newton steps."""

import ctypes
from typing import NamedTuple

import numpy as np

from kpirl_ocp.ocp.conditions import parameter_derivatives
from kpirl_ocp.ocp.interior_point import library as c
from kpirl_ocp.ocp.interior_point.cores import borrow_core
from kpirl_ocp.ocp.sensitivity.implicit_function import ByParameters
from kpirl_ocp.ocp.sensitivity.kkt_system import KKTSystem, PrimalDual, Triple


def declared(name, count, result=None):
    """A function of the C code that takes `count` pointers."""
    function = getattr(c.library(), f"kpirl_mpc_{name}")
    function.argtypes, function.restype = [ctypes.c_void_p] * count, result
    return function


def linearise(instance, point, active=None):
    """The KKT system at a point for an active set, by default the one that multipliers and slacks there suggest."""
    system = KKTSystem(instance)
    system.set_point(point)
    with borrow_core(instance.problem) as core:
        declared("kkt_evaluate", 2)(system.address, core.address)
    chosen = None if active is None else np.ascontiguousarray(active, float)
    declared("kkt_select", 2)(system.address, None if chosen is None else chosen.ctypes.data)
    return system


class Derivatives(NamedTuple):
    """The parts of `StageDerivatives`, in their order."""

    gradient: np.ndarray
    objective: np.ndarray
    defects: np.ndarray
    path: np.ndarray
    equality: np.ndarray
    F: np.ndarray
    G: np.ndarray
    E: np.ndarray
    H: np.ndarray


def derivatives_of(system):
    """Values and derivatives at the point of a system."""
    problem, (n_w, n_c, m) = system.instance.problem, system.sizes_of_parts
    T, n_s, n_x = problem.horizon, problem.n_states, problem.n_states + problem.n_actions
    matrices = {
        "F": T * n_s * n_x,
        "G": T * n_x * problem.n_path + n_s * problem.n_terminal,
        "E": T * n_x * problem.n_path_equality + n_s * problem.n_terminal_equality,
        "H": T * n_x * n_x + n_s * n_s,
    }
    at, (_, path, equality) = system.structure, system.instance.rows.split(-c.read(system.structure.slack, m))
    values = [c.read(at.gradient, n_w), np.array([at.objective]), c.read(at.defects, n_c), path, equality]
    return Derivatives(*values, *(c.read(getattr(at.system, name), size) for name, size in matrices.items()))


def rows_along(system, x):
    """The Jacobian of all rows times x, (n_rows,)."""
    values, given = np.empty(system.sizes_of_parts[2]), np.ascontiguousarray(x, float)
    declared("rows_times", 3)(system.address, given.ctypes.data, values.ctypes.data)
    return values


def adjoint_of(factors, slope):
    """The solution for the right-hand side (slope, 0, 0), and its relative residual."""
    _, n_c, m = factors.system.sizes_of_parts
    return factors.solve(PrimalDual(slope, np.zeros(n_c), np.zeros(m)), np.zeros(len(factors.system.instance.s0)))


def pull(system, adjoint):
    """Gradients of a function of x by the parameters, from its adjoint."""
    problem = system.instance.problem
    found, weights = ByParameters.empty(problem), Triple(PrimalDual(adjoint.x, adjoint.costates, +adjoint.forces))
    structure = found.structure
    with borrow_core(problem) as core:
        function = core.function(parameter_derivatives.pull)
        declared("kkt_pull", 4)(system.address, function, weights.address, ctypes.addressof(structure))
    return ByParameters(*(-by for by in found))


def defects_along(system, x):
    """F_t x_t - s_{t+1} (T n_s,)."""
    defects = np.empty(system.sizes_of_parts[1])
    declared("defects_times", 3)(system.address, x.ctypes.data, defects.ctypes.data)
    return defects


def balance(system, point):
    """(H + C' sigma C) x + A' lambda + C' mu (n_w,), given entries of s_0 included."""
    n_w, _, n_rows = system.sizes_of_parts
    forces, values, triple = np.empty(n_w), np.empty(n_rows), Triple(point)
    declared("system_balance", 4)(system.address, triple.address, forces.ctypes.data, values.ctypes.data)
    return forces


def newton_step(system):
    """The Newton step on the KKT conditions; the system holds its factors."""
    declared("kkt_step", 1)(system.address)
    return system.read(system.structure.move)


def change_nearby(system, nearby, slope, adjoint):
    """Relative change of the adjoint of a slope, in the decisions, from a system that holds its factors to one nearby.

    Infinite where iterative refinement with these factors does not converge.
    """
    moving = Triple(PrimalDual(adjoint.x.copy(), adjoint.costates.copy(), adjoint.forces.copy()))
    addresses = system.address, nearby.address, slope.ctypes.data, moving.address
    return declared("kkt_change", 4, ctypes.c_double)(*addresses)


def kink_nearby(system, nearby, adjoint):
    """Relative disagreement of differences with derivatives along an adjoint, and the residual that it has nearby."""
    given, found = Triple(_in_one_piece(adjoint)), Triple(_in_one_piece(adjoint))
    with borrow_core(system.instance.problem) as core:
        addresses = system.address, nearby.address, core.address, given.address, found.address
        kink = declared("kink_nearby", 5, ctypes.c_double)(*addresses)
    return kink, found.point


def _in_one_piece(point):
    """A point whose arrays are one after the other in memory."""
    parts = point.x, point.costates, point.forces
    return PrimalDual(*np.split(np.concatenate(parts), np.cumsum([len(part) for part in parts])[:-1]))
