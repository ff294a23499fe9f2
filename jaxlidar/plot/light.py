"""Figures of where the light went, and of how well a waveform is known."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter, PercentFormatter

from jaxlidar._progress import Progress
from jaxlidar.plot.style import BEAM, COLOURS, OTHER, TOTAL, WAVELENGTH_COLOURS, axes_or_new
from jaxlidar.spectral.waveform import Waveform

# Fates that are no material's, each with a hatch, so that grey tells them apart.
FATES = {
    "escaped": ("#DDDDDD", ""),
    "after the window": ("#BBBBBB", "///"),
    "unfollowed": (OTHER, "xxx"),
    "returned": (TOTAL, ""),
}
# Shares below this are not seen.
LEAST = 5e-4


def energy_budget(wave: Waveform, ax: Axes | None = None, *, legend: bool = True) -> Axes:
    """Axes with what became of the emitted light: a bar for each wavelength, in percent.

    **Arguments:**

    - `wave`: a `Waveform`.
    - `ax`: the axes to draw on. Default None: those of a new figure.
    - `legend`: whether to name what is drawn. Default True.

    **Returns:** the axes.

    **Example:**

    >>> import jax, jaxlidar as jl
    >>> import jaxlidar.plot
    >>> from matplotlib.figure import Figure
    >>> wave = jl.simulate(jl.Lidar(), jl.Scene(ground=jl.Ground()), key=jax.random.key(0))
    >>> ax = jaxlidar.plot.energy_budget(wave, Figure().subplots())
    >>> print([text.get_text() for text in ax.get_legend().get_texts()])
    ['absorbed by ground', 'escaped']
    """
    names = [f"{w:g} nm" for w in np.asarray(wave.wavelength, float)]
    ax = axes_or_new(ax, (5.0, 0.9 + 0.4 * len(names)))
    absorbed = [name for name in wave.energy_budget if name.startswith("absorbed by ")]
    left, spare = np.zeros(len(names)), list(WAVELENGTH_COLOURS)
    for name in [*absorbed, *(fate for fate in FATES if fate in wave.energy_budget)]:
        share = 100.0 * np.asarray(wave.energy_budget[name], float)
        if share.max(initial=0.0) < 100 * LEAST:
            continue
        material = name.removeprefix("absorbed by ")
        colour, hatch = FATES.get(name) or (COLOURS.get(material) or spare.pop(), "")
        look = {"color": colour, "hatch": hatch, "edgecolor": "white", "linewidth": 0.5, "label": name}
        ax.barh(names, share, left=left, **look)
        left = left + share
    ax.set_xlim(0.0, 100.0)
    ax.invert_yaxis()
    ax.set_xlabel("share of the emitted light (%)")
    if legend:
        place = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "ncols": 3}
        ax.legend(frameon=False, fontsize="small", handlelength=1.2, columnspacing=1.2, **place)
    return ax


def accuracy(steps: Sequence[Progress | Waveform], ax: Axes | None = None, **style: Any) -> Axes:
    """Axes with the relative error against the number of photons, and the tolerance that was aimed at.

    **Arguments:**

    - `steps`: what `simulate` gave to its argument `progress`, as in `progress=steps.append`; or waveforms of
      several numbers of photons. At least one that traced photons.
    - `ax`: the axes to draw on. Default None: those of a new figure.
    - `style`: of the points, as for `Axes.plot`.

    **Returns:** the axes. A thin line falls with the square root of the photons, through the last point.

    **Raises:** ValueError where there are no photons in any step.

    **Example:**

    >>> import jaxlidar as jl
    >>> import jaxlidar.plot
    >>> from matplotlib.figure import Figure
    >>> steps = [jl.Progress(8 * n, 65536 * n, 0.1 * n, 0.02 / n**0.5, 0.01) for n in (1, 2, 4)]
    >>> ax = jaxlidar.plot.accuracy(steps, Figure().subplots())
    >>> print(ax.get_xlabel(), ax.get_xscale())
    photons log
    """
    found = [
        (s.info.get("photons", 0), s.info.get("error", 0.0))
        if isinstance(s, Waveform)
        else (s.photons, s.error)
        for s in steps
    ]
    points = np.array([(n, e) for n, e in found if n > 0 and 0 < e < np.inf], float).reshape(-1, 2)
    if not len(points):
        raise ValueError("steps has no photons: nothing was random, or nothing was traced")
    ax = axes_or_new(ax, (4.0, 3.0))
    photons, error = points[np.argsort(points[:, 0])].T
    look = {"color": WAVELENGTH_COLOURS[0], "marker": "o", "markersize": 4, "linestyle": "none", **style}
    span = np.array([photons[0] / 1.5, photons[-1] * 1.5])
    root = error[-1] * np.sqrt(photons[-1] / span)
    ax.loglog(span, root, color=TOTAL, linewidth=0.8, label="square root of the photons")
    ax.loglog(photons, error, **{"label": "relative error", **look})
    aims = {s.rtol for s in steps if isinstance(s, Progress) and s.rtol is not None}
    for aim in sorted(aims):
        ax.axhline(aim, color=BEAM, linewidth=1.0, linestyle="--", label=f"aim {aim:g}")
    for axis, form in ((ax.xaxis, EngFormatter(sep="")), (ax.yaxis, PercentFormatter(1.0))):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(form)
        axis.set_minor_formatter(NullFormatter())
    ax.set_xlabel("photons")
    ax.set_ylabel("relative error")
    ax.legend(frameon=False, fontsize="small", loc="lower left")
    return ax
