"""Compare the hypergradients on a problem: `kpirl compare`."""

from kpirl_ocp.cli.main import script

if __name__ == "__main__":
    script("compare")
