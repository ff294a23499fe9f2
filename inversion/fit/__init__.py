"""Fits: scene properties from waveforms by nonlinear least squares, with standard errors."""
