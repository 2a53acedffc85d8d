"""The command `kpirl` and its subcommands.

A subcommand is two files of one name and a line in `main.COMMANDS`: `options/NAME.py`, whose docstring is its help and
whose `add_options(parser)` declares its options with the values that each accepts; and `commands/NAME.py`, whose
`main(args)` does the work. Only the second may import numpy and the like, so that `--help` is quick.
"""
