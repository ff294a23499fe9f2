"""Figures: waveforms and photons with height upward, scenes from the side, surveys from above, fits, spectra.

Every function draws on the axes that it is given, or on those of a new figure, and returns them; nothing is
shown and nothing is saved. The package, and matplotlib with it, is imported when it is first used.
"""

from jaxlidar._signatures import shorten_signatures
from jaxlidar.plot.fits import fit, residuals
from jaxlidar.plot.light import accuracy, energy_budget
from jaxlidar.plot.photon_events import photons
from jaxlidar.plot.scenes import scene
from jaxlidar.plot.spectra import spectrum
from jaxlidar.plot.surveys import survey
from jaxlidar.plot.trees import leaf_on_and_off, tree
from jaxlidar.plot.waveforms import waveform

__all__ = [
    "accuracy",
    "fit",
    "leaf_on_and_off",
    "energy_budget",
    "photons",
    "residuals",
    "scene",
    "spectrum",
    "survey",
    "tree",
    "waveform",
]

shorten_signatures(globals())


def __dir__() -> list[str]:
    return sorted(__all__)
