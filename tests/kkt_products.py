"""Products with the stage matrices of a KKT system, block by block."""

import numpy as np


def times_hessian(system, w):
    """H w (n_w,), without stiffness."""
    x, last = system.by_stage(w)
    return system.flat((system.H @ x[:, :, None])[:, :, 0], system.H_last @ last)


def times_jacobian(system, w):
    """A w (T n_s,)."""
    x, _ = system.by_stage(w)
    return (x[:, None, :] @ system.F).ravel() - w[: len(system.defects)]


def times_transposed_jacobian(system, costates):
    """A' lambda (n_w,)."""
    n_s = len(system.H_last)
    product = system.flat((system.F @ costates.reshape(-1, n_s, 1))[:, :, 0], np.zeros(n_s))
    product[: len(costates)] -= costates
    return product
