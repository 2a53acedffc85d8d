"""The robot's eyes: a simulated scene and its camera. Meets `ocp` only through plain arrays and files."""
