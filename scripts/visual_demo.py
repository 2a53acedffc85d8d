"""Watch a person place a bottle, learn what mattered, plan, and do it with the simulated arm: `kpirl demo`."""

from kpirl_ocp.cli.main import script

if __name__ == "__main__":
    script("demo")
