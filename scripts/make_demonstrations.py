"""Make demonstrations of a task on the iiwa: `kpirl demonstrate`."""

from kpirl_ocp.cli.main import script

if __name__ == "__main__":
    script("demonstrate")
