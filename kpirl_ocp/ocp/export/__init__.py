"""A planning problem and its solver as a folder of C99 that needs nothing but libc and libm."""

from kpirl_ocp.ocp.export.exported_solver import ExportedSolver
from kpirl_ocp.ocp.export.folder import export_c

__all__ = ["ExportedSolver", "export_c"]
