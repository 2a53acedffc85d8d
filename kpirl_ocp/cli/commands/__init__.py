"""The work of each subcommand."""
