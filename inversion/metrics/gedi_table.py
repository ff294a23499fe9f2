r"""One row of each GEDI shot: ground, relative heights, cover and plant area in closed form, with errors.

Optionally the row also has the fit of a layered canopy, by `gedi_fit.py`, under names of its own.

**Ground.** The matched mode of `find_ground`. Noise of standard deviation s, correlated over the receiver's
smoothing of r samples, moves the mode of a record that is smoothed by a Gaussian of k samples: with w^2 = r^2
+ k^2 and c the curvature of the smoothed record at its mode,

    var(mode) = s^2 r / (2 w^3 c^2)    (samples squared).

The echo of sloping ground and low plants is wider than the pulse, and its mode is that of their mixture: the
standard error of the ground adds, in quadrature, a fraction of the excess width, and the reproducibility of
the mode on flat ground.

**Relative heights.** The fraction F of the energy below a height has by noise the variance s^2 K (n_b (1 -
F)^2 + n_a F^2) / E^2, with n_b and n_a samples of signal below and above, K the sum of the noise's
autocorrelation and E the energy. A height moves by that over the density dF/dz, and with the ground.

**Cover and plant area.** The split of `ground_and_canopy`. Their errors are those of the ground's height, of
the shape of its echo, and of the noise of the energies (`_plants`).

**Sensitivity.** The largest cover under which the ground is detected: one less the energy of the weakest echo
of the pulse that rises above the threshold of modes, over the energy of the record (Hancock et al. 2019).

**Records without noise.** Simulated shots may have the noise 0, and no sample below their mean noise. They
have no sensitivity, and their quality is not judged by noise. Their thresholds are as in `gedi.py`.

Records are padded to one length and computed in batches of one size, so that any number of shots, of any
lengths, compiles each program once.
"""

import os
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float

from inversion.fit.quality import Verdict
from inversion.metrics.cover import ground_and_canopy, plant_area_profile
from inversion.metrics.gedi import (
    NOISE_OF_THRESHOLDS,
    RECEIVER_SMOOTHING,
    gedi_settings,
    judge_shot,
    list_of_shots,
    metrics_of_records,
    pad_shots,
    pulse_samples,
    record_above_noise,
)
from inversion.metrics.gedi_fit import CANOPY, ESTIMATES, LAYER_ESTIMATES, fit_gedi_shots
from inversion.metrics.heights import find_ground, signal_ends
from inversion.metrics.records import SMOOTHING
from inversion.scene.layered_canopy import LAYERS, REFLECTANCE_RATIO
from jaxlidar import Progress
from jaxlidar.extend import (
    as_numpy,
    check_integer,
    check_kind,
    check_number,
    check_range,
    even_step,
)
from jaxlidar.formats.gedi import IncompleteShot, read_gedi_rows
from jaxlidar.formats.tables import ColumnAxis
from jaxlidar.io import Column, GediShot, ShotTable
from jaxlidar.progress import ProgressOption, shows_progress
from jaxlidar.results.store import check_store_path
from jaxlidar.survey.records import record_bucket

# Setting groups of the product, and shots that are computed at once.
_GROUPS, _BATCH = range(1, 7), 64
# Groups whose threshold of modes noise hardly exceeds: 4 standard deviations or more.
_STRICT_GROUPS = (1, 3, 4, 6)
# Rounding of a sample that is stored in single precision, as a fraction.
_ROUNDING = 2.0 * np.finfo(np.float32).eps
# Fewest samples of a record.
_MIN_SAMPLES = 5
# Sum of the noise's autocorrelation, 2 sqrt(pi) r with the receiver's smoothing r.
_CORRELATION_SUM = 2.0 * np.sqrt(np.pi) * RECEIVER_SMOOTHING
# Fewest samples above the signal from which noise is estimated, and their distance from it in m. Where there
# are fewer it is this fraction of the product's, which is that before smoothing.
_MIN_QUIET, _QUIET_DISTANCE, _SMOOTHED_FRACTION = 50, 5.0, 0.41
# Reproducibility of the mode of flat ground in m, and the fraction of the excess width of its echo by which
# slopes and low plants move it.
_MODE_ERROR, _EXCESS_FRACTION = 0.02, 0.015
# Relative error of the ground's energy, which its lower half tells: echoes are not just as the pulse.
_SPLIT_ERROR = 0.025
# Below this sensitivity dense canopies hide the ground. Grounds of setting groups further apart than this in
# m leave it open which of the modes is the ground.
_LEAST_SENSITIVITY, _AMBIGUOUS_GROUND = 0.9, 2.0
# Limit of the gap probability, below which there is no ground to measure it by.
_SMALLEST_GAP = 1e-3
# Edges of the layers in m above the ground: those of the product.
_EDGES = 5.0 * np.arange(31)
_RH_AXIS = ColumnAxis("percentile", np.arange(101.0), "percent")


@shows_progress
def gedi_table(
    shots: Any,
    *,
    group: int = 1,
    edges: Float[ArrayLike, " edges"] | Sequence[float] | None = None,
    reflectance_ratio: float = 1.5,
    projection: float = 0.5,
    clumping: float = 1.0,
    fit: bool = False,
    path: str | os.PathLike[str] | None = None,
    progress: ProgressOption = None,
) -> ShotTable:
    """Return a table of GEDI shots: ground, relative heights, cover and plant area, with standard errors.

    A shot that cannot be read or computed has a row of NaN, the quality "bad" and the reason. Standard errors
    are those of noise, of the ground and of its width; they do not contain the assumed reflectance ratio,
    projection and clumping.

    **Arguments:**

    - `shots`: one or several paths of level 1B files, all of whose shots are read, or a list of shots of
      `jaxlidar.io.read_gedi_l1b`.
    - `group`: setting group of the columns `rh` and `elev_lowestmode`, 1 to 6. Default 1.
    - `edges`: (edges,) heights of the layers' edges above the ground in m, increasing. Default: 30 layers of
      5 m, as in level 2B.
    - `reflectance_ratio`: of plants over ground, above 0. Default 1.5, level 2B's.
    - `projection`: of plant area, as for `plant_area_index`. Default 0.5.
    - `clumping`: index of clumping, as for `plant_area_index`. Default 1.
    - `fit`: also fit a layered canopy over sloping ground to each shot, see below. Default False.
    - `path`: a Zarr store of every fit that has ended, as for `inversion.retrieve_many`: the same call
      continues with it. Default None: no store.
    - `progress`: True for a bar; or a function called with a `Progress` after each batch of shots, and after
      each fit. Default None: silent.

    **Returns:** a `jaxlidar.io.ShotTable`, a row for each shot in their order, with

    - `shot_number`, `beam`, `latitude`, `longitude` (of the last bin), `delta_time`, `solar_elevation`,
      `degrade`, `stale_return`, NaN where the file does not have them, and `sensitivity`, NaN for a simulated
      record without noise (`noise_std` is 0);
    - `ground`, `ground_stderr`: elevation of the matched mode;
    - `elev_lowestmode`, `elev_highestreturn`, `num_detectedmodes`, `rh` (shots, 101), `rh_stderr` of setting
      group `group`, and `elev_lowestmode_a1` ... `rh_a6` of all groups, by the rules of level 2A;
    - `cover`, `pai`, `plant_area_density` (shots, layers), each with `..._stderr`;
    - `quality`: "good", "doubtful" or "bad", and `reasons`;
    - with `fit`, the columns `fit_...`, described below.

    **Fits.** The scene, its unknowns and what is fixed are those of `inversion.metrics.gedi_fit`; `edges`,
    `reflectance_ratio`, `projection` and `clumping` do not act on it. The columns are

    - `fit_ground`, `fit_canopy_top`, `fit_slope`, `fit_pai` (of the layers), and `fit_plant_area_density`
      (shots, 10) of ten layers of equal thickness from 1 m above `fit_ground` to `fit_canopy_top`, each with
      `..._stderr`, the robust standard error of the fit. To that of the top is added that upper layers may be
      empty: two standard errors reach down to the underside of the uppermost layer that the record shows;
    - `fit_reduced_chi2`;
    - `fit_quality` and `fit_reasons`: of record and fit, about the ground. A shot that cannot be fitted is
      bad and has NaN.

    They compile for about a minute, and then take about a second of one core each.

    The closed forms are the first choice: `examples/validation` compares both with the products. The fitted
    ground is low, by 0.08 m in the median of 43 good fits of a savanna and by 0.32 m or more in a tenth. The
    likely cause is relief: it gives the ground's echo shoulders, which a plane under plants explains by low
    plants, with the ground below them. Two standard errors hold the product's ground in 84 % and its plant
    area in 60 % of them. `fit_canopy_top` lies up to some metres above the plants where the uppermost layers
    are all but empty: its two standard errors hold the product's highest return in 95 % of them, and the true
    top in more than nine of ten simulated shots.

    **Warns:** `jaxlidar.io.FileWarning` for beams that cannot be read.

    **Raises:** TypeError for things that are neither paths nor shots. FileNotFoundError, and ValueError for
    files that are not GEDI L1B; ValueError for numbers outside their ranges, and for a `path` without `fit`.
    What `inversion.retrieve_many` raises for `path`. Never for a single shot.

    **Source:** Hofton and Blair (2019) and Tang and Armston (2019), GEDI theoretical basis documents; Hancock
    et al. (2019), Earth Space Sci. 6, 294, for the sensitivity.

    **Example:** of one made-up shot over flat ground at 100 m.

    >>> import inversion, jaxlidar as jl, numpy as np
    >>> elevation = 120.0 - 0.15 * np.arange(300)
    >>> record = 200.0 + 400.0 * np.exp(-0.5 * ((elevation - 100.0) / 0.9) ** 2)
    >>> lag = np.arange(-20.0, 21.0)
    >>> pulse = {"pulse_time": lag, "pulse_power": np.exp(-0.5 * (lag / 6.0) ** 2)}
    >>> place = {"latitude": 0.0, "longitude": 0.0, "altitude": 4e5, "zenith": 0.0, "azimuth": 0.0}
    >>> received = {"elevation": elevation, "waveform": record, "noise_mean": 200.0, "noise_std": 3.0}
    >>> shot = jl.io.GediShot("BEAM0101", 7, np.arange(300.0), **received, **pulse, **place)
    >>> table = inversion.gedi_table([shot])
    >>> print(f"{table['ground'][0]:.1f} m, RH98 {table['rh'][0, 98]:.1f} m, {table['quality'][0]}")
    100.0 m, RH98 2.4 m, good
    """
    group = check_integer("group", group, 1, len(_GROUPS))
    check_number("reflectance_ratio", reflectance_ratio, 0.0, low_open=True)
    check_number("projection", projection, 0.0, 1.0, low_open=True)
    check_number("clumping", clumping, 0.0, low_open=True)
    layer_edges = _EDGES if edges is None else as_numpy(edges, "edges")
    check_range("edges", layer_edges)
    if layer_edges.ndim != 1 or layer_edges.size < 2 or not np.all(np.diff(layer_edges) > 0):
        raise ValueError(f"edges = {edges}; admissible are two heights or more, increasing")
    check_kind("fit", fit, bool | np.bool_, "True or False")
    check_kind("path", path, str | os.PathLike | None, "a path, or None")
    if path is not None:
        if not fit:
            raise ValueError(f"path = {os.fspath(path)!r} is the store of fits: it needs fit=True")
        # Before the closed forms, which take their time.
        check_store_path(Path(path))
    start_time = time.perf_counter()
    rows = _rows_of(shots)
    refusals = [_refusal(row) for row in rows]
    verdicts = [judge_shot(row) if e is None else Verdict("bad", (e,)) for row, e in zip(rows, refusals)]
    # Shots whose records can be computed; the others keep their rows of NaN.
    usable = np.array([i for i, refusal in enumerate(refusals) if refusal is None], int)
    padded_size = record_bucket(max((np.size(rows[i].waveform) for i in usable), default=1))
    structure = _CanopyStructure(layer_edges, float(reflectance_ratio), float(projection), float(clumping))
    estimates = _empty_estimates(len(rows), layer_edges.size - 1)
    for first in range(0, usable.size, _BATCH):
        batch = usable[first : first + _BATCH]
        computed = _estimate([rows[i] for i in batch], padded_size, group, structure)
        for name, values in computed.items():
            estimates[name][batch] = values
        if callable(progress):
            seconds = time.perf_counter() - start_time
            progress(Progress(int(first + batch.size), int(usable.size), seconds))
    verdicts = [_verdict_after(rows[i], verdict, estimates, i) for i, verdict in enumerate(verdicts)]
    table = _table(rows, estimates, verdicts, group, structure)
    if not fit:
        return table

    columns, attributes = _fit_columns(rows, estimates, verdicts, path, progress)
    return ShotTable(table.columns | columns, table.attributes | attributes)


# -- shots and verdicts ------------------------------------------------------------------------------------


def _rows_of(shots: Any) -> list[Any]:
    """Return the shots of files or of a list, those of files that cannot be read as `IncompleteShot`.

    **Raises:** TypeError for other things; FileNotFoundError and ValueError for files.
    """
    if isinstance(shots, str | os.PathLike):
        return read_gedi_rows(shots)
    if isinstance(shots, GediShot) or not isinstance(shots, Iterable):
        raise TypeError(
            f"shots is a {type(shots).__name__}; admissible are paths, or a list of shots, as in "
            "gedi_table([shot])"
        )
    items = list(shots)
    if items and all(isinstance(item, str | os.PathLike) for item in items):
        return [row for path in items for row in read_gedi_rows(path)]
    return list_of_shots(items)


def _refusal(shot: Any) -> str | None:
    """Return the reason why a shot cannot be computed, or None."""
    if isinstance(shot, IncompleteShot):
        return str(shot.error)
    try:
        record = record_above_noise(shot)
        check_integer("number of samples", shot.waveform.size, _MIN_SAMPLES)
        even_step("elevation", shot.elevation, decreasing=True)
        check_number("noise_std", shot.noise_std, 0.0)
        rounding = _ROUNDING * np.max(np.abs(shot.waveform))
        if shot.noise_std == 0 and record.min() < -rounding:
            raise ValueError(
                f"noise_std = 0, but a sample is {-record.min():.3g} below noise_mean; admissible is 0 for a "
                "record without noise"
            )
        power = pulse_samples(shot)
        check_range("pulse_power", power)
        check_number("largest pulse_power", power.max(), 0.0, low_open=True)
        check_number("zenith", shot.zenith, 0.0, 90.0, high_open=True)
    except (AttributeError, TypeError, ValueError) as error:
        return str(error)
    return None


def _verdict_after(row: Any, verdict: Verdict, estimates: dict[str, np.ndarray], i: int) -> Verdict:
    """Return the worse of the verdict on a record and that on its estimates."""
    if verdict.quality == "bad" and not np.isfinite(estimates["elev_highestreturn"][i]):
        return verdict
    if not np.isfinite(estimates["ground"][i]):
        return verdict & Verdict("bad", ("no ground above the noise",))
    sensitivity = float(estimates["sensitivity"][i])
    # Written so that NaN fails; records without noise have no sensitivity.
    if row.noise_std > 0 and not sensitivity >= _LEAST_SENSITIVITY:
        reason = f"sensitivity {sensitivity:.2f}: dense canopies hide the ground"
        verdict &= Verdict("doubtful", (reason,))
    lowest_modes = [estimates[f"elev_lowestmode_a{n}"][i] for n in _STRICT_GROUPS]
    modes = np.array([*lowest_modes, estimates["ground"][i]])
    spread = float(np.nanmax(modes) - np.nanmin(modes))
    if spread > _AMBIGUOUS_GROUND:
        verdict &= Verdict("doubtful", (f"ground: setting groups differ by {spread:.1f} m",))
    return verdict


# -- estimates ---------------------------------------------------------------------------------------------


class _CanopyStructure(NamedTuple):
    """Edges of the layers in m, and what turns energies into plant area: see `gedi_table`."""

    edges: np.ndarray
    reflectance_ratio: float
    projection: float
    clumping: float


def _empty_estimates(shots: int, layers: int) -> dict[str, np.ndarray]:
    """Return the columns that are estimated, filled with NaN."""
    columns: dict[str, tuple[int, ...]] = dict.fromkeys(_ESTIMATES, (shots,))
    columns |= dict.fromkeys(
        ("rh", "rh_stderr", *(f"rh_a{n}" for n in _GROUPS)), (shots, _RH_AXIS.values.size)
    )
    columns |= dict.fromkeys((f"elev_lowestmode_a{n}" for n in _GROUPS), (shots,))
    columns |= dict.fromkeys(("plant_area_density", "plant_area_density_stderr"), (shots, layers))
    return {name: np.full(shape, np.nan) for name, shape in columns.items()}


def _estimate(
    shots: list[Any], padded_size: int, group: int, structure: _CanopyStructure
) -> dict[str, np.ndarray]:
    """Return the estimates of at most `_BATCH` shots, by column.

    Rows are filled up to `_BATCH` by the first shot, so that all batches share their programs.
    """
    count = len(shots)
    filled = [*shots, *shots[:1] * (_BATCH - count)]
    records = np.zeros((_BATCH, padded_size))
    for row, shot in enumerate(filled):
        records[row, : shot.waveform.size] = shot.waveform - shot.noise_mean
    n_samples = np.array([shot.waveform.size for shot in filled])
    heights = np.array([np.asarray(shot.elevation, float)[[0, -1]] for shot in filled])
    top, step = heights[:, 0], (heights[:, 0] - heights[:, 1]) / (n_samples - 1)
    # Heights over the first sample: elevations lose 0.1 mm to 1 mm in single precision.
    height = -step[:, None] * np.arange(padded_size)
    noise_std = np.array([float(shot.noise_std) for shot in filled])
    least_noise = NOISE_OF_THRESHOLDS * np.max(np.abs(records), axis=1)
    threshold_noise = np.where(noise_std > 0, noise_std, least_noise)
    pulse = np.stack([pulse_samples(shot) for shot in filled])

    padded = pad_shots(filled, size=padded_size, is_checked=True)
    estimates: dict[str, np.ndarray] = {}
    for n, metrics in zip(_GROUPS, metrics_of_records(padded, [gedi_settings(n) for n in _GROUPS])):
        estimates[f"elev_lowestmode_a{n}"], estimates[f"rh_a{n}"] = metrics.elev_lowestmode, metrics.rh
        if n == group:
            for name in (
                "elev_lowestmode",
                "elev_highestreturn",
                "elev_lowestreturn",
                "num_detectedmodes",
                "rh",
            ):
                estimates[name] = np.asarray(getattr(metrics, name), float)

    record_noise = _quiet_noise(records, n_samples, step, top - estimates["elev_highestreturn"], noise_std)
    ground = np.asarray(find_ground(height, records, pulse=pulse, noise=threshold_noise), float)
    ground_stderr = _ground_stderr(records, step, ground, pulse, record_noise)
    estimates["ground"], estimates["ground_stderr"] = top + ground, ground_stderr
    estimates["sensitivity"] = _sensitivity(records, pulse, noise_std)
    estimates["rh_stderr"] = _rh_stderr(estimates, records, step, record_noise, ground_stderr)
    zenith = np.array([shot.zenith for shot in filled])
    batch = _BatchRecords(height, records, step, pulse, threshold_noise, record_noise, zenith)
    estimates |= _plants(batch, ground, structure, estimates)
    return {name: values[:count] for name, values in estimates.items()}


def _quiet_noise(
    records: np.ndarray, n_samples: np.ndarray, step: np.ndarray, depth: np.ndarray, noise_std: np.ndarray
) -> np.ndarray:
    """Return the standard deviation of the noise in the records, from the samples above the signal.

    **Arguments:** `depth`: (shots,) m from the first sample to the highest return.
    """
    quiet = np.nan_to_num((depth - _QUIET_DISTANCE) / step, nan=0.0).astype(int)
    quiet = np.clip(quiet, 0, n_samples)
    noise = _SMOOTHED_FRACTION * noise_std
    for row, size in enumerate(quiet):
        if size >= _MIN_QUIET:
            noise[row] = np.std(records[row, :size])
    return noise


def _smoothing_width(pulse: np.ndarray) -> np.ndarray:
    """Return the standard deviation in samples of the Gaussian that smooths the records, (shots,)."""
    return SMOOTHING * np.sqrt(_pulse_variance(pulse))


def _ground_stderr(
    records: np.ndarray, step: np.ndarray, ground: np.ndarray, pulse: np.ndarray, noise: np.ndarray
) -> np.ndarray:
    """Return the standard error of the matched mode in m, (shots,): see the module's docstring."""
    width = _smoothing_width(pulse)[:, None]
    # The derivatives of the smoothed record at its mode, by those of the Gaussian. The mode lies a little
    # after the pulse's time zero; over that distance the curvature of an echo hardly changes.
    lag = np.arange(records.shape[1]) - np.nan_to_num(-ground / step)[:, None]
    gaussian = np.exp(-0.5 * (lag / width) ** 2) / (np.sqrt(2.0 * np.pi) * width)
    value = np.sum(records * gaussian, axis=1)
    curvature = -np.sum(records * gaussian * (lag**2 / width**4 - width**-2), axis=1)
    width = width[:, 0]
    is_peak = (curvature > 0) & (value > 0)
    safe_curvature = np.where(is_peak, curvature, np.nan)
    total = RECEIVER_SMOOTHING**2 + width**2
    by_noise = noise * np.sqrt(RECEIVER_SMOOTHING / (2.0 * total**1.5)) / safe_curvature
    # A Gaussian echo has the variance of value over curvature; that of the pulse follows from its moments.
    smoothed = width**2 + _pulse_variance(pulse)
    excess = np.sqrt(np.maximum(value / safe_curvature - smoothed, 0.0))
    stderr = step * np.sqrt(by_noise**2 + (_EXCESS_FRACTION * excess) ** 2)
    return np.where(np.isfinite(ground), np.hypot(stderr, _MODE_ERROR), np.nan)


def _pulse_variance(pulse: np.ndarray) -> np.ndarray:
    """Return the variance in samples squared of the Gaussian with the peak and the area of each pulse."""
    return (pulse.sum(axis=1) / (np.sqrt(2.0 * np.pi) * pulse.max(axis=1))) ** 2


def _sensitivity(records: np.ndarray, pulse: np.ndarray, noise_std: np.ndarray) -> np.ndarray:
    """Return the largest cover under which the ground's echo rises above the threshold of modes, (shots,)."""
    # An echo of unit energy that is smoothed has the peak 1 / (sqrt(2 pi) w).
    width = np.sqrt(_smoothing_width(pulse) ** 2 + _pulse_variance(pulse))
    weakest = gedi_settings(1).back_threshold * noise_std * np.sqrt(2.0 * np.pi) * width
    total = records.sum(axis=1)
    is_known = (total > 0) & (noise_std > 0)
    return np.where(is_known, 1.0 - weakest / np.where(total > 0, total, 1.0), np.nan)


def _rh_stderr(
    estimates: dict[str, np.ndarray],
    records: np.ndarray,
    step: np.ndarray,
    noise: np.ndarray,
    ground_stderr: np.ndarray,
) -> np.ndarray:
    """Return the standard errors of the relative heights in m, (shots, 101)."""
    rh, top = estimates["rh"], estimates["elev_highestreturn"]
    fraction = 0.01 * _RH_AXIS.values
    above = np.maximum(top - estimates["elev_lowestmode"], 0.0)[:, None] - rh
    below = rh - rh[:, :1]
    samples = (below * (1.0 - fraction) ** 2 + np.maximum(above, 0.0) * fraction**2) / step[:, None]
    energy = np.maximum(records.sum(axis=1), np.finfo(float).tiny)
    of_fraction = noise[:, None] * np.sqrt(_CORRELATION_SUM * np.maximum(samples, 0.0)) / energy[:, None]
    # dz/dF from the neighbouring percentiles. The ends of the signal are not quantiles: they move by where
    # the record crosses its threshold, within about the last percent.
    per_fraction = np.gradient(rh, 0.01, axis=1)
    return np.sqrt((of_fraction * per_fraction) ** 2 + ground_stderr[:, None] ** 2)


class _BatchRecords(NamedTuple):
    """Records of a batch of shots, padded: (shots, samples), and what belongs to each, (shots,).

    - `height`: m over the first sample. `records`: counts less the mean noise. `step`: m.
    - `pulse`: (shots, lags). `threshold_noise`: the product's, by which thresholds count. `record_noise`: of
      the smoothed samples.
    - `zenith`: of the beam in degrees.
    """

    height: np.ndarray
    records: np.ndarray
    step: np.ndarray
    pulse: np.ndarray
    threshold_noise: np.ndarray
    record_noise: np.ndarray
    zenith: np.ndarray


def _plants(
    batch: _BatchRecords,
    ground: np.ndarray,
    structure: _CanopyStructure,
    estimates: dict[str, np.ndarray],
) -> dict[str, np.ndarray]:
    """Return cover, plant area index and density of layers with their standard errors.

    1. Split the energy between the ends of the signal, and invert the gap probability P of layers.
    2. The ground's energy R_g is twice the energy below its mode, so that a ground that is higher by d has
       dR_g = 2 y d, with y the record per metre at the mode. It also has the relative error of the split.
       What the ground gains the canopy loses: dP = r (R_v + R_g) dR_g / T^2, with T = R_v + r R_g.
    3. Noise: with n_a the noise above the mode and n_l that below, dR_g = 2 n_l and dR_v = n_a - n_l, and
       dP = (R_v r dR_g - r R_g dR_v) / T^2.
    4. Layers have the noise of their samples, and move with the ground; the lowest one has the error of the
       split.
    """
    height, records, pulse, step = batch.height, batch.records, batch.pulse, batch.step
    ratio = structure.reflectance_ratio
    ends = signal_ends(height, records, noise=batch.threshold_noise, pulse=pulse)
    # NaN, of shots without ground, passes through: a missing ground gives a missing split.
    options: dict[str, Any] = {"pulse": pulse, "ground": ground, "ends": ends, "reflectance_ratio": ratio}
    split = ground_and_canopy(height, records, **options)
    ground_energy, canopy_energy = (np.asarray(x, float) for x in (split.ground, split.canopy))
    gap = np.clip(np.asarray(split.gap, float), _SMALLEST_GAP, 1.0)
    cosine = np.cos(np.deg2rad(batch.zenith))
    per_depth = cosine / (structure.projection * structure.clumping)
    total = np.maximum(canopy_energy + ratio * ground_energy, np.finfo(float).tiny)

    at_mode = _value_at(records, np.nan_to_num(-ground / step)) / step
    of_mode = 2.0 * np.abs(at_mode) * estimates["ground_stderr"]
    of_energy = np.hypot(of_mode, _SPLIT_ERROR * ground_energy)
    gap_of_ground = ratio * (canopy_energy + ground_energy) * of_energy / total**2
    top = (estimates["elev_highestreturn"] - estimates["ground"]) / step
    bottom = (estimates["ground"] - estimates["elev_lowestreturn"]) / step
    per_sample = batch.record_noise * np.sqrt(_CORRELATION_SUM)
    n_above, n_below = (per_sample * np.sqrt(np.maximum(samples, 1.0)) for samples in (top, bottom))
    by_below = (2.0 * ratio * canopy_energy + ratio * ground_energy) * n_below
    gap_of_noise = np.hypot(ratio * ground_energy * n_above, by_below) / total**2
    gap_stderr = np.hypot(gap_of_noise, gap_of_ground)

    # With the projection 1 and a vertical beam, the profile is that of the optical depth.
    profile = plant_area_profile(
        height, records, edges=structure.edges, smallest_gap=_SMALLEST_GAP, projection=1.0, **options
    )
    density = np.asarray(profile, float) * per_depth[:, None]
    thickness = np.diff(structure.edges)
    of_noise = per_sample[:, None] * np.sqrt(thickness / step[:, None]) / (gap * total)[:, None]
    of_noise = per_depth[:, None] * of_noise / thickness
    # Layers above the record hold no plants by definition: nothing was recorded that could be noise.
    of_noise = np.where(structure.edges[:-1] < -ground[:, None], of_noise, 0.0)
    middle = 0.5 * (structure.edges[:-1] + structure.edges[1:])
    slope = np.gradient(density, middle, axis=1) if middle.size > 1 else np.zeros_like(density)
    density_stderr = np.hypot(of_noise, slope * estimates["ground_stderr"][:, None])
    of_split = per_depth * gap_of_ground / gap / thickness[0]
    density_stderr[:, 0] = np.hypot(density_stderr[:, 0], of_split)
    return {
        "cover": cosine * (1.0 - gap),
        "cover_stderr": cosine * gap_stderr,
        "pai": -per_depth * np.log(gap),
        "pai_stderr": per_depth * gap_stderr / gap,
        "plant_area_density": density,
        "plant_area_density_stderr": density_stderr,
    }


def _value_at(records: np.ndarray, sample: np.ndarray) -> np.ndarray:
    """Interpolate each record at a sample, (shots,)."""
    first = np.clip(sample.astype(int), 0, records.shape[1] - 2)
    rows = np.arange(len(records))
    fraction = np.clip(sample - first, 0.0, 1.0)
    return (1.0 - fraction) * records[rows, first] + fraction * records[rows, first + 1]


# -- the table ---------------------------------------------------------------------------------------------

# Columns of one dimension that are estimated: unit and description.
_ESTIMATES = {
    "sensitivity": ("", "largest cover through which the ground is detected"),
    "ground": ("m", "elevation of the ground: the matched mode"),
    "ground_stderr": ("m", "standard error of the elevation of the ground"),
    "elev_lowestmode": ("m", "elevation of the lowest mode"),
    "elev_highestreturn": ("m", "elevation of the first return"),
    "elev_lowestreturn": ("m", "elevation of the last return"),
    "num_detectedmodes": ("", "number of modes"),
    "cover": ("", "fraction of the ground that plants cover"),
    "cover_stderr": ("", "standard error of the cover"),
    "pai": ("m2 m-2", "plant area index"),
    "pai_stderr": ("m2 m-2", "standard error of the plant area index"),
}
_OPTIONAL = {
    "delta_time": ("s", "time since the beginning of 2018"),
    "solar_elevation": ("degrees", "elevation of the sun"),
    "degrade": ("", "the product's flag of degraded pointing or positioning"),
    "stale_return": ("", "the product's flag of shots without a return detected on board"),
}


def _table(
    rows: list[Any],
    estimates: dict[str, np.ndarray],
    verdicts: list[Verdict],
    group: int,
    structure: _CanopyStructure,
) -> ShotTable:
    """Return the table of all columns."""

    def optional(name: str) -> np.ndarray:
        values = [getattr(row, name, None) for row in rows]
        return np.array([np.nan if value is None else float(value) for value in values], float)

    numbers = [int(getattr(row, "shot_number", i)) for i, row in enumerate(rows)]
    beams = [str(getattr(row, "beam", "")) for row in rows]
    columns = {
        "shot_number": Column(np.array(numbers, np.uint64), "", "unique number of the product"),
        "beam": Column(np.array(beams, str), "", "name of the beam's group"),
        "latitude": Column(optional("latitude"), "degrees", "of the last bin"),
        "longitude": Column(optional("longitude"), "degrees", "of the last bin"),
    }
    columns |= {name: Column(optional(name), *text) for name, text in _OPTIONAL.items()}
    columns["quality"], columns["reasons"] = _verdict_columns(verdicts)
    columns |= {name: Column(estimates[name], *text) for name, text in _ESTIMATES.items()}
    columns["rh"] = Column(estimates["rh"], "m", f"relative height of setting group {group}", _RH_AXIS)
    columns["rh_stderr"] = Column(estimates["rh_stderr"], "m", "standard error of rh", _RH_AXIS)
    for n in _GROUPS:
        mode, heights = f"elev_lowestmode_a{n}", f"rh_a{n}"
        columns[mode] = Column(estimates[mode], "m", f"elevation of the lowest mode, setting group {n}")
        columns[heights] = Column(estimates[heights], "m", f"relative height of setting group {n}", _RH_AXIS)
    edges = structure.edges
    layers = ColumnAxis("layer_height", 0.5 * (edges[:-1] + edges[1:]), "m")
    for name, text in (("", "plant area density"), ("_stderr", "standard error of the density")):
        name = f"plant_area_density{name}"
        columns[name] = Column(estimates[name], "m2 m-3", text, layers)
    attributes = {
        "title": "GEDI shots: ground, relative heights, cover and plant area in closed form",
        "layer_edges": ", ".join(f"{edge:g}" for edge in edges),
        "reflectance_ratio": f"{structure.reflectance_ratio:g}",
        "projection": f"{structure.projection:g}",
        "clumping": f"{structure.clumping:g}",
        "setting_group": f"{group}",
    }
    return ShotTable(columns, attributes)


def _fit_columns(
    rows: list[Any],
    estimates: dict[str, np.ndarray],
    verdicts: list[Verdict],
    path: str | os.PathLike[str] | None,
    progress: ProgressOption,
) -> tuple[dict[str, Column], dict[str, str]]:
    """Return the columns of fits, and the attributes that describe them.

    **Arguments:** `verdicts`: of the closed forms, which say why shots without a ground have none.
    """
    (with_ground,) = np.nonzero(np.isfinite(estimates["ground"]))
    fitted, verdicts_of_fits = fit_gedi_shots(
        [rows[i] for i in with_ground],
        estimates["ground"][with_ground],
        estimates["elev_lowestmode_a1"][with_ground],
        path=path,
        progress=progress,
    )
    fit_verdicts = list(verdicts)
    for i, verdict in zip(with_ground, verdicts_of_fits):
        fit_verdicts[i] = verdict
    layers = ColumnAxis("fit_layer", np.arange(1.0, LAYERS + 1.0))
    columns = {}
    for name, (unit, text) in (ESTIMATES | LAYER_ESTIMATES).items():
        values = np.full((len(rows), *fitted[name].shape[1:]), np.nan)
        values[with_ground] = fitted[name]
        axis = layers if name in LAYER_ESTIMATES else None
        columns[f"fit_{name}"] = Column(values, unit, f"fit: {text}", axis)
    for name, text in zip(("quality", "reasons"), _verdict_columns(fit_verdicts)):
        columns[f"fit_{name}"] = text._replace(description=f"fit: {text.description}")
    attributes = {
        "title": "GEDI shots: ground, relative heights, cover and plant area in closed form, and fits",
        "fit_layers": f"{LAYERS} from {CANOPY.clearance:g} m above fit_ground to fit_canopy_top",
        "fit_reflectance_ratio": f"{REFLECTANCE_RATIO:g}",
    }
    return columns, attributes


def _verdict_columns(verdicts: list[Verdict]) -> tuple[Column, Column]:
    """Return the columns of qualities and of reasons."""
    qualities = np.array([v.quality for v in verdicts], str)
    reasons = np.array(["; ".join(v.reasons) for v in verdicts], str)
    return Column(qualities, "", "good, doubtful or bad"), Column(reasons, "", "of the quality")
