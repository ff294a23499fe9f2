"""Figures of vertical profiles of plants and their averaging kernels."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Float
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from jaxlidar._fields.checks import as_numpy
from jaxlidar.plot.style import MATERIAL_COLOURS, TOTAL_COLOUR, WAVELENGTH_COLOURS, make_axes

# Opacity of the band, and colour of a product.
_BAND_OPACITY, _PRODUCT_COLOUR = 0.25, WAVELENGTH_COLOURS[0]
# Size of the figures in inches.
_PROFILE_SIZE, _KERNEL_SIZE = (3.4, 4.2), (4.6, 3.9)


def profile(
    height: ArrayLike,
    density: ArrayLike,
    ax: Axes | None = None,
    *,
    band: Sequence[ArrayLike] | None = None,
    truth: ArrayLike | Sequence[ArrayLike] | None = None,
    product: ArrayLike | Sequence[ArrayLike] | None = None,
    **style: Any,
) -> Axes:
    """Draw a profile of plant area density against height, with its band, the truth and a product.

    Layers are steps: the density is that of the whole layer. The axis of densities ends at the largest of the
    profiles, so that a band up to the bounds of a fit may leave the axes.

    **Arguments:**

    - `height`: (layers + 1,) m, edges of the layers, increasing.
    - `density`: (layers,) plant area density in m2/m3, such as the values of a fit.
    - `ax`: the axes to draw on. Default None: those of a new figure.
    - `band`: (low, high), each (layers,), such as `Retrieval.band`. Default None: no band.
    - `truth`, `product`: (layers,) density in the same layers, or a pair of edges and density in layers of
      its own. Default None: not drawn.
    - `style`: style of the line of the profile, as for `Axes.stairs`.

    **Returns:** the axes.

    **Raises:** ValueError for edges that do not increase, densities of another number than layers, and a band
    that is no pair.

    **Example:**

    >>> import jaxlidar.plot
    >>> from matplotlib.figure import Figure
    >>> edges, density = [0.0, 2.0, 4.0], [0.2, 0.1]
    >>> band = [0.1, 0.0], [0.3, 0.2]
    >>> ax = jaxlidar.plot.profile(edges, density, Figure().subplots(), band=band, truth=[0.25, 0.1])
    >>> [text.get_text() for text in ax.get_legend().get_texts()]
    ['truth', 'estimate', 'band']
    """
    edges, values = _layers("", (height, density))
    profiles = {}
    for name, layers in (("truth", truth), ("product", product)):
        if layers is not None:
            profiles[name] = _layers(name, layers, edges)
    ax = make_axes(ax, _PROFILE_SIZE)
    colours = {"truth": TOTAL_COLOUR, "product": _PRODUCT_COLOUR}
    for name, (layer_edges, layer_density) in profiles.items():
        look = {"linestyle": "--" if name == "truth" else ":", "linewidth": 1.3, "color": colours[name]}
        ax.stairs(
            layer_density, layer_edges, orientation="horizontal", baseline=None, label=name, zorder=3, **look
        )
    line = {"color": MATERIAL_COLOURS["leaf"], "linewidth": 1.6, "label": "estimate", **style}
    ax.stairs(values, edges, orientation="horizontal", baseline=None, zorder=2, **line)
    if band is not None:
        if len(band) != 2:
            raise ValueError(f"band has {len(band)} arrays; admissible are 2, low and high")
        (_, low), (_, high) = (_layers(f"band {i}", end, edges) for i, end in enumerate(band))
        # Rectangles, one a layer: `fill_betweenx` would join the middles of layers.
        ax.barh(
            edges[:-1], high - low, np.diff(edges), low, align="edge", linewidth=0, zorder=1, label="band",
            color=line["color"], alpha=_BAND_OPACITY,
        )  # fmt: skip
    largest = max([float(np.nanmax(d, initial=0.0)) for _, d in [(edges, values), *profiles.values()]])
    lowest = min([float(np.nanmin(d, initial=0.0)) for _, d in [(edges, values), *profiles.values()]])
    ax.set_xlim(1.05 * lowest, 1.3 * largest or 1.0)
    ax.set_ylim(edges[0], edges[-1])
    ax.set_xlabel("plant area density (m²/m³)")
    ax.set_ylabel("height above the ground (m)")
    if profiles or band is not None:
        ax.legend(frameon=False, fontsize="small")
    return ax


def averaging_kernel(
    kernel: Any, height: ArrayLike | None = None, ax: Axes | None = None, **style: Any
) -> Axes:
    """Draw an averaging kernel: how the estimate in each layer (rows) follows the truth in each (columns).

    A kernel on the diagonal alone resolves every layer. A row spread over several columns is a mean of these
    layers, and an empty row is a layer that the data do not determine or that lies at a bound. The degrees of
    freedom for signal stand above.

    **Arguments:**

    - `kernel`: what `fit.averaging_kernel` returns, or its (layers, layers) matrix.
    - `height`: (layers + 1,) edges of the layers in m, increasing. Default None: numbers of the layers.
    - `ax`: the axes to draw on. Default None: those of a new figure.
    - `style`: style of the image, as for `Axes.pcolormesh`.

    **Returns:** the axes.

    **Raises:** ValueError for a matrix that is not square, and edges of another number or that do not
    increase.

    **Example:**

    >>> import numpy as np
    >>> import jaxlidar.plot
    >>> from matplotlib.figure import Figure
    >>> ax = jaxlidar.plot.averaging_kernel(0.5 * np.eye(4), ax=Figure().subplots())
    >>> ax.get_title()
    '2.0 degrees of freedom in 4 layers'
    """
    matrix = as_numpy(getattr(kernel, "matrix", kernel), "kernel")
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or not matrix.size:
        raise ValueError(f"kernel has shape {matrix.shape}; admissible is (layers, layers)")
    count = len(matrix)
    edges = np.arange(count + 1.0) + 0.5 if height is None else _edges("height", height)
    if len(edges) != count + 1:
        raise ValueError(f"height has {len(edges)} edges; admissible are {count + 1} for {count} layers")
    ax = make_axes(ax, _KERNEL_SIZE)
    # Both signs have the same range of colours: white is no response.
    largest = float(np.abs(matrix).max()) or 1.0
    look = {"cmap": "RdBu_r", "vmin": -largest, "vmax": largest, **style}
    image = ax.pcolormesh(edges, edges, matrix, **look)
    ax.plot(edges[[0, -1]], edges[[0, -1]], color=TOTAL_COLOUR, linewidth=0.5, linestyle=":")
    ax.figure.colorbar(image, ax=ax, label="d estimate / d truth")
    # Layers that no truth moves: hatched, as white alone is also a small response.
    for i in np.flatnonzero(~np.any(matrix, axis=1)):
        ax.axhspan(edges[i], edges[i + 1], facecolor="none", edgecolor="#BBBBBB", hatch="////", linewidth=0)
    unit = "layer" if height is None else "height (m)"
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MaxNLocator(nbins=5, integer=True))
    ax.set(aspect="equal", xlabel=f"true {unit}", ylabel=f"estimated {unit}")
    ax.set_title(f"{np.trace(matrix):.1f} degrees of freedom in {count} layers", fontsize="small")
    return ax


def _edges(name: str, height: ArrayLike) -> Float[np.ndarray, " edges"]:
    """Return edges of layers. **Raises:** ValueError unless they increase."""
    edges = as_numpy(height, name)
    if edges.ndim != 1 or edges.size < 2 or not np.all(np.diff(edges) > 0):
        raise ValueError(f"{name} has shape {edges.shape}; admissible are two edges or more, increasing")
    return edges


def _layers(
    name: str, layers: Any, edges: Float[np.ndarray, " edges"] | None = None
) -> tuple[Float[np.ndarray, " edges"], Float[np.ndarray, " layers"]]:
    """Return edges and densities of layers, given as a pair, or as densities in the layers of `edges`."""
    prefix = f"{name} " if name else ""
    is_pair = edges is None or (len(layers) == 2 and np.ndim(layers[0]) == np.ndim(layers[1]) == 1)
    if is_pair:
        layer_edges, density = _edges(f"{prefix}height", layers[0]), layers[1]
    else:
        assert edges is not None
        layer_edges, density = edges, layers
    values = as_numpy(density, f"{prefix}density")
    if values.shape != (layer_edges.size - 1,):
        raise ValueError(
            f"{prefix}density has shape {values.shape}; admissible is {(layer_edges.size - 1,)}, one for "
            "each layer between the edges"
        )
    return layer_edges, values
