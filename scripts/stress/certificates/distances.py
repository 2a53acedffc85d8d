"""Distances of cases from a kink: exactly on it, too close to tell, or well beside it."""

import numpy as np

DUE = 1e-2  # from here on a certificate is expected


def gap(rng: np.random.Generator) -> float:
    """0; or 1e-12 to 1e-3 to either side; or 0.02 to 0.5."""
    kind, sign = rng.choice(3, p=[0.25, 0.3, 0.45]), rng.choice([-1.0, 1.0])
    return sign * (0.0, 10 ** rng.uniform(-12, -3), rng.uniform(0.02, 0.5))[kind]
