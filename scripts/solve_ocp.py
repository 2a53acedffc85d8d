"""Plan with a solver, and show the solution's own audit: `kpirl solve`."""

from kpirl_ocp.cli.main import script

if __name__ == "__main__":
    script("solve")
