"""Many waveforms at once: all shots of a survey over one scene."""
