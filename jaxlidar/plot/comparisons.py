"""Figures of estimates against a reference."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from jaxlidar._fields.checks import as_numpy, check_kind
from jaxlidar.plot.style import OTHER_COLOUR, TOTAL_COLOUR, WAVELENGTH_COLOURS

# Axes beside one another, and the size of one in inches.
_PER_ROW, _AXES_SIZE = 3, 3.0
# Classes of each quantity that have a colour of their own.
_MAX_CLASSES = len(WAVELENGTH_COLOURS)
# Margin around the values, as a fraction of their range.
_MARGIN = 0.05


def comparison(pairs: Mapping[str, Any], axes: Any = None, **style: Any) -> list[Axes]:
    """Draw estimates against their reference, one square for each quantity, with the line of equality.

    Bars are one standard error of the estimates. Bias and root mean square difference stand above.

    **Arguments:**

    - `pairs`: by name of the quantity, a tuple of (rows,) reference, estimate and, if known, standard errors,
      classes (texts, a colour for each) and the unit: `inversion.compare(...).pairs`.
    - `axes`: as many axes as there are quantities. Default None: those of a new figure.
    - `style`: style of the points, as for `Axes.errorbar`.

    **Returns:** the axes.

    **Raises:** TypeError for `pairs` that is no mapping. ValueError for another number of axes, for arrays of
    different lengths, and for no quantity.

    **Example:**

    >>> import numpy as np, jaxlidar as jl
    >>> import jaxlidar.plot
    >>> from matplotlib.figure import Figure
    >>> ground = (np.array([101.0, 99.0]), np.array([101.2, 98.9]), np.array([0.1, 0.1]))
    >>> (ax,) = jaxlidar.plot.comparison({"ground": ground}, [Figure().subplots()])
    >>> print(ax.get_title())
    2 rows, bias 0.05, rmse 0.158
    """
    check_kind("pairs", pairs, Mapping, "a mapping of names to reference and estimate")
    if not pairs:
        raise ValueError("pairs is empty; admissible is at least one quantity")
    drawn = _new_axes(len(pairs)) if axes is None else list(np.ravel(axes))
    if len(drawn) != len(pairs):
        raise ValueError(f"axes has {len(drawn)} axes; admissible is one for each of the {len(pairs)} pairs")
    for ax, (name, pair) in zip(drawn, pairs.items()):
        _draw_pair(ax, name, tuple(pair), style)
    return drawn


def _new_axes(count: int) -> list[Axes]:
    from matplotlib import pyplot

    columns = min(count, _PER_ROW)
    rows = math.ceil(count / columns)
    size = (_AXES_SIZE * columns, _AXES_SIZE * rows)
    figure, grid = pyplot.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained")
    for ax in grid.flat[count:]:
        figure.delaxes(ax)
    return list(grid.flat[:count])


def _draw_pair(ax: Axes, name: str, pair: tuple, style: dict[str, Any]) -> None:
    """Draw one quantity."""
    if len(pair) < 2:
        raise ValueError(f"{name} has {len(pair)} arrays; admissible are reference and estimate at least")
    reference, estimate = (as_numpy(values, f"{name} {i}") for i, values in enumerate(pair[:2]))
    stderr = as_numpy(pair[2], f"{name} stderr") if len(pair) > 2 else np.full(reference.shape, np.nan)
    group = np.asarray(pair[3]).astype(str) if len(pair) > 3 else np.full(reference.shape, "")
    unit = f" ({pair[4]})" if len(pair) > 4 and pair[4] else ""
    shapes = {array.shape for array in (reference, estimate, stderr, group)}
    if len(shapes) != 1 or reference.ndim != 1:
        raise ValueError(f"{name} has arrays of the shapes {sorted(shapes)}; admissible is (rows,) for all")
    ends = np.concatenate([reference, estimate])
    ends = ends[np.isfinite(ends)]
    low, high = (float(ends.min()), float(ends.max())) if ends.size else (0.0, 1.0)
    margin = _MARGIN * (high - low) or 0.5
    limits = (low - margin, high + margin)
    ax.plot(limits, limits, color=OTHER_COLOUR, linewidth=0.8)
    labels = np.unique(group)
    for number, label in enumerate(labels[:_MAX_CLASSES]):
        is_member = group == label
        # NaN bars would warn; without an error there is none.
        bars = np.nan_to_num(stderr[is_member], nan=0.0)
        colour = TOTAL_COLOUR if len(labels) == 1 else WAVELENGTH_COLOURS[number]
        points = {"fmt": "o", "markersize": 3.0, "elinewidth": 0.7, "color": colour, "label": label, **style}
        ax.errorbar(reference[is_member], estimate[is_member], yerr=bars, **points)
    is_other = np.isin(group, labels[_MAX_CLASSES:])
    if is_other.any():
        ax.plot(
            reference[is_other], estimate[is_other], "o", markersize=3.0, color=OTHER_COLOUR, label="other"
        )
    difference = estimate - reference
    difference = difference[np.isfinite(difference)]
    if difference.size:
        rmse = math.sqrt(float(np.mean(difference**2)))
        ax.set_title(
            f"{difference.size} rows, bias {difference.mean():.3g}, rmse {rmse:.3g}", fontsize="small"
        )
    ax.set(xlim=limits, ylim=limits, aspect="equal")
    ax.set_xlabel(f"reference {name}{unit}")
    ax.set_ylabel(f"{name}{unit}")
    if len(labels) > 1:
        ax.legend(frameon=False, fontsize="small")
