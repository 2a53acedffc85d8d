"""Ways to and from what others use: PyTorch, data sets, viewers; each needs an optional package."""
