"""Costs from visual demonstrations, and control behind a camera."""
