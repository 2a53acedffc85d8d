"""Iterations from noisy starts, compared with Ipopt's."""
