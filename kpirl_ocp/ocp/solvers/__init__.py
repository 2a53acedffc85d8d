"""The solvers, one small file each."""
