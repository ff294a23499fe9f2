"""Readers of ICESat-2: photons of level 2A (ATL03), ground and canopy of level 3A (ATL08).

**Places.** Photons belong to geolocation segments of some 20 m. The distance of a photon along the track is
that of its segment (`segment_dist_x`) plus its own within the segment (`dist_ph_along`). Segments have
numbers (`segment_id`), which ATL08 uses too: its segments of 100 m are five of them, its values at 20 m are
of one.

**Background.** `bckgrd_rate`, in events per second, comes from histograms of 50 pulses, without the photons
of the surface.

**Impulse.** The instrument's impulse response, of some spots only, is the histogram of light that reaches the
detector through a fibre (the transmitter echo path).

Sources: Neumann et al. (2023), ATLAS/ICESat-2 L2A Global Geolocated Photon Data
(doi:10.5067/ATLAS/ATL03.006); Neuenschwander et al. (2023), ATLAS/ICESat-2 L3A Land and Vegetation Height
(doi:10.5067/ATLAS/ATL08.006).
"""

import dataclasses
import os
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxlidar._fields.checks import check_choice, check_number, check_range, check_shape, warn_user
from jaxlidar.formats.checks import MAX_COORDINATE, MAX_EXACT_INTEGER, FileWarning
from jaxlidar.formats.hdf5 import ProductFile, open_hdf5, text_of_attribute
from jaxlidar.formats.tables import Column, ShotTable

_PHOTONS, _HEIGHTS = "ICESat-2 ATL03", "ICESat-2 ATL08"
BEAMS = ("gt1l", "gt1r", "gt2l", "gt2r", "gt3l", "gt3r")
# Surface types, in the order of the columns of `signal_conf_ph`.
SURFACES = ("land", "ocean", "sea ice", "land ice", "inland water")
# Pulses of a major frame, by which photons are numbered; pulses per second.
_PULSES_PER_FRAME = 200
PULSE_RATE = 1e4
# Values that stand for missing ones where no attribute says so: larger than these, floating-point or integer.
_MAX_NUMBER, _MAX_INTEGER = 1e30, 2**31 - 1
# Largest height, and distance within a segment, m.
_MAX_HEIGHT = 1e5
# Largest time, s since the beginning of 2018: three centuries.
_MAX_TIME = 1e10
# Histogram bins of the transmitter echo around its largest one that hold the impulse, ns.
_IMPULSE_RANGE = (-10.0, 30.0)
# Stands for a missing integer.
_NO_INTEGER = -9999
# Columns of photons with their place, and their datasets.
_PLACES = {"latitude": "lat_ph", "longitude": "lon_ph"}
# Unit of times since the epoch of the product.
_TIMES = "s since 2018-01-01"
# Sub-segments of a segment of ATL08.
_SUBSEGMENTS = 5


class PhotonImpulse(NamedTuple):
    """Impulse response of the instrument: the histogram of the transmitter echo path, background removed.

    - `time`: (bins,) ns from the mean.
    - `power`: (bins,) of unit sum.

    **Example:**

    >>> import numpy as np
    >>> from jaxlidar.formats.icesat2 import PhotonImpulse
    >>> impulse = PhotonImpulse(np.array([-0.5, 0.0, 0.5]), np.array([0.25, 0.5, 0.25]))
    >>> print(f"{np.sqrt(np.sum(impulse.power * impulse.time**2)):.2f} ns")
    0.35 ns
    """

    time: Float[np.ndarray, " bins"]
    power: Float[np.ndarray, " bins"]


@dataclasses.dataclass(frozen=True, eq=False)
class PhotonTrack:
    """Recorded photons along a stretch of one beam's track. `len(track)` is their number.

    - `beam`: name, such as "gt1r".
    - `distance`: (photons,) m along the track, from the beginning of the first segment that was read.
    - `height`: (photons,) m above the ellipsoid of WGS-84.
    - `latitude`, `longitude`: (photons,) degrees.
    - `time`: (photons,) s since the beginning of 2018.
    - `pulse`: (photons,) number of the laser pulse, from 0 for the first one that was read; by time where the
      file lacks numbers.
    - `confidence`: (photons,) the product's confidence that a photon is signal of the surface: 0 noise, 1
      buffer, 2 low, 3 medium, 4 high; below 0 not of this surface, or possibly of the transmitter echo.
    - `quality`: (photons,) the product's flag, 0 nominal.
    - `background_rate`: (photons,) events per second of the background, at the time of each photon; NaN where
      the file has none.
    - `segment`: (photons,) index of the geolocation segment in what follows.
    - `segment_id`: (segments,) the product's numbers of the segments.
    - `segment_start`, `segment_length`: (segments,) m, of the segments along the track, as `distance`.
    - `segment_latitude`, `segment_longitude`: (segments,) degrees, of a photon in the segment.
    - `solar_elevation`: (segments,) degrees.
    - `pulse_width`: ns, mean full width of the transmitted pulse at its lower threshold. None: not in the
      file.
    - `impulse`: the `PhotonImpulse` of the beam's spot. None: not in the file.

    **Example:** two photons of one segment.

    >>> import numpy as np
    >>> from jaxlidar.formats.icesat2 import PhotonTrack
    >>> two, one = np.zeros(2), np.zeros(1)
    >>> numbers = {"pulse": two.astype(int), "confidence": np.array([0, 4]), "quality": two.astype(int)}
    >>> place = {"distance": np.array([3.0, 3.7]), "height": np.array([250.0, 212.0]), "time": two}
    >>> names = ("segment_start", "segment_latitude", "segment_longitude", "solar_elevation")
    >>> rows = dict.fromkeys(names, one) | {"segment_id": np.array([7]), "segment_length": np.array([20.0])}
    >>> track = PhotonTrack(
    ...     beam="gt1r", latitude=two, longitude=two, background_rate=two, segment=two.astype(int), **numbers,
    ...     **place, **rows
    ... )
    >>> print(track)
    2 photons of gt1r over 20 m, 1 of them signal (confidence 2 to 4)
    """

    beam: str
    distance: Float[np.ndarray, " photons"]
    height: Float[np.ndarray, " photons"]
    latitude: Float[np.ndarray, " photons"]
    longitude: Float[np.ndarray, " photons"]
    time: Float[np.ndarray, " photons"]
    pulse: Int[np.ndarray, " photons"]
    confidence: Int[np.ndarray, " photons"]
    quality: Int[np.ndarray, " photons"]
    background_rate: Float[np.ndarray, " photons"]
    segment: Int[np.ndarray, " photons"]
    segment_id: Int[np.ndarray, " segments"]
    segment_start: Float[np.ndarray, " segments"]
    segment_length: Float[np.ndarray, " segments"]
    segment_latitude: Float[np.ndarray, " segments"]
    segment_longitude: Float[np.ndarray, " segments"]
    solar_elevation: Float[np.ndarray, " segments"]
    pulse_width: float | None = None
    impulse: PhotonImpulse | None = None

    def __len__(self) -> int:
        return len(self.height)

    @property
    def length(self) -> float:
        """Length of the stretch in m."""
        return float(self.segment_start[-1] + self.segment_length[-1] - self.segment_start[0])

    def __str__(self) -> str:
        signal = int(np.sum(self.confidence >= 2))
        return (
            f"{len(self):,} photons of {self.beam} over {self.length:.0f} m, {signal:,} of them signal "
            "(confidence 2 to 4)"
        )


def read_atl03(
    path: str | os.PathLike[str],
    beam: str | None = None,
    *,
    stretch: tuple[float, float] | None = None,
    latitude: tuple[float, float] | None = None,
    surface: str = "land",
) -> PhotonTrack:
    """Read the photons of one beam of an ICESat-2 ATL03 file, or of a subset, along a stretch of its track.

    This needs h5py (`pip install "jaxlidar[io]"`). Only the photons of the stretch are read.

    **Arguments:**

    - `path`: an HDF5 file.
    - `beam`: "gt1l", "gt1r" ... "gt3r". Default None: the only one of the file.
    - `stretch`: (start, end) in m along the track, from the first segment of the beam: all segments that
      begin in it. Default None: no limit.
    - `latitude`: (south, north) in degrees, limits of the segments' reference photons. Default None: none.
    - `surface`: that of which `confidence` is: "land", "ocean", "sea ice", "land ice" or "inland water".
      Default "land".

    **Returns:** a `PhotonTrack`.

    **Warns:** `FileWarning` for photons without a height or a distance, which are left out.

    **Raises:** FileNotFoundError where there is no such file. ImportError without h5py. ValueError, naming
    the file and the place, for a file that is not HDF5, is damaged or is no ATL03 product; for a beam that it
    does not have, or none where it has several; and for limits that do not increase or that no segment meets.

    **Source:** Neumann et al. (2023), doi:10.5067/ATLAS/ATL03.006.

    **Example:**

    >>> import inversion, jaxlidar as jl
    >>> track = jl.io.read_atl03("ATL03.h5", "gt1r", stretch=(0.0, 2000.0))  # doctest: +SKIP
    >>> heights = inversion.photon_ground_and_canopy(track)  # doctest: +SKIP
    >>> jl.plot.photons(track, label=heights.label)  # doctest: +SKIP
    """
    check_choice("surface", surface, SURFACES)
    for name, limits in (("stretch", stretch), ("latitude", latitude)):
        if limits is not None:
            check_range(name, limits)
            check_shape(name, limits, (2,))
            if not limits[0] < limits[1]:
                raise ValueError(f"{name} = {tuple(limits)} does not increase; admissible is start < end")
    with open_hdf5(path, _PHOTONS, _is_fill) as file:
        beam = _beam(file, beam, "heights")

        def segments_of(name: str, unit: str = "", needed: bool = True) -> np.ndarray:
            """Return a column of the segments; NaN where a subset has left it out."""
            field = f"{beam}/geolocation/{name}"
            if not needed and not file.has(field):
                return np.full(count.shape, np.nan)
            return file.numbers(field, unit, shape=count.shape)

        count = file.numbers(f"{beam}/geolocation/segment_ph_cnt")
        start = segments_of("segment_dist_x", "m")
        latitudes = segments_of("reference_photon_lat", "degrees", needed=False)
        is_chosen = np.abs(start) <= MAX_COORDINATE
        if stretch is not None:
            origin = start[is_chosen].min() if np.any(is_chosen) else 0.0
            is_chosen &= (start - origin >= stretch[0]) & (start - origin < stretch[1])
        if latitude is not None:
            is_chosen &= (latitudes >= latitude[0]) & (latitudes <= latitude[1])
        (chosen,) = np.nonzero(is_chosen)
        if chosen.size == 0:
            raise ValueError(
                f"{file.location(beam)}: none of its {start.size} segments lies in stretch = {stretch}, "
                f"latitude = {latitude}"
            )
        photons = int(file.dataset(f"{beam}/heights/h_ph").shape[0])
        first_photon = _first_photons(file, beam, count, photons)
        # Segments follow one another in a file: one range of rows holds the photons of all.
        run = np.arange(chosen[0], chosen[-1] + 1)
        rows = slice(int(first_photon[run[0]]), int(first_photon[run[-1]] + count[run[-1]]))
        segment = np.repeat(run, count[run].astype(int))

        def photons_of(name: str, unit: str = "", *columns: int) -> np.ndarray:
            return file.numbers(f"{beam}/heights/{name}", unit, rows=rows, shape=(photons, *columns))

        height, along = photons_of("h_ph", "m"), photons_of("dist_ph_along", "m")
        # Written so that NaN is left out.
        has_place = (np.abs(height) <= _MAX_HEIGHT) & (np.abs(along) <= _MAX_HEIGHT)
        time = photons_of("delta_time", _TIMES)
        has_place &= np.abs(time) <= _MAX_TIME
        is_complete = np.isin(segment, chosen) & has_place
        incomplete = int(np.sum(~has_place))
        if incomplete:
            warn_user(
                f"{file.location(f'{beam}/heights')}: {incomplete} of {height.size} photons have no height, "
                "no distance or no time: they are left out",
                FileWarning,
            )
        confidence = photons_of("signal_conf_ph", "", len(SURFACES))[:, SURFACES.index(surface)]
        quality = (
            photons_of("quality_ph") if file.has(f"{beam}/heights/quality_ph") else np.zeros(height.size)
        )
        names = ("pce_mframe_cnt", "ph_id_pulse")
        has_pulses = all(file.has(f"{beam}/heights/{name}") for name in names)
        pulse = _pulses(*map(photons_of, names)) if has_pulses else np.full(time.shape, _NO_INTEGER)
        if np.any(pulse[is_complete] == _NO_INTEGER):
            pulse = _pulses_by_time(np.where(is_complete, time, np.nan))
        background = _background_rate(file, beam, time)
        width = segments_of("tx_pulse_width_lower", "s", needed=False)
        places = {name: photons_of(field, "degrees")[is_complete] for name, field in _PLACES.items()}
        columns = {
            "segment_id": _whole_numbers(segments_of("segment_id")[chosen]),
            "segment_start": start[chosen] - start[chosen[0]],
            "segment_length": segments_of("segment_length", "m")[chosen],
            "segment_latitude": latitudes[chosen],
            "segment_longitude": segments_of("reference_photon_lon", "degrees", needed=False)[chosen],
            "solar_elevation": segments_of("solar_elevation", "degrees", needed=False)[chosen],
        }
        impulse = _impulse(file, beam)
    mean_width = 1e9 * float(np.nanmean(width)) if np.any(np.isfinite(width)) else None
    first_pulse = int(pulse[is_complete].min(initial=np.iinfo(int).max)) if np.any(is_complete) else 0
    return PhotonTrack(
        beam=beam,
        distance=(start[segment] - start[chosen[0]] + along)[is_complete],
        height=height[is_complete],
        time=time[is_complete],
        pulse=pulse[is_complete] - first_pulse,
        confidence=_whole_numbers(confidence[is_complete]),
        quality=_whole_numbers(quality[is_complete]),
        background_rate=background[is_complete],
        segment=np.searchsorted(chosen, segment[is_complete]),
        pulse_width=mean_width,
        impulse=impulse,
        **places,
        **columns,
    )


def _beam(file: ProductFile, beam: str | None, group: str) -> str:
    """Return the name of a beam that the file has. **Raises:** ValueError."""
    present = [name for name in BEAMS if file.has(f"{name}/{group}")]
    if not present:
        raise ValueError(f"{file.path}: no group gt1l/{group} ... gt3r/{group}: no {file.product} product")
    if beam is None and len(present) > 1:
        raise ValueError(f"{file.path}: beam = None; admissible is one of {', '.join(present)}")
    if beam is None:
        return present[0]
    check_choice("beam", beam, BEAMS)
    if beam not in present:
        raise ValueError(f"{file.path}: beam = {beam!r} is none of {', '.join(present)}")
    return beam


def _is_fill(values: np.ndarray) -> np.ndarray:
    """Return True for the largest numbers of their type, which stand for missing ones."""
    return (np.abs(values) > _MAX_NUMBER) | (values == _MAX_INTEGER)


def _whole_numbers(values: np.ndarray) -> np.ndarray:
    """Return numbers as integers; `_NO_INTEGER` for those that are missing or none."""
    is_whole = np.abs(values) <= MAX_EXACT_INTEGER
    return np.where(is_whole, values, _NO_INTEGER).astype(np.int64)


def _first_photons(file: ProductFile, beam: str, count: np.ndarray, size: int) -> np.ndarray:
    """Return the row of the first photon of each segment.

    Subsets may have kept the rows of the full file: then photons follow one another, as many as the counts.

    **Arguments:** `size`: number of photons of the beam.

    **Raises:** ValueError for counts that are no whole numbers, and where neither rows nor counts fit.
    """
    location = file.location(f"{beam}/geolocation/ph_index_beg")
    if not np.all((count >= 0) & (count == np.floor(count))):
        raise ValueError(
            f"{file.location(f'{beam}/geolocation/segment_ph_cnt')}: counts are no whole numbers"
        )
    by_count = np.cumsum(count) - count
    filled = count > 0
    if file.has(f"{beam}/geolocation/ph_index_beg"):
        # The product counts from 1; segments without photons have 0.
        start = file.numbers(f"{beam}/geolocation/ph_index_beg", shape=count.shape) - 1
        follows = np.all(start[filled][1:] == (start + count)[filled][:-1])
        if follows and np.all((start >= 0)[filled] & (start + count <= size)[filled]):
            # Segments without photons lie between the photons of their neighbours.
            return by_count + (start - by_count)[filled].min(initial=size)
    if count.sum() != size:
        raise ValueError(
            f"{location}: neither do the indices fit the {size} photons stored, nor do the counts "
            f"({count.sum():.0f} in all)"
        )
    return by_count


def _pulses(frame: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Return numbers of the laser pulses of photons, by the product's frames."""
    # What overflows is no whole number.
    with np.errstate(over="ignore", invalid="ignore"):
        return _whole_numbers(_PULSES_PER_FRAME * frame + number)


def _pulses_by_time(time: np.ndarray) -> np.ndarray:
    """Return numbers of the laser pulses of photons in a file without the product's frames."""
    finite_time = time[np.isfinite(time)]
    first = float(finite_time.min()) if finite_time.size else 0.0
    return _whole_numbers(np.rint((time - first) * PULSE_RATE))


def _background_rate(file: ProductFile, beam: str, time: np.ndarray) -> np.ndarray:
    """Return the background in events per second at the times of photons; NaN where there is none."""
    names = [f"{beam}/bckgrd_atlas/{name}" for name in ("delta_time", "bckgrd_rate")]
    if not all(map(file.has, names)):
        return np.full(time.shape, np.nan)
    when = file.numbers(names[0], _TIMES)
    rate = file.numbers(names[1], shape=when.shape)
    is_known = np.isfinite(when) & np.isfinite(rate)
    if not np.any(is_known):
        return np.full(time.shape, np.nan)
    order = np.argsort(when[is_known])
    return np.interp(time, when[is_known][order], rate[is_known][order])


def _impulse(file: ProductFile, beam: str) -> PhotonImpulse | None:
    """Return the impulse response of a beam's spot, or None where the file does not have it.

    The transmitter echo is recorded for spots 1 and 3; `tep_valid_spot` says which of them serves a spot.
    """
    spots = {1: "pce1_spot1", 3: "pce2_spot3"}
    table = "ancillary_data/tep/tep_valid_spot"
    spot = file.attribute(beam, "atlas_spot_number") if file.has(table) else None
    if spot is None:
        return None
    text = text_of_attribute(spot)
    serving = _whole_numbers(file.numbers(table))
    if not text.isdecimal() or not 1 <= int(text) <= serving.size:
        return None
    group = f"atlas_impulse_response/{spots.get(int(serving[int(text) - 1]))}/tep_histogram"
    if not (file.has(f"{group}/tep_hist") and file.has(f"{group}/tep_hist_time")):
        return None
    # Without numbers that are missing, or so large that sums of them overflow.
    time, count = file.numbers(f"{group}/tep_hist_time", "s"), file.numbers(f"{group}/tep_hist")
    # Damaged bytes may be NaN that signal, of which products warn.
    with np.errstate(invalid="ignore"):
        return _impulse_of_histogram(1e9 * time, count)


def _impulse_of_histogram(time: np.ndarray, count: np.ndarray) -> PhotonImpulse | None:
    """Return the part of a histogram around its largest bin, less the mean of the other bins."""
    if time.shape != count.shape or count.size < 2 or not np.all(np.isfinite([time, count])):
        return None
    since_peak = time - time[np.argmax(count)]
    is_impulse = (since_peak >= _IMPULSE_RANGE[0]) & (since_peak <= _IMPULSE_RANGE[1])
    background = float(np.mean(count[~is_impulse])) if np.any(~is_impulse) else 0.0
    power = np.maximum(count[is_impulse] - background, 0.0)
    if not power.sum() > 0:
        return None
    power = power / power.sum()
    return PhotonImpulse(time[is_impulse] - float(np.sum(power * time[is_impulse])), power)


class _HeightField(NamedTuple):
    """A dataset of ATL08: the column that it becomes, its unit and description.

    `at_20_m` is the dataset with the values of the sub-segments, if there is one.
    """

    name: str
    dataset: str
    unit: str
    description: str
    at_20_m: str | None = None


_HEIGHT_FIELDS = (
    _HeightField("latitude", "latitude", "degrees", "of the segment's middle", "latitude_20m"),
    _HeightField("longitude", "longitude", "degrees", "of the segment's middle", "longitude_20m"),
    _HeightField("delta_time", "delta_time", "s", "time since the beginning of 2018"),
    _HeightField("ground", "terrain/h_te_best_fit", "m", "elevation", "terrain/h_te_best_fit_20m"),
    _HeightField("ground_stderr", "terrain/h_te_uncertainty", "m", "the product's uncertainty"),
    _HeightField("slope", "terrain/terrain_slope", "", "rise of the ground along the track"),
    _HeightField("ground_photons", "terrain/n_te_photons", "", "number"),
    _HeightField("canopy", "canopy/h_canopy", "m", "height above the ground", "canopy/h_canopy_20m"),
    _HeightField("canopy_stderr", "canopy/h_canopy_uncertainty", "m", "the product's uncertainty"),
    _HeightField("canopy_photons", "canopy/n_ca_photons", "", "number"),
    _HeightField("snr", "snr", "", "photons of signal over those of noise"),
    _HeightField("solar_elevation", "solar_elevation", "degrees", "of the sun"),
    _HeightField("night_flag", "night_flag", "", "1 by night"),
    _HeightField("landcover", "segment_landcover", "", "class of land cover"),
)


def read_atl08(path: str | os.PathLike[str], beam: str | None = None, *, segment: float = 100.0) -> ShotTable:
    """Read ground and canopy of one beam of an ICESat-2 ATL08 file, or of a subset of one.

    This needs h5py (`pip install "jaxlidar[io]"`).

    **Arguments:**

    - `path`: an HDF5 file.
    - `beam`: "gt1l", "gt1r" ... "gt3r". Default None: the only one of the file.
    - `segment`: length of a row's segment in m: 100, the product's, or 20 for its sub-segments, which version
      5 and later have. Default 100.

    **Returns:** a `ShotTable`. `segment_id` is the number of the first geolocation segment of ATL03 in the
    row, and for 20 m the only one. Other columns, as far as the file has them: `latitude`, `longitude`,
    `ground` and `canopy` (m; above the ellipsoid, and above the ground), and with those of 100 m repeated in
    all five sub-segments `ground_stderr`, `slope`, `ground_photons`, `canopy_stderr`, `canopy_photons`,
    `snr`, `solar_elevation`, `night_flag`, `landcover`, `delta_time`. NaN where the product has no ground, or
    no canopy.

    **Raises:** FileNotFoundError where there is no such file. ImportError without h5py. ValueError, naming
    the file and the place, for a file that is not HDF5, is damaged or is no ATL08 product; for a beam that it
    does not have, or none where it has several; and for another `segment`.

    **Source:** Neuenschwander et al. (2023), doi:10.5067/ATLAS/ATL08.006.

    **Example:**

    >>> import jaxlidar as jl
    >>> product = jl.io.read_atl08("ATL08.h5", "gt1r", segment=20.0)  # doctest: +SKIP
    >>> product["ground"]  # doctest: +SKIP
    """
    check_number("segment", segment)
    if segment not in (20.0, 100.0):
        raise ValueError(f"segment = {segment}; admissible is 20 or 100 m")
    is_fine = segment == 20.0
    with open_hdf5(path, _HEIGHTS, _is_fill) as file:
        beam = _beam(file, beam, "land_segments")
        group = f"{beam}/land_segments"
        first_id = file.numbers(f"{group}/segment_id_beg")
        columns: dict[str, Column] = {}
        for field in _HEIGHT_FIELDS:
            name, fine_name = f"{group}/{field.dataset}", f"{group}/{field.at_20_m}"
            unit = _TIMES if field.name == "delta_time" else field.unit
            if is_fine and field.at_20_m and (field.name in ("ground", "canopy") or file.has(fine_name)):
                values = file.numbers(fine_name, unit, shape=(first_id.size, _SUBSEGMENTS)).ravel()
            elif file.has(name) or field.name == "ground":
                values = file.numbers(name, unit, shape=first_id.shape)
                values = np.repeat(values, _SUBSEGMENTS) if is_fine else values
            else:
                continue
            columns[field.name] = Column(values, field.unit, field.description)
    if is_fine:
        first_id = (first_id[:, None] + np.arange(_SUBSEGMENTS)).ravel()
    number = Column(_whole_numbers(first_id), "", "number of the geolocation segment")
    return ShotTable({"segment_id": number, **columns}, {"product": _HEIGHTS, "beam": beam})
