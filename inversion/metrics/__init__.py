"""Metrics of waveforms, most of them without a model of the scene.

Ground, heights, cover, echoes, photon heights, and tables of GEDI shots with optional fits.
"""
