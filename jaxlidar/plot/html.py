"""HTML that notebooks show of an object: its summary, and a small figure."""

import base64
import html
import io
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxlidar.plot.fits import residuals
from jaxlidar.plot.style import wavelength_bar_width
from jaxlidar.plot.waveforms import waveform
from jaxlidar.spectral.waveform import Waveform

RESOLUTION = 80  # dots per inch


def waveform_html(wave: Waveform) -> str:
    """Render the summary of a waveform and its figure as HTML."""
    bar = wavelength_bar_width(np.asarray(wave.wavelength))
    figure = Figure(figsize=(3.0 + bar, 3.2), layout="constrained")
    axes = waveform(wave, figure.subplots())
    axes.set_xlabel(axes.get_xlabel(), loc="left")
    return _side_by_side(str(wave), figure)


def fit_html(summary: str, wave: Waveform, residual: Any) -> str:
    """Render the summary of a fit, the fitted waveform and residuals (in standard deviations) as HTML."""
    bar = wavelength_bar_width(np.asarray(wave.wavelength))
    figure = Figure(figsize=(5.0 + 2.0 * bar, 3.2), layout="constrained")
    waveform_axes, residual_axes = figure.subplots(1, 2, sharey=True)
    waveform(wave, waveform_axes)
    # At the left, as the axis has its power of ten at the right end.
    waveform_axes.set_xlabel(waveform_axes.get_xlabel(), loc="left")
    # `residuals` takes observations and noise. With a noise this small, the observations that have the given
    # residuals are the waveform itself, and so are the limits of the axis.
    model = np.asarray(wave.reflectance, float)
    noise = 1e-6 * max(float(np.max(model)), 1e-30)
    residuals(wave, model + noise * np.asarray(residual, float), noise, residual_axes)
    residual_axes.set_ylabel("")
    return _side_by_side(summary, figure)


def _side_by_side(summary: str, figure: Figure) -> str:
    """Lay out a text and a figure, embedded as PNG, side by side."""
    image = io.BytesIO()
    figure.savefig(image, format="png", dpi=RESOLUTION)
    data = base64.b64encode(image.getvalue()).decode()
    return (
        '<div style="display:flex;flex-wrap:wrap;gap:1em;align-items:flex-start">'
        f"<pre>{html.escape(summary)}</pre>"
        f'<img alt="figure" src="data:image/png;base64,{data}"/></div>'
    )
