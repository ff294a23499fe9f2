"""Figures of the energy budget of a waveform, and of its accuracy."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter, PercentFormatter

from jaxlidar.plot.style import (
    BEAM_COLOUR,
    MATERIAL_COLOURS,
    OTHER_COLOUR,
    TOTAL_COLOUR,
    WAVELENGTH_COLOURS,
    check_waveform,
    make_axes,
    write_note,
)
from jaxlidar.progress import Progress
from jaxlidar.spectral.waveform import Waveform

# Colour and hatch of the entries of an energy budget other than absorption by a material.
FATE_STYLES = {
    "escaped": ("#DDDDDD", ""),
    "after the window": ("#BBBBBB", "///"),
    "unfollowed": (OTHER_COLOUR, "xxx"),
    "returned": (TOTAL_COLOUR, ""),
}
# Smaller fractions of the emitted light are too narrow to see, and are left out.
MIN_FRACTION = 5e-4


def energy_budget(wave: Waveform, ax: Axes | None = None, *, legend: bool = True) -> Axes:
    """Draw the energy budget of the emitted light: a bar for each wavelength, in percent.

    **Arguments:**

    - `wave`: a `Waveform`.
    - `ax`: the axes to draw on. Default None: those of a new figure.
    - `legend`: True to add a legend. Default True.

    **Returns:** the axes.

    **Raises:** TypeError for a `Waveforms`, of several shots.

    **Example:**

    >>> import jax, jaxlidar as jl
    >>> import jaxlidar.plot
    >>> from matplotlib.figure import Figure
    >>> wave = jl.simulate(jl.Lidar(), jl.Scene(ground=jl.Ground()), key=jax.random.key(0))
    >>> ax = jaxlidar.plot.energy_budget(wave, Figure().subplots())
    >>> print([text.get_text() for text in ax.get_legend().get_texts()])
    ['absorbed by ground', 'escaped']
    """
    check_waveform(wave)
    names = [f"{w:g} nm" for w in np.asarray(wave.wavelength, float)]
    ax = make_axes(ax, (5.0, 0.9 + 0.4 * len(names)))
    absorbed = [name for name in wave.energy_budget if name.startswith("absorbed by ")]
    bar_end, spare_colours = np.zeros(len(names)), list(WAVELENGTH_COLOURS)
    for name in [*absorbed, *(fate for fate in FATE_STYLES if fate in wave.energy_budget)]:
        percentage = 100.0 * np.asarray(wave.energy_budget[name], float)
        if percentage.max(initial=0.0) < 100 * MIN_FRACTION:
            continue
        material = name.removeprefix("absorbed by ")
        colour, hatch = FATE_STYLES.get(name) or (MATERIAL_COLOURS.get(material) or spare_colours.pop(), "")
        style = {"color": colour, "hatch": hatch, "edgecolor": "white", "linewidth": 0.5, "label": name}
        ax.barh(names, percentage, left=bar_end, **style)
        bar_end = bar_end + percentage
    if not bar_end.any():
        # Bars of no length name the wavelengths.
        ax.barh(names, bar_end)
        write_note(ax, "no light")
    ax.set_xlim(0.0, 100.0)
    ax.invert_yaxis()
    ax.set_xlabel("share of the emitted light (%)")
    if legend and bar_end.any():
        position = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "ncols": 3}
        ax.legend(frameon=False, fontsize="small", handlelength=1.2, columnspacing=1.2, **position)
    return ax


def accuracy(steps: Sequence[Progress | Waveform], ax: Axes | None = None, **style: Any) -> Axes:
    """Draw the relative error against the number of photons, and the target tolerance.

    **Arguments:**

    - `steps`: a list of `Progress` from `simulate`, collected by `progress=steps.append`; or waveforms of
      several numbers of photons. At least one of them has photons.
    - `ax`: the axes to draw on. Default None: those of a new figure.
    - `style`: style of the points, as for `Axes.plot`.

    **Returns:** the axes. A thin line falls with the square root of the photons, through the last point.

    **Raises:** ValueError if no step has photons.

    **Example:**

    >>> import jaxlidar as jl
    >>> import jaxlidar.plot
    >>> from matplotlib.figure import Figure
    >>> steps = [jl.Progress(65536 * n, None, 0.1 * n, error=0.02 / n**0.5) for n in (1, 2, 4)]
    >>> ax = jaxlidar.plot.accuracy(steps, Figure().subplots())
    >>> print(ax.get_xlabel(), ax.get_xscale())
    photons log
    """
    counts_and_errors = [
        (step.info.get("photons", 0), step.info.get("error", 0.0))
        if isinstance(step, Waveform)
        else (step.done, step.error or 0.0)
        for step in steps
    ]
    # The first step may have no error yet, and a logarithmic axis shows neither zero nor infinity.
    points = [(n, error) for n, error in counts_and_errors if n > 0 and 0 < error < np.inf]
    points = np.array(points, float).reshape(-1, 2)
    if not len(points):
        raise ValueError("steps has no photons: nothing was random, or nothing was traced")
    ax = make_axes(ax, (4.0, 3.0))
    photons, error = points[np.argsort(points[:, 0])].T
    marker = {"color": WAVELENGTH_COLOURS[0], "marker": "o", "markersize": 4, "linestyle": "none"}
    span = np.array([photons[0] / 1.5, photons[-1] * 1.5])
    square_root_law = error[-1] * np.sqrt(photons[-1] / span)
    ax.loglog(span, square_root_law, color=TOTAL_COLOUR, linewidth=0.8, label="square root of the photons")
    ax.loglog(photons, error, **{"label": "relative error", **marker, **style})
    targets = {step.rtol for step in steps if isinstance(step, Progress) and step.rtol is not None}
    for rtol in sorted(targets):
        ax.axhline(rtol, color=BEAM_COLOUR, linewidth=1.0, linestyle="--", label=f"aim {rtol:g}")
    for axis, formatter in ((ax.xaxis, EngFormatter(sep="")), (ax.yaxis, PercentFormatter(1.0))):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(formatter)
        axis.set_minor_formatter(NullFormatter())
    ax.set_xlabel("photons")
    ax.set_ylabel("relative error")
    ax.legend(frameon=False, fontsize="small", loc="lower left")
    return ax
