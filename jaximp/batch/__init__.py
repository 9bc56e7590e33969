"""Many recordings by one job: plan, run, results, overview."""
