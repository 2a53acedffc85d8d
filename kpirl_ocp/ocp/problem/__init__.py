"""The problem class, what a model offers, layouts of its unknowns, and the protocol of solvers."""
