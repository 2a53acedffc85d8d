"""The scene in PyBullet: robot, bottle, shelf, hand and camera."""
