"""The derivative of a solution, and the evidence for it."""
