"""Figures: waveforms and photons with height upward, scenes from the side, surveys and returns from above,
fits, profiles, spectra.

Every function draws on the given axes, or on those of a new figure, and returns them; it neither shows nor
saves the figure. The package, and matplotlib with it, is imported when it is first used.
"""

from jaxlidar.plot.comparisons import comparison
from jaxlidar.plot.fits import fit, residuals
from jaxlidar.plot.light import accuracy, energy_budget
from jaxlidar.plot.photon_events import photons
from jaxlidar.plot.profiles import averaging_kernel, profile
from jaxlidar.plot.returns import points, section
from jaxlidar.plot.scenes import scene
from jaxlidar.plot.spectra import spectrum
from jaxlidar.plot.surveys import survey
from jaxlidar.plot.trees import leaf_on_and_off, tree
from jaxlidar.plot.waveforms import waterfall, waveform

__all__ = [
    "accuracy",
    "averaging_kernel",
    "comparison",
    "energy_budget",
    "fit",
    "leaf_on_and_off",
    "photons",
    "points",
    "profile",
    "residuals",
    "scene",
    "section",
    "spectrum",
    "survey",
    "tree",
    "waterfall",
    "waveform",
]


def __dir__() -> list[str]:
    return sorted(__all__)
