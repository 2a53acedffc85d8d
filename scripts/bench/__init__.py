"""The parts of scripts/benchmark.py: one problem, the peers, and one small module per question."""
