"""Optics: reflectance and transmittance of leaves, bark and surfaces, and the laws by which they scatter."""
