"""Train the dynamics of keypoints: `kpirl train-dynamics`."""

from kpirl_ocp.cli.main import script

if __name__ == "__main__":
    script("train-dynamics")
