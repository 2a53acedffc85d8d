"""The options and the help of each subcommand; to keep `--help` quick, nothing here imports numpy and the like."""
