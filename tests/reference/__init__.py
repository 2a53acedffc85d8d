"""Classic problems with published optima, each stated through the public API."""
