"""Reader of recorded waveforms: GEDI's level 1B product.

The product's data dictionary does not say everything about what the fields of a shot refer to. The following
was found from the recorded numbers, and `GediShot` relies on it.

- The time from transmission to the first received bin, 2 `bounce_time_offset_bin0`, equals `rx_open` +
  `rx_offset` - `tx_gloc` plus a constant of the channel, in samples of 1 ns (to 1e-6 ns in some beams, else
  to whole clock steps of 4 ns). So the elevation of a bin is where a target lies whose echo has the *Gaussian
  fit* of the transmitted pulse centred on that bin: time zero of the pulse is `tx_gloc`, counted from sample
  0. (Flat ground fitted with the recorded pulse then lies within 0.1 m of level 2's `elev_lowestmode`.) The
  pulse is skewed: its largest sample comes 0.7 to 1.3 ns before, its centroid 2 to 3 ns after (0.3 to 0.5 m
  of elevation, if confused).
- 2 (`bounce_time_offset_lastbin` - `bounce_time_offset_bin0`) is the number of bins less one, in ns: the two
  elevations are those of the first and the last bin, and bins in between lie evenly, 0.1498 m apart.
- The waveforms are smoothed, the received one as though by a Gaussian of 1.7 ns: noise of neighbouring bins
  has a correlation of 0.92, 0.71, 0.45, 0.21 and then about none, and a standard deviation about half of
  `noise_stddev_corrected`. For fits take every fifth bin as independent, or weight accordingly.

Level 2 results (L2A `elev_lowestmode`, `rh`; L2B `pai`, `cover`) belong to the shot with the same
`GediShot.shot_number`, which is unique in all of the mission.
"""

import contextlib
import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxlidar.io.checks import STEP, STEP_TOLERANCE, existing, refuse_damage
from jaxlidar.io.gedi_beam import Beam
from jaxlidar.io.pedestal import above_pedestal

# Equal samples in a row that noise does not make.
_FLAT = 3


@dataclasses.dataclass(frozen=True, eq=False)
class GediShot:
    """One shot of GEDI's level 1B product, in double precision. Bins are 1 ns; the first is the highest.

    - `beam`: name of the beam's group, such as "BEAM0101".
    - `shot_number`: the product's unique number.
    - `time`: (bins,) ns, 0 at the first bin and increasing downward.
    - `elevation`: (bins,) m above the WGS-84 ellipsoid, decreasing: where a target lies whose echo of
      `pulse_power` has its time zero in that bin.
    - `waveform`: (bins,) received, in counts, noise included.
    - `noise_mean`, `noise_std`: mean and standard deviation of the received noise in counts, as the product
      gives them.
    - `pulse_time`: (samples,) ns, zero at the reference of `elevation`.
    - `pulse_power`: (samples,) transmitted, in counts: pedestal removed, not negative, and zero before and
      after the pulse. For `SampledPulse(time=shot.pulse_time, power=shot.pulse_power)`.
    - `latitude`, `longitude`: of the last bin in degrees.
    - `altitude`: of the instrument in m above the ellipsoid.
    - `zenith`: of the beam at the footprint in degrees, as in `Lidar`.
    - `azimuth`: in degrees clockwise from north, the horizontal direction in which the light travels down, as
      in `Lidar`.
    - `degrade`: the product's flag of degraded pointing or positioning, 0 where neither is. Default None: not
      in the file.
    - `stale_return`: the product's flag, 1 where no return was detected on board and the place of an earlier
      shot's return chose the samples. Default None: not in the file.

    **Example:**

    >>> import numpy as np
    >>> from jaxlidar.io import GediShot
    >>> bins = {"time": np.arange(3.0), "elevation": np.array([20.3, 20.15, 20.0])}
    >>> pulse = {"pulse_time": np.array([-1.0, 0.0, 1.0]), "pulse_power": np.array([0.0, 80.0, 0.0])}
    >>> place = {"latitude": -20.0, "longitude": 25.0, "altitude": 4e5, "zenith": 0.5, "azimuth": 90.0}
    >>> received = {"waveform": np.array([200.0, 260.0, 205.0]), "noise_mean": 202.0, "noise_std": 2.0}
    >>> GediShot(beam="BEAM0101", shot_number=1, **bins, **received, **pulse, **place).signal
    array([-2., 58.,  3.])
    """

    beam: str
    shot_number: int
    time: Float[np.ndarray, " bins"]
    elevation: Float[np.ndarray, " bins"]
    waveform: Float[np.ndarray, " bins"]
    noise_mean: float
    noise_std: float
    pulse_time: Float[np.ndarray, " samples"]
    pulse_power: Float[np.ndarray, " samples"]
    latitude: float
    longitude: float
    altitude: float
    zenith: float
    azimuth: float
    degrade: int | None = None
    stale_return: int | None = None

    @property
    def saturated(self) -> int:
        """Most samples in a row at the largest value of the record, where they are three or more, else 0.

        The level 1B product has no flag of saturation. A receiver or digitiser at its limit repeats one
        value.
        """
        ends = np.flatnonzero(np.diff(np.r_[False, self.waveform == self.waveform.max(), False]))
        longest = int(np.max(ends[1::2] - ends[::2]))
        return longest if longest >= _FLAT else 0

    @property
    def signal(self) -> Float[np.ndarray, " bins"]:
        """The received waveform less the mean noise, in counts."""
        return self.waveform - self.noise_mean


def read_gedi_l1b(
    path: str | os.PathLike[str], shot: int | np.integer | Sequence[int] | np.ndarray | None = None
) -> list[GediShot]:
    """The shots of a GEDI L1B file, or of a subset of one in the same layout.

    This needs h5py (`pip install "jaxlidar[io]"`). Of beams without a shot that is asked for nothing is read
    but, to find shots by number, the numbers.

    Start indices are used where they fit the stored samples. Where they do not, as in subsets that kept the
    numbering of the full file, the shots lie end to end, and the counts say where.

    **Arguments:**

    - `path`: an HDF5 file.
    - `shot`: which shots, an integer or several. A number below the number of shots in the file is an index,
      from 0, into all shots, beam after beam in the order of the file; any other is a shot number. Default
      None: all.

    **Returns:** a list of `GediShot`, in the order asked for; one integer gives a list of one.

    **Raises:** FileNotFoundError where there is no such file. ImportError without h5py. ValueError, naming
    the file and the place, for a file that is not HDF5, is damaged or declares more than it can hold, is no
    GEDI L1B product or holds a shot whose numbers make no sense, such as a pulse without energy or bins that
    are not 1 ns apart, and for a shot that it does not hold.

    **Source:** GEDI L1B product data dictionary (Dubayah et al. 2020, doi:10.5067/GEDI/GEDI01_B.002); Luthcke
    et al. 2019, GEDI waveform geolocation for L1 and L2 products (theoretical basis document).

    **Example:**

    >>> import jaxlidar as jl
    >>> import jaxlidar.io
    >>> (shot,) = jaxlidar.io.read_gedi_l1b("GEDI01_B.h5", shot=0)  # doctest: +SKIP
    >>> pulse = jl.SampledPulse(time=shot.pulse_time, power=shot.pulse_power)  # doctest: +SKIP
    >>> lidar = jl.Lidar(pulse=pulse, zenith=shot.zenith, azimuth=shot.azimuth)  # doctest: +SKIP
    """
    try:
        import h5py
    except ImportError as error:
        raise ImportError('reading HDF5 needs h5py: pip install "jaxlidar[io]"') from error
    path = existing(path)
    with contextlib.ExitStack() as stack:
        with refuse_damage(f"{path}: not a readable HDF5 file"):
            file = stack.enter_context(h5py.File(path, "r"))
            names = [name for name in map(str, file) if name.startswith("BEAM")]
        if not names:
            raise ValueError(f"{path}: no group BEAM...: no GEDI L1B product")
        chosen = _select(path, [Beam(path, file, name) for name in names], shot)
        wanted: dict[Beam, set[int]] = {}
        for beam, i in chosen:
            wanted.setdefault(beam, set()).add(i)
        read = {beam: _shots(beam, sorted(indices)) for beam, indices in wanted.items()}
        return [read[beam][i] for beam, i in chosen]


def _select(path: Path, beams: list[Beam], shot: Any) -> list[tuple[Beam, int]]:
    order = [(beam, i) for beam in beams for i in range(len(beam))]
    if shot is None:
        return order
    wanted = [shot] if isinstance(shot, int | np.integer) else list(shot)
    by_number: dict[int, tuple[Beam, int]] = {}
    chosen = []
    for number in wanted:
        if not isinstance(number, int | np.integer) or isinstance(number, bool):
            raise ValueError(f"shot = {number} is neither an index nor a shot number: both are integers")
        if 0 <= number < len(order):
            chosen.append(order[int(number)])
            continue
        if not by_number:
            by_number = {int(n): (beam, i) for beam in beams for i, n in enumerate(beam.shot_number)}
        if int(number) not in by_number:
            raise ValueError(
                f"{path}: shot = {number} is neither an index in [0, {len(order) - 1}] "
                "nor the number of a shot here"
            )
        chosen.append(by_number[int(number)])
    return chosen


def _shots(beam: Beam, indices: list[int]) -> dict[int, GediShot]:
    received, transmitted = beam.samples("rx", indices), beam.samples("tx", indices)
    return {i: _shot(beam, i, received[i], transmitted[i]) for i in indices}


def _shot(beam: Beam, i: int, received: np.ndarray, transmitted: np.ndarray) -> GediShot:
    # The pointing vector has its elevation above the horizon: it points from the footprint to the sensor.
    above_horizon = beam.number("geolocation/local_beam_elevation", i, 0.0, np.pi / 2 + 1e-6)
    towards = beam.number("geolocation/local_beam_azimuth", i, -2 * np.pi, 2 * np.pi)
    top = beam.number("geolocation/elevation_bin0", i)
    bottom = beam.number("geolocation/elevation_lastbin", i)
    place = beam.at("geolocation/elevation_lastbin", i)
    if bottom >= top:
        raise ValueError(f"{place}: {bottom:g} m is not below the first bin, {top:g} m")
    step, expected = (top - bottom) / (received.size - 1), STEP * np.sin(above_horizon)
    if abs(step - expected) > STEP_TOLERANCE * expected:
        raise ValueError(
            f"{place}: {step:g} m from bin to bin, where 1 ns along the beam is {expected:.4f} m of elevation"
        )
    reference = beam.number("tx_gloc", i, 0.0, transmitted.size - 1)
    pedestal = float(np.median(transmitted[: max(transmitted.size // 4, 1)]))
    return GediShot(
        beam=beam.name,
        shot_number=int(beam.shot_number[i]),
        time=np.arange(received.size, dtype=np.float64),
        elevation=np.linspace(top, bottom, received.size),
        waveform=received,
        noise_mean=beam.number("noise_mean_corrected", i),
        noise_std=beam.number("noise_stddev_corrected", i, 0.0),
        pulse_time=np.arange(transmitted.size) - reference,
        pulse_power=above_pedestal(transmitted, pedestal, beam.at("txwaveform", i)),
        latitude=beam.number("geolocation/latitude_lastbin", i, -90.0, 90.0),
        longitude=beam.number("geolocation/longitude_lastbin", i, -180.0, 360.0),
        altitude=beam.number("geolocation/altitude_instrument", i),
        zenith=max(0.0, 90.0 - float(np.rad2deg(above_horizon))),
        azimuth=float(np.rad2deg(towards) + 180.0) % 360.0,
        degrade=beam.flag("degrade", i),
        stale_return=beam.flag("stale_return", i),
    )
