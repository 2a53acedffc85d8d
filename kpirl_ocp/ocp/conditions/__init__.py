"""The KKT conditions and their derivatives, each once."""
