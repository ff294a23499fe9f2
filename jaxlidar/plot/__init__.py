"""Figures: waveforms with height upward, scenes from the side, residuals of a fit, trees in three dimensions.

Every function draws on the axes that it is given, or on those of a new figure, and returns them; nothing is
shown and nothing is saved. The package, and matplotlib with it, is imported when it is first used.
"""

from jaxlidar.plot.fits import residuals
from jaxlidar.plot.scenes import scene
from jaxlidar.plot.trees import leaf_on_and_off, tree
from jaxlidar.plot.waveforms import waveform

__all__ = ["leaf_on_and_off", "residuals", "scene", "tree", "waveform"]
