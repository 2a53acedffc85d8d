"""Linear-quadratic algebra over stages; it knows dimensions only."""
