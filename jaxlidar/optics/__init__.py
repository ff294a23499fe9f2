"""Optics: what leaves, bark and surfaces do to light, and the laws by which they scatter it."""
