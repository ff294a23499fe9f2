"""Batches of photons: compiled programs that trace them, running moments, and when to stop."""
