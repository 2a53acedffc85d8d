"""Optimal control: problems, kinematics, costs, solvers and their KKT systems. Needs neither torch nor PyBullet."""
