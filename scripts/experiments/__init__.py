"""Experiments that compare methods, for the scripts that run them."""
