"""Linear-quadratic algebra over the stages of a problem, of which it knows the dimensions only."""

from kpirl_ocp.ocp.linear.riccati_recursion import condense, factorise, substitute

__all__ = ["condense", "factorise", "substitute"]
