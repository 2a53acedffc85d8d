"""Example problems, the tasks of the paper, and files of learned costs."""
