"""Figures of photon events along a track."""

from typing import Any

import numpy as np
from jaxtyping import ArrayLike
from matplotlib.axes import Axes

from jaxlidar._fields.checks import check_kind, checked_array
from jaxlidar.formats.icesat2 import PhotonTrack
from jaxlidar.plot.style import MATERIAL_COLOURS, OTHER_COLOUR, TOTAL_COLOUR, make_axes
from jaxlidar.sensors.photon_counter import PhotonEvents

# Name, colour and size in points of each label, in the order of drawing: noise lies below the others.
_LABELS = {
    0: ("noise", OTHER_COLOUR, 2.0),
    3: ("signal", TOTAL_COLOUR, 3.0),
    1: ("ground", MATERIAL_COLOURS["ground"], 3.5),
    2: ("canopy", MATERIAL_COLOURS["leaf"], 3.5),
}
# Confidence from which the product of a recorded track takes a photon for signal.
_SIGNAL_CONFIDENCE = 2
# Heights in m beyond ground and canopy that are shown, at least, and as a fraction of their range.
_MARGIN, _RELATIVE_MARGIN = 10.0, 0.25


def photons(
    events: PhotonEvents | PhotonTrack,
    distance: ArrayLike | None = None,
    ax: Axes | None = None,
    *,
    label: ArrayLike | None = None,
    **style: Any,
) -> Axes:
    """Draw the height of each photon event against its distance along the track.

    The axis of heights ends a little beyond the photons of ground and canopy, where there are any: the
    window of a recorded track is many times as high.

    **Arguments:**

    - `events`: `PhotonEvents`, or a `PhotonTrack` of `jaxlidar.io.read_atl03`.
    - `distance`: (shots,) m along the track of each shot of `PhotonEvents`. Default None: events are drawn
      over the numbers of their shots, those of a `PhotonTrack` over their distances.
    - `ax`: the axes to draw on. Default None: those of a new figure.
    - `label`: (events,) class of each event, which colours it: 0 noise, 1 ground, 2 canopy, 3 other signal,
      as `inversion.photon_ground_and_canopy` returns them. Default None: signal or noise, by the truth, or by
      the product's confidence.
    - `style`: style of the points, as for `Axes.plot`.

    **Returns:** the axes.

    **Raises:** ValueError for no event, for distances or labels of another shape, and labels outside 0 to 3;
    TypeError for objects of the wrong type.

    **Example:**

    >>> import jax, jaxlidar as jl
    >>> import jaxlidar.plot
    >>> from matplotlib.figure import Figure
    >>> wave = jl.simulate(jl.Lidar(energy=1e-9), jl.Scene(ground=jl.Ground()), key=jax.random.key(0))
    >>> counter = jl.PhotonCounter(background_rate=5e6)
    >>> events = counter.count(wave, key=jax.random.key(1), pulses=20)
    >>> ax = jaxlidar.plot.photons(events, ax=Figure().subplots())
    >>> print([text.get_text() for text in ax.get_legend().get_texts()])
    ['noise', 'signal']
    """
    check_kind("events", events, PhotonEvents | PhotonTrack, "PhotonEvents or a PhotonTrack")
    if len(events.height) == 0:
        raise ValueError("events has no event; admissible is one or more")
    if isinstance(events, PhotonTrack):
        if distance is not None:
            raise ValueError(
                "distance is given; admissible for a PhotonTrack is None: its photons have theirs"
            )
        x, is_signal = events.distance, events.confidence >= _SIGNAL_CONFIDENCE
    else:
        position = np.arange(len(events.lost), dtype=float)
        if distance is not None:
            position = checked_array("distance", distance, position.shape)
        x, is_signal = position[events.shot], events.signal
    labels = np.where(is_signal, 3, 0)
    if label is not None:
        labels = checked_array("label", label, labels.shape, 0, 3)
    ax = make_axes(ax, (7.4, 3.4))
    points = {"marker": "o", "markeredgewidth": 0, "linestyle": "none"}
    for number, (name, colour, size) in _LABELS.items():
        is_labelled = labels == number
        if np.any(is_labelled):
            look = {"color": colour, "label": name, "markersize": size, **points, **style}
            ax.plot(x[is_labelled], events.height[is_labelled], **look)
    is_class = (labels == 1) | (labels == 2)
    if np.any(is_class):
        low, high = float(events.height[is_class].min()), float(events.height[is_class].max())
        margin = max(_MARGIN, _RELATIVE_MARGIN * (high - low))
        ax.set_ylim(low - margin, high + margin)
    has_shots = distance is None and not isinstance(events, PhotonTrack)
    ax.set_xlabel("shot" if has_shots else "distance along the track (m)")
    ax.set_ylabel("height (m)")
    # Beside the axes: within them it would cover photons.
    ax.legend(markerscale=2.0, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return ax
