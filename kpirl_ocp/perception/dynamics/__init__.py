"""Dynamics learned in keypoints."""
