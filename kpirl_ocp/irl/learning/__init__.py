"""The outer loop: learning psi from demonstrations, its optimisers, baselines and evaluation."""
