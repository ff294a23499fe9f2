"""Photons: orders two and above, absorption, and light that many shots share."""
