"""From response to waveform: optics of every history, atmosphere, pulse and samples."""
