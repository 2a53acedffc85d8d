"""Functions of the C code on KKT systems that the package calls only from C: products, Newton steps, changes nearby."""

import ctypes

import numpy as np

from kpirl_ocp.ocp.interior_point import library as c
from kpirl_ocp.ocp.interior_point.cores import borrow_core
from kpirl_ocp.ocp.sensitivity.kkt_system import PrimalDual, Triple


def _declared(name, count, result=None):
    function = getattr(c.library(), f"kpirl_mpc_{name}")
    function.argtypes, function.restype = [ctypes.c_void_p] * count, result
    return function


def defects_along(system, x):
    """F_t x_t - s_{t+1} (T n_s,)."""
    defects = np.empty(system.sizes_of_parts[1])
    _declared("defects_times", 3)(system.address, x.ctypes.data, defects.ctypes.data)
    return defects


def balance(system, point):
    """(H + C' sigma C) x + A' lambda + C' mu (n_w,), given entries of s_0 included."""
    n_w, _, n_rows = system.sizes_of_parts
    forces, values, triple = np.empty(n_w), np.empty(n_rows), Triple(point)
    _declared("system_balance", 4)(system.address, triple.address, forces.ctypes.data, values.ctypes.data)
    return forces


def newton_step(system):
    """The Newton step on the KKT conditions; the system holds its factors."""
    _declared("kkt_step", 1)(system.address)
    return system.read(system.structure.move)


def change_nearby(system, nearby, slope, adjoint):
    """Relative change of the adjoint of a slope, in the decisions, from a system that holds its factors to one nearby.

    Infinite where iterative refinement with these factors does not converge.
    """
    moving = Triple(PrimalDual(adjoint.x.copy(), adjoint.costates.copy(), adjoint.forces.copy()))
    addresses = system.address, nearby.address, slope.ctypes.data, moving.address
    return _declared("kkt_change", 4, ctypes.c_double)(*addresses)


def kink_nearby(system, nearby, adjoint):
    """Relative disagreement of differences with derivatives along an adjoint, and the residual that it has nearby."""
    given, found = Triple(_in_one_piece(adjoint)), Triple(_in_one_piece(adjoint))
    with borrow_core(system.instance.problem) as core:
        addresses = system.address, nearby.address, core.address, given.address, found.address
        kink = _declared("kink_nearby", 5, ctypes.c_double)(*addresses)
    return kink, found.point


def _in_one_piece(point):
    """A point whose arrays are one after the other in memory."""
    parts = point.x, point.costates, point.forces
    return PrimalDual(*np.split(np.concatenate(parts), np.cumsum([len(part) for part in parts])[:-1]))
