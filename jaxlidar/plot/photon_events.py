"""Figures of photon events along a track."""

from typing import Any

import numpy as np
from jaxtyping import ArrayLike
from matplotlib.axes import Axes

from jaxlidar._checks import check_kind, check_range, check_shape, concrete_array
from jaxlidar.instrument.photon_counter import PhotonEvents
from jaxlidar.plot.style import MATERIAL_COLOURS, OTHER_COLOUR, TOTAL_COLOUR, make_axes

# Name and colour of each label, in the order of drawing: noise lies below the others.
_LABELS = {
    0: ("noise", OTHER_COLOUR),
    3: ("signal", TOTAL_COLOUR),
    1: ("ground", MATERIAL_COLOURS["ground"]),
    2: ("canopy", MATERIAL_COLOURS["leaf"]),
}


def photons(
    events: PhotonEvents,
    distance: ArrayLike | None = None,
    ax: Axes | None = None,
    *,
    label: ArrayLike | None = None,
    **style: Any,
) -> Axes:
    """Draw the height of each photon event against its distance along the track.

    **Arguments:**

    - `events`: `PhotonEvents`.
    - `distance`: (shots,) m along the track of each shot. Default None: events are drawn over the numbers of
      their shots.
    - `ax`: the axes to draw on. Default None: those of a new figure.
    - `label`: (events,) class of each event, which colours it: 0 noise, 1 ground, 2 canopy, 3 other signal,
      as `inversion.photon_ground_and_canopy` returns them. Default None: the truth, signal or noise.
    - `style`: style of the points, as for `Axes.plot`.

    **Returns:** the axes.

    **Raises:** ValueError for distances or labels of another shape, and labels outside 0 to 3; TypeError for
    objects of the wrong type.

    **Example:**

    >>> import jax, jaxlidar as jl
    >>> import jaxlidar.plot
    >>> from matplotlib.figure import Figure
    >>> wave = jl.simulate(jl.Lidar(energy=1e-9), jl.Scene(ground=jl.Ground()), key=jax.random.key(0))
    >>> counter = jl.PhotonCounter(background_rate=5e6)
    >>> events = jl.record(wave, receiver=counter, mode="photons", key=jax.random.key(1), pulses=20)
    >>> ax = jaxlidar.plot.photons(events, ax=Figure().subplots())
    >>> print([text.get_text() for text in ax.get_legend().get_texts()])
    ['noise', 'signal']
    """
    check_kind("events", events, PhotonEvents, "PhotonEvents")
    position = np.arange(len(events.lost), dtype=float)
    if distance is not None:
        check_range("distance", distance)
        check_shape("distance", distance, position.shape)
        position = concrete_array(distance)
    labels = np.where(events.signal, 3, 0)
    if label is not None:
        check_range("label", label, 0, 3)
        check_shape("label", label, labels.shape)
        labels = concrete_array(label)
    ax = make_axes(ax, (6.4, 3.2))
    points = {"marker": "o", "markersize": 1.5, "markeredgewidth": 0, "linestyle": "none", **style}
    for number, (name, colour) in _LABELS.items():
        is_labelled = labels == number
        if np.any(is_labelled):
            x, y = position[events.shot[is_labelled]], events.height[is_labelled]
            ax.plot(x, y, **{"color": colour, "label": name, **points})
    ax.set_xlabel("shot" if distance is None else "distance along the track (m)")
    ax.set_ylabel("height (m)")
    if ax.lines:
        ax.legend(markerscale=3.0, frameon=False)
    return ax
