"""Export a model-predictive controller as C99: `kpirl export`."""

from kpirl_ocp.cli.main import script

if __name__ == "__main__":
    script("export")
