"""From camera frames to keypoints and their dynamics. Meets `ocp` only through plain arrays and files."""
