"""`python -m kpirl_ocp.cli` is `kpirl`."""

from kpirl_ocp.cli.main import main

if __name__ == "__main__":
    main()
