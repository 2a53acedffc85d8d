"""Collect camera data: `kpirl collect`."""

from kpirl_ocp.cli.main import script

if __name__ == "__main__":
    script("collect")
