"""Videos, motions and data sets."""
