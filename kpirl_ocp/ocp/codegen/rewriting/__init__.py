"""Passes over generated C: fewer copies, loops and tests, the same numbers."""
