"""Peers that users would take instead, on the cases that each can state: optional packages, see `make stress`."""
