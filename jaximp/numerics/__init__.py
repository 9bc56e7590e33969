"""What all that follows counts with: linear algebra, least squares with constraints, minimisers, the compiler."""
