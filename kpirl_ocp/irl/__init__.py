"""Inverse reinforcement learning: hypergradients, the learning loop, baselines and evaluation."""
