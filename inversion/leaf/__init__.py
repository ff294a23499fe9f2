"""Retrieval of leaf traits from reflectance and transmittance spectra."""
