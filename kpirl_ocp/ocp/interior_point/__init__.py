"""The interior-point method on the stage structure."""
