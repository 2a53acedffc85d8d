"""Solvers' statuses on random problems, confirmed without the package."""
