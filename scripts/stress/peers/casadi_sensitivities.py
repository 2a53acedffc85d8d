"""CasADi's own derivatives of `nlpsol` with Ipopt."""

import casadi as ca
import numpy as np

from stress.peers.program import IPOPT, Program, Refused


def gradient(program: Program):
    """dL/dp and the plan."""
    options = {"ipopt": IPOPT, "print_time": False, "error_on_fail": True}
    solver = ca.nlpsol("solver", "ipopt", program.symbols, options)
    p = ca.MX.sym("p", program.p.numel())
    found = solver(x0=program.start, p=p, **program.bounds)["x"]
    loss = ca.Function("loss", [program.x, program.p], [program.loss])(found, p)
    function = ca.Function("gradient", [p], [ca.gradient(loss, p), found])
    try:
        slope, x = function(program.case.psi)
    except RuntimeError as error:
        raise Refused(str(error)) from error
    return np.array(slope).ravel(), program.plan(np.array(x).ravel())
