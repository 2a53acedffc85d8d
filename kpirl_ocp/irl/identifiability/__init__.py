"""Identifiability of a learned cost: intervals, known directions, and the next demonstration."""
