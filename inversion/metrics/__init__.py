"""Metrics of waveforms without a model of the scene: ground, heights, cover, echoes, photon heights."""
