"""Figures of photon events along a track."""

from typing import Any

import numpy as np
from jaxtyping import ArrayLike
from matplotlib.axes import Axes

from jaxlidar._checks import check_kind, check_range, check_shape, concrete_array
from jaxlidar.instrument.photon_counter import PhotonEvents
from jaxlidar.plot.style import COLOURS, OTHER, TOTAL, axes_or_new

# Names and colours by label.
_CLASSES = {
    0: ("noise", OTHER),
    3: ("signal", TOTAL),
    1: ("ground", COLOURS["ground"]),
    2: ("canopy", COLOURS["leaf"]),
}


def photons(
    events: PhotonEvents,
    distance: ArrayLike | None = None,
    ax: Axes | None = None,
    *,
    label: ArrayLike | None = None,
    **style: Any,
) -> Axes:
    """Axes with the height of each photon event against its place along the track.

    **Arguments:**

    - `events`: `PhotonEvents`.
    - `distance`: (shots,) m along the track of each shot. Default None: events are drawn over the numbers of
      their shots.
    - `ax`: the axes to draw on. Default None: those of a new figure.
    - `label`: (events,) what colours them: 0 noise, 1 ground, 2 canopy, 3 other signal, as
      `inversion.photon_ground_and_canopy` tells them. Default None: the truth, signal or noise.
    - `style`: of the points, as for `Axes.plot`.

    **Returns:** the axes.

    **Raises:** ValueError for distances or labels of another shape, and labels outside 0 to 3; TypeError for
    things of another kind.

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
    place = np.arange(len(events.lost), dtype=float)
    if distance is not None:
        check_range("distance", distance)
        check_shape("distance", distance, place.shape)
        place = concrete_array(distance)
    numbers = np.where(events.signal, 3, 0)
    if label is not None:
        check_range("label", label, 0, 3)
        check_shape("label", label, numbers.shape)
        numbers = concrete_array(label)
    ax = axes_or_new(ax, (6.4, 3.2))
    look = {"marker": "o", "markersize": 1.5, "markeredgewidth": 0, "linestyle": "none", **style}
    for number, (name, colour) in _CLASSES.items():
        of = numbers == number
        if np.any(of):
            ax.plot(place[events.shot[of]], events.height[of], **{"color": colour, "label": name, **look})
    ax.set_xlabel("shot" if distance is None else "distance along the track (m)")
    ax.set_ylabel("height (m)")
    if ax.lines:
        ax.legend(markerscale=3.0, frameon=False)
    return ax
