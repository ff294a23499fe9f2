"""Reverse mode and slopes: replay of photons, score functions, and paths that move with surfaces."""
