"""Plan with a learned cost on demonstrations that it was not trained on: `kpirl evaluate`."""

from kpirl_ocp.cli.main import script

if __name__ == "__main__":
    script("evaluate")
