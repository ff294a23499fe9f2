"""Figures of the spectra of leaves and surfaces."""

from typing import Any

import numpy as np
from jaxtyping import ArrayLike
from matplotlib.axes import Axes

from jaxlidar._fields.checks import as_numpy
from jaxlidar.optics.leaf import LeafOptics
from jaxlidar.optics.prospect import Prospect
from jaxlidar.optics.spectra import Spectrum
from jaxlidar.plot.style import WAVELENGTH_COLOURS, make_axes, point_marker

# Wavelengths of leaf spectra, nm: the range of the coefficients of PROSPECT.
LEAF_WAVELENGTHS = np.arange(400.0, 2501.0, 2.0)


def spectrum(
    source: Prospect | Spectrum | LeafOptics,
    ax: Axes | None = None,
    *,
    wavelength: ArrayLike | None = None,
    **style: Any,
) -> Axes:
    """Draw a spectrum: reflectance (solid) and, of a leaf, transmittance (dashed).

    **Arguments:**

    - `source`: a `Prospect`, a `LeafOptics` of one number, or a `Spectrum`.
    - `ax`: the axes to draw on. Default None: those of a new figure.
    - `wavelength`: (n,) nm, increasing. Default None: 400 to 2500 for leaves, the samples of a `Spectrum`.
    - `style`: style of the lines, as for `Axes.plot`.

    **Returns:** the axes.

    **Raises:** ValueError for wavelengths that the source does not have.

    **Example:**

    >>> import jaxlidar as jl
    >>> import jaxlidar.plot
    >>> from matplotlib.figure import Figure
    >>> ax = jaxlidar.plot.spectrum(jl.Prospect(Cab=40.0), Figure().subplots())
    >>> print([line.get_label() for line in ax.lines])
    ['reflectance', 'transmittance']
    """
    ax = make_axes(ax, (5.0, 3.0))
    colour = WAVELENGTH_COLOURS[len(ax.lines) % len(WAVELENGTH_COLOURS)]
    if isinstance(source, Spectrum):
        grid = as_numpy(source.wavelength if wavelength is None else wavelength, "wavelength")
        line = {"color": colour, "label": source.name or "reflectance", **point_marker(grid.size), **style}
        ax.plot(grid, np.asarray(source(grid)), **line)
    else:
        grid = LEAF_WAVELENGTHS if wavelength is None else as_numpy(wavelength, "wavelength")
        # Single points, which have no dashes, differ by how they are filled.
        looks = ("reflectance", "-", "full"), ("transmittance", "--", "none")
        for values, (name, linestyle, fill) in zip(source(grid), looks):
            line: dict[str, Any] = {"color": colour, "linestyle": linestyle, "label": name}
            line |= {"fillstyle": fill, **point_marker(grid.size), **style}
            ax.plot(grid, np.broadcast_to(np.asarray(values), grid.shape), **line)
    ax.set_xlabel("wavelength (nm)")
    ax.set_ylabel("reflectance" if isinstance(source, Spectrum) else "reflectance, transmittance")
    # Around all lines of the axes: calls for several sources draw on the same axes.
    ax.set_ylim(0.0, 1.05 * max(float(np.max(np.asarray(line.get_ydata()))) for line in ax.lines))
    ax.legend(frameon=False, fontsize="small", ncols=2 if len(ax.lines) > 4 else 1)
    return ax
