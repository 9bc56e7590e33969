"""What a perturbation added to a movement: isolation of the deviation, one method a file, and the table of methods."""
