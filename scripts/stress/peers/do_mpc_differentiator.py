"""do-mpc's `NLPDifferentiator`, with all checks that it has."""

import casadi as ca
import numpy as np
from do_mpc.differentiator import NLPDifferentiator

from stress.peers.program import IPOPT, Program, Refused


def gradient(program: Program):
    """dL/dp and the plan."""
    solver = ca.nlpsol("solver", "ipopt", program.symbols, {"ipopt": IPOPT, "print_time": False})
    found = solver(x0=program.start, p=program.case.psi, **program.bounds)
    if not solver.stats()["success"]:
        raise Refused(solver.stats()["return_status"])
    columns = {name: bound[:, None] for name, bound in program.bounds.items()}
    checks = {"check_LICQ": True, "check_SC": True, "check_rank": True}
    differentiator = NLPDifferentiator(program.symbols, columns, **checks)
    tangent, _ = differentiator.differentiate(found, ca.DM(program.case.psi))
    status = differentiator.status
    if not (status.LICQ and status.SC and status.full_rank and status.lse_solved):
        raise Refused(str(status))
    x = np.array(found["x"]).ravel()
    tangent = tangent.toarray() if hasattr(tangent, "toarray") else np.array(tangent)
    return program.chain(x, tangent), program.plan(x)
