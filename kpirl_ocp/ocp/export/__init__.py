"""A planning problem and its solver as a folder of C99 that needs nothing but libc and libm."""
