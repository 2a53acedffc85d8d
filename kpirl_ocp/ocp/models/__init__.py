"""What problems are made of: robots, networks, and costs over keypoints."""
