"""Data sets of others: LeRobot (in and out), robomimic, CSV and plain arrays, all as `Take`s; extra `data`."""
