"""What several test files make: joints and the jobs for them, rows of least squares, estimates, chains."""
