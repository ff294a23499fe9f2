"""What notebooks show of an object: its summary, and a small figure."""

import base64
import html
import io
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxlidar.plot.fits import residuals
from jaxlidar.plot.waveforms import waveform
from jaxlidar.spectral.waveform import Waveform

RESOLUTION = 80


def waveform_html(wave: Waveform) -> str:
    """The summary of a waveform and its figure, as HTML."""
    figure = Figure(figsize=(3.0, 3.2), layout="constrained")
    axes = waveform(wave, figure.subplots())
    axes.set_xlabel(axes.get_xlabel(), loc="left")
    return _beside(str(wave), figure)


def fit_html(summary: str, wave: Waveform, score: Any) -> str:
    """The summary of a fit, the fitted waveform and the residuals in standard deviations, as HTML."""
    figure = Figure(figsize=(5.0, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    waveform(wave, left)
    # Clear of the power of ten at the right end.
    left.set_xlabel(left.get_xlabel(), loc="left")
    # So little noise that the frame is the waveform's.
    model = np.asarray(wave.reflectance, float)
    noise = 1e-6 * max(float(np.max(model)), 1e-30)
    residuals(wave, model + noise * np.asarray(score, float), noise, right)
    right.set_ylabel("")
    return _beside(summary, figure)


def _beside(summary: str, figure: Figure) -> str:
    image = io.BytesIO()
    figure.savefig(image, format="png", dpi=RESOLUTION)
    data = base64.b64encode(image.getvalue()).decode()
    return (
        '<div style="display:flex;flex-wrap:wrap;gap:1em;align-items:flex-start">'
        f"<pre>{html.escape(summary)}</pre>"
        f'<img alt="figure" src="data:image/png;base64,{data}"/></div>'
    )
