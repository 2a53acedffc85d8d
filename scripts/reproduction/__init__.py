"""The parts of `scripts/reproduce_paper.py`: settings, data, the experiments as independent jobs, and the report."""
