"""Echoes of recorded shots as points of a point cloud.

A point lies at anchor + t direction, with t the echo's time on the shot's clock, in ns, and the direction per
ns of two-way travel, as PulseWaves and LAS waveform packets have it (`jaxlidar.io.AirborneShot`).
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxlidar.io import AirborneShot
from jaxlidar.survey.decomposition import Echoes


class EchoPoints(NamedTuple):
    """Points of echoes, for `jaxlidar.io.write_las(path, **points._asdict())`.

    - `position`: (n, 3) in the units of the shots, from shot to shot and down each beam.
    - `intensity`: (n,) amplitudes of the echoes.
    - `return_number`, `number_of_returns`: (n,) number of the echo, and of all echoes of its shot.
    - `gps_time`: (n,) s; 0 for shots without one.

    **Example:**

    >>> import numpy as np
    >>> import inversion
    >>> position, number = np.array([[0.0, 0.0, 12.5]]), np.array([1])
    >>> from inversion.metrics.points import EchoPoints
    >>> points = EchoPoints(position, np.array([310.0]), number, number, np.array([2.5]))
    >>> points.position[0, 2]
    np.float64(12.5)
    """

    position: Float[np.ndarray, "n 3"]
    intensity: Float[np.ndarray, " n"]
    return_number: Int[np.ndarray, " n"]
    number_of_returns: Int[np.ndarray, " n"]
    gps_time: Float[np.ndarray, " n"]


def echo_points(shots: Iterable[AirborneShot], echoes: Echoes) -> EchoPoints:
    """Return the positions and attributes of the echoes of shots.

    **Arguments:**

    - `shots`: `jaxlidar.io.AirborneShot`s.
    - `echoes`: those of `gaussian_decomposition`, with times from the first sample of each shot, as
      `jaxlidar.io.stack_shots` gives them.

    **Returns:** an `EchoPoints`. A shot without an echo has no point.

    **Raises:** ValueError for numbers of shots and records that differ.

    **Example:**

    >>> import inversion, numpy as np
    >>> from jaxlidar.io import AirborneShot, Segment, stack_shots
    >>> samples = np.exp(-0.5 * ((np.arange(60) - 20.0) / 3.0) ** 2)
    >>> beam = {"anchor": np.array([0.0, 0.0, 30.0]), "direction": np.array([0.0, 0.0, -0.15])}
    >>> shots = [AirborneShot(0, **beam, returning=(Segment(samples, 100.0),))]
    >>> stack = stack_shots(shots)
    >>> echoes = inversion.gaussian_decomposition(stack.time, stack.signal, noise=0.01, width=3.0)
    >>> print(inversion.echo_points(shots, echoes).position.round(2))
    [[ 0.  0. 12.]]
    """
    shots = list(shots)
    count = np.asarray(echoes.count)
    if count.shape != (len(shots),):
        raise ValueError(f"echoes are of records of shape {count.shape}; admissible is ({len(shots)},)")
    # Indices of shot and echo of every point: entries beyond the count of a shot are empty.
    shot, number = np.nonzero(np.arange(np.shape(echoes.time)[-1]) < count[:, None])
    first_time = np.array([s.time[0] for s in shots])
    anchor = np.array([s.anchor for s in shots]).reshape(-1, 3)
    direction = np.array([s.direction for s in shots]).reshape(-1, 3)
    gps_time = np.array([s.gps_time or 0.0 for s in shots])
    time = first_time[shot] + np.asarray(echoes.time, float)[shot, number]
    return EchoPoints(
        position=anchor[shot] + time[:, None] * direction[shot],
        intensity=np.asarray(echoes.amplitude, float)[shot, number],
        return_number=number + 1,
        number_of_returns=count[shot],
        gps_time=gps_time[shot],
    )
