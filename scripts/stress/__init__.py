"""Trials that are hard on the package: generated cases with known answers, kills, and long lives of one process."""
