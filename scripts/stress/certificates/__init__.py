"""The contest of certificates: generated cases whose hypergradient, or lack of one, is known without the package."""
