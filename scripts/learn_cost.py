"""Learn a cost from demonstrations, and plan with it on those kept for testing: `kpirl learn`."""

from kpirl_ocp.cli.main import script

if __name__ == "__main__":
    script("learn")
