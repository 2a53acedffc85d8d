"""Train the keypoint detector: `kpirl train-keypoints`."""

from kpirl_ocp.cli.main import script

if __name__ == "__main__":
    script("train-keypoints")
