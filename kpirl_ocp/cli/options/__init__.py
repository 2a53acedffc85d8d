"""The options of each subcommand, and its help; nothing here imports more than the standard library."""
