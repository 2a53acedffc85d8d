"""Long lives of one process: memory and handles stay flat."""
