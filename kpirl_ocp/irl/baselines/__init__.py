"""Other ways to learn a cost from demonstrations, for comparison: each is the method of one paper."""
