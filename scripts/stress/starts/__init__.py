"""Iterations from noisy starts, beside Ipopt's."""
