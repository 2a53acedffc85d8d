"""The keypoint detector: network, losses, training and evaluation."""
