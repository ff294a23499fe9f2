"""Monte Carlo estimates from independent batches: running moments, standard errors, and when to stop."""
