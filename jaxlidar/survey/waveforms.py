"""The waveforms of all shots of a survey."""

import dataclasses
import os
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float, Int

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._fields.checks import check_index, check_kind, check_numbers, warn_user
from jaxlidar._fields.crs import common_system
from jaxlidar._not_kept import NotKept
from jaxlidar._registry import detect_returns, true_returns
from jaxlidar._text import NOTABLE_FRACTION, percent, samples_text
from jaxlidar.formats.checks import FileWarning
from jaxlidar.formats.las import LasWriter
from jaxlidar.formats.las_waveforms import write_las_waveforms
from jaxlidar.progress import ProgressOption, shows_progress
from jaxlidar.results import netcdf
from jaxlidar.results.case import Case
from jaxlidar.results.datasets import datasets_of, keep_as_netcdf
from jaxlidar.results.netcdf import WAVEFORM_QUANTITIES
from jaxlidar.sampling.adaptive import StopReason
from jaxlidar.sensors.lidar import Lidar
from jaxlidar.sensors.survey import Survey, beam_directions
from jaxlidar.spectral.summary import neglected_fractions
from jaxlidar.spectral.truth_class import Truth
from jaxlidar.spectral.waveform import Waveform
from jaxlidar.survey.acquisition import Acquisition, acquisition_of
from jaxlidar.survey.results import OPTIONAL_ARRAYS
from jaxlidar.survey.returns import (
    MAX_LAS_RETURNS,
    DetectorFunction,
    DiscreteReturns,
    airborne_shots,
    input_of_waveforms,
    returns_of,
    strongest_returns,
    true_returns_of,
    warn_of_expected_returns,
    wavelength_index,
)

# Least cosine of a beam axis to the vertical for which a height states a point of it.
_LEAST_COSINE = 1e-12


@final
class Waveforms(eqx.Module):
    """The waveforms of all shots of a survey, on one time axis. `waves[i]` is the `Waveform` of shot i.

    `simulate_many(keep=...)` may leave out arrays. Their use raises a ValueError, and so does `waves[i]`,
    which needs all of them.

    - `time`: (samples,) ns, centres of the samples, relative to the two-way travel time of each shot's aim
      point; of shots that are placed by their sensors, relative to their emission.
    - `wavelength`: (wavelengths,) nm.
    - `reflectance`, `stderr`, `energy`, `recorded`: (shots, wavelengths, samples), and
    - `components`, dict of the same shape: as those of `Waveform`.
    - `neglected`, `lost`: (shots, wavelengths), `energy_budget`, `energy_budget_stderr`, dicts of the same
      shape: as those of `Waveform`. `neglected` is zero where one order is followed.
    - `position`: (shots, 2) m, or (shots, 3) of sensors, `zenith`, `azimuth`: (shots,) degrees, as those of
      `Survey`, or as it states them (`Survey.disturbed`).
    - `ground_height`: (shots,) m, true height of the ground where the beam axis meets it; NaN where it meets
      none.
    - `off_map`: (shots,) fraction of the light that falls outside the voxel map.
    - `error`: (shots,) relative error, as `simulate` defines it. `photons`: (shots,) number traced.
    - `truth`: a `Truth` with an axis of shots, what each beam meets in the scene; None unless asked for.
    - `acquisition`: an `Acquisition`, what else discrete returns need; None for files of earlier versions.
    - `info`: dict of "rtol", "orders" followed, "automatic orders" (False where `max_orders` was given),
      "narrow beams" (True where all are narrower than a voxel), "altitude" of the lidar in m (None for
      sensors), "crs" of the survey and its scene (None if unknown), "missed" (number of shots that miss the
      scene, where `beyond="miss"` left any empty), "disturbed" (True for
      `Survey.disturbed`), "seconds" that it took, and whether light was "shared" (over `SceneParts`: in all
      tiles). Over one scene with shared light, also the spacing in m of the "grid" of nodes at which it
      entered, and a bound on the fraction of samples that "parallel light" changes. Over `SceneParts`, also
      the number of "parts", the "margin" in m around tiles, and the "margin of all light", which loses none.

    **Example:**

    >>> import jax, jaxlidar as jl
    >>> survey = jl.Survey.grid(jl.Lidar(), low=(0, 0), high=(20, 10), spacing=10.0)
    >>> scene = jl.Scene(ground=jl.Ground(reflectance=0.4, slope=10.0, aspect=90.0))
    >>> many = jl.simulate_many(survey, scene, key=jax.random.key(0))
    >>> print(many.reflectance.shape[:2], many.ground_height.round(2).tolist())
    (6, 1) [0.0, -1.76, -3.53, 0.0, -1.76, -3.53]
    >>> print(f"{float(many[2].reflectance.sum()):.3f}")
    0.394
    >>> print(str(many).splitlines()[1])
      1064 nm: apparent reflectance 0.394 to 0.394, median 0.394
    """

    time: Float[np.ndarray, " samples"]
    wavelength: Float[np.ndarray, " wavelengths"]
    reflectance: Float[np.ndarray, "shots wavelengths samples"]
    stderr: Float[np.ndarray, "shots wavelengths samples"]
    energy: Float[np.ndarray, "shots wavelengths samples"]
    recorded: Float[np.ndarray, "shots wavelengths samples"]
    components: dict[str, Float[np.ndarray, "shots wavelengths samples"]]
    neglected: Float[np.ndarray, "shots wavelengths"]
    lost: Float[np.ndarray, "shots wavelengths"]
    energy_budget: dict[str, Float[np.ndarray, "shots wavelengths"]]
    energy_budget_stderr: dict[str, Float[np.ndarray, "shots wavelengths"]]
    position: Float[np.ndarray, "shots axes"]
    zenith: Float[np.ndarray, " shots"]
    azimuth: Float[np.ndarray, " shots"]
    ground_height: Float[np.ndarray, " shots"]
    off_map: Float[np.ndarray, " shots"]
    error: Float[np.ndarray, " shots"]
    photons: Int[np.ndarray, " shots"]
    info: dict[str, Any] = eqx.field(static=True)
    truth: Truth | None = None
    acquisition: Acquisition | None = None

    @property
    def first_order_share(self) -> Float[np.ndarray, "shots wavelengths"]:
        """Fraction of `reflectance` scattered once, (shots, wavelengths); 1 where nothing returns."""
        first, total = (np.sum(a, axis=2) for a in (self.components["first"], self.reflectance))
        return np.where(total > 0, first / np.where(total > 0, total, 1.0), 1.0).astype(total.dtype)

    @property
    def has_sensor_position(self) -> bool:
        """True if shots are placed by their sensors, and time zero is the emission."""
        return self.position.shape[1] == 3

    @property
    def direction(self) -> Float[np.ndarray, "shots 3"]:
        """Unit vectors (shots, 3) in which the beams travel, as `Survey.direction`."""
        return beam_directions(self.zenith, self.azimuth)

    @property
    def crs(self) -> str | None:
        """Coordinate reference system of the survey and its scene, such as "EPSG:32633"; None if unknown."""
        return self.info.get("crs")

    @property
    def ground_position(self) -> Float[np.ndarray, "shots 3"]:
        """Positions (shots, 3), m, where the beam axes meet the ground; NaN where they meet none.

        They follow from `ground_height` and the axes. An exactly level axis has no single point at that
        height, and is NaN, too. Of a survey that is disturbed, they are the points of the stated axes at the
        heights that the true ones meet.
        """
        direction, height = self.direction, np.asarray(self.ground_height, float)
        start = np.asarray(self.position, float)
        start = start if self.has_sensor_position else np.pad(start, ((0, 0), (0, 1)))
        is_inclined = np.abs(direction[:, 2]) > _LEAST_COSINE
        # A vertical axis meets all heights at its own place.
        distance = (height - start[:, 2]) / np.where(is_inclined, direction[:, 2], np.nan)
        points = start + distance[:, None] * direction
        return np.where(np.isnan(points[:, 2:]), np.nan, np.column_stack([points[:, :2], height]))

    def height_of_shot(self, shot: int) -> Float[np.ndarray, " samples"]:
        """Heights (samples,), m, from which light of order one arrives in the samples of a shot."""
        # The survey has one time axis and shots of many zenith angles: heights differ between shots.
        distance = 0.5 * SPEED_OF_LIGHT * self.time
        if self.has_sensor_position and self.acquisition is not None:
            distance = distance + self.acquisition.range_at_time_zero[shot]
        height = -distance * np.cos(np.deg2rad(self.zenith[shot]))
        return height + self.position[shot, 2] if self.has_sensor_position else height

    def __len__(self) -> int:
        return len(self.position)

    def __str__(self) -> str:
        lines = [f"{len(self)} waveforms of {samples_text(self.time)}"]
        if not isinstance(self.reflectance, NotKept):
            for w, sums in zip(self.wavelength, self.reflectance.sum(axis=2).T):
                low, middle, high = np.quantile(sums, (0.0, 0.5, 1.0))
                lines.append(f"  {w:g} nm: apparent reflectance {low:.3g} to {high:.3g}, median {middle:.3g}")
        if not_kept := [name for name in OPTIONAL_ARRAYS if isinstance(getattr(self, name), NotKept)]:
            lines.append(f"  not kept (keep=): {', '.join(not_kept)}")
        if missed := self.info.get("missed"):
            lines.append(f"  {missed} miss the scene, and are empty")
        if (n_off_map := int(np.sum(self.off_map >= NOTABLE_FRACTION))) > 0:
            lines.append(f"  {n_off_map} lie partly outside the voxel map")
        light = "which share light, " if self.info.get("shared") else ""
        lines.append(
            f"  {light}{self.info.get('seconds', 0.0):.2g} s, relative errors up to {self.error.max():.2g}"
        )
        return "\n".join(lines)

    def __iter__(self):
        return (self[i] for i in range(len(self)))

    def __getitem__(self, shot: int) -> Waveform:
        i = check_index("shot", shot, len(self))

        def row(name: str) -> Any:
            rows = getattr(self, name)
            if isinstance(rows, dict):
                return {item: jnp.asarray(a[i]) for item, a in rows.items()}
            return jnp.asarray(rows[i])

        wave = Waveform(
            time=jnp.asarray(self.time),
            height=jnp.asarray(self.height_of_shot(i), self.time.dtype),
            wavelength=jnp.asarray(self.wavelength),
            **{name: row(name) for name in (*OPTIONAL_ARRAYS, "neglected", "lost")},
            info={"photons": int(self.photons[i]), "error": float(self.error[i])},
            truth=None if self.truth is None else self.truth[i],
        )
        # Files of earlier versions do not have the altitude.
        altitude = {name: self.info[name] for name in ("altitude",) if name in self.info}
        info = {**wave.info, "stopped": self._stopped(i, neglected_fractions(wave)[0]), **altitude}
        return dataclasses.replace(wave, info=info)

    def _stopped(self, i: int, unfollowed: float) -> str:
        """Return the reason why tracing of shot i ended, as `Waveform.info` has it.

        `unfollowed`: fraction of its light that orders beyond the last may add.
        """
        if self.info.get("missed") and np.isnan(self.ground_height[i]):
            return "misses the scene"
        # Standard errors are zero where nothing is random, and no photons are traced.
        if self.photons[i] == 0 and not np.any(self.stderr[i]):
            return StopReason.NOTHING_RANDOM.value
        if self.error[i] > self.info["rtol"]:
            return StopReason.BATCHES_SPENT.value
        # Orders that the user chose are what was asked for. Files of earlier versions do not say who chose.
        automatic = self.info.get("automatic orders", True)
        if automatic and self.info["orders"] > 1 and unfollowed > self.info["rtol"]:
            return f"orders beyond {self.info['orders']} may add {percent(unfollowed)}"
        return StopReason.TOLERANCE_MET.value

    @shows_progress
    def returns(
        self,
        detector: str | DetectorFunction = "peak",
        *,
        wavelength: ArrayLike | None = None,
        record: Float[ArrayLike, "shots wavelengths samples"] | None = None,
        background: ArrayLike | None = None,
        noise: ArrayLike | None = None,
        threshold: ArrayLike | None = None,
        fraction: ArrayLike = 0.5,
        max_returns: int | None = None,
        progress: ProgressOption = None,
    ) -> DiscreteReturns:
        """Detect the discrete returns of all shots, as a laser scanner reports them.

        `jaxlidar.survey.returns` states the detectors. Those with a name are calibrated by the pulse: a
        smooth one leaves a flat target across the beam an error of range of at most some per cent of a
        sample.

        Over voxels, waveforms are those of the expected light of leaves, so that nearly every shot has a
        return from every crown: counts of returns, and of shots without one, are those of a scanner over
        leaves that are hit or missed, which `leaf_mesh` makes. Positions and energies hold for both.

        **Arguments:**

        - `detector`: "peak", "constant fraction" or "leading edge"; or "decomposition" into echoes of the
          pulse's shape, which takes some milliseconds per shot; or a function of one
          record's times in ns, samples in J without background, and their noise, NumPy arrays of
          (samples,). It gives the times of the returns in ns, (returns,), a sample or more apart. NaN
          stands for no return, so that compiled functions can give as many times for every record. Times
          about which no sample is above zero are left out. Default "peak".
        - `wavelength`: nm, of the channel that detects, one of `wavelength`. Default None: the first.
        - `record`: (shots, wavelengths, samples) J, one that `jaxlidar.record` gave, with its noise.
          Default None: `recorded`.
        - `background`: J per sample to subtract, not negative, one number or (shots,). Default None: what
          the receiver adds to `energy`; with a `record`, the median of each shot's samples that belong to
          no echo.
        - `noise`: standard deviation of the record in J per sample, one number, (shots,) or (shots,
          samples). Default None: the standard error `stderr`; with a `record`, that of the differences of
          neighbouring samples, or that of the lidar's receiver without signal if that is larger.
        - `threshold`: lowest amplitude of a return, and lowest rise of one above the dip before it, in J
          per sample, positive, one number or (shots,). Default None: the larger of five times the noise,
          and 1 % of the shot's largest sample. A function applies its own: None alone is admissible.
        - `fraction`: level of "constant fraction" on the leading edge, over the amplitude, in (0, 1).
          Default 0.5.
        - `max_returns`: the strongest returns of a shot that has more. Default None: all.
        - `progress`: True for a bar; or a function called with a `Progress` after every few thousand shots.
          Default None: silent.

        **Returns:** a `DiscreteReturns`.

        **Warns:** UserWarning for a `record` whose receiver cuts noise at zero, as one without `background`
        does: its noise is estimated from the samples above zero; and for shots by beams narrower than a voxel
        that see leaf or bark of voxels and nothing else: their counts are of expected light.

        **Raises:** ValueError for arguments outside their ranges or of other shapes, for waveforms of a
        file of an earlier version, and for times that a function gives outside of the record or in another
          shape; TypeError for a detector that is neither a name nor a function.

        **Example:**

        >>> import jax, jaxlidar as jl
        >>> scene = jl.Scene(plates=[jl.Plate(6.0, 0.4, coverage=0.5)], ground=jl.Ground(reflectance=0.3))
        >>> survey = jl.Survey(jl.Lidar(altitude=500.0), position=[(0, 0)], zenith=[20.0])
        >>> returns = jl.simulate_many(survey, scene, key=jax.random.key(0)).returns()
        >>> print(returns.material.tolist(), returns.position[:, 2].round(2), returns.range.round(2))
        ['plate', 'ground'] [6. 0.] [525.7  532.09]
        """
        waves = input_of_waveforms(self, wavelength)
        # Files of earlier versions do not say how wide beams are.
        if self.info.get("narrow beams", False):
            warn_of_expected_returns(waves)
        if record is not None:
            record = _at_wavelength(record, self.wavelength, wavelength)
        return returns_of(
            waves,
            detector,
            record=record,
            background=background,
            noise=noise,
            threshold=threshold,
            fraction=fraction,
            max_returns=max_returns,
            progress=progress,
        )

    def true_returns(
        self, *, wavelength: ArrayLike | None = None, min_reflectance: ArrayLike = 1e-4
    ) -> DiscreteReturns:
        """List the true echoes of all shots, to judge what a detector reports.

        An echo is a stretch of samples with first-order returns of one material, without a gap: the ground,
        a plate, a layer of leaves. Its time is the mean of these returns, resolved to a part of a sample;
        for the ground, and a single plate, it is that of their mean height in the footprint. Its width is
        2.35 times the standard deviation of the returns, without the pulse; its amplitude is the energy of
        all of them.

        **Arguments:**

        - `wavelength`: nm, as that of `returns`. Default None: the first.
        - `min_reflectance`: lowest apparent reflectance of an echo, not negative. Default 1e-4.

        **Returns:** a `DiscreteReturns`.

        **Raises:** ValueError for waveforms without truth (`simulate_many(truth=True)` gives it), and as
        `returns`.

        **Example:**

        >>> import jax, jaxlidar as jl
        >>> scene = jl.Scene(plates=[jl.Plate(6.0, 0.4, coverage=0.5)], ground=jl.Ground(reflectance=0.3))
        >>> survey = jl.Survey(jl.Lidar(altitude=500.0), position=[(0, 0)], zenith=[20.0])
        >>> many = jl.simulate_many(survey, scene, key=jax.random.key(0), truth=True)
        >>> print(many.true_returns().material.tolist(), many.true_returns().reflectance.round(3))
        ['plate', 'ground'] [0.188 0.07 ]
        """
        return true_returns_of(input_of_waveforms(self, wavelength), min_reflectance=min_reflectance)

    def to_las(
        self,
        path: str | os.PathLike[str] | LasWriter,
        *,
        crs: str | None = None,
        extra: bool = True,
        detector: str | DetectorFunction = "peak",
        **options: Any,
    ) -> DiscreteReturns:
        """Write the discrete returns of all shots as a LAS or LAZ file, version 1.4.

        **Arguments:**

        - `path`, `crs`, `extra`: those of `DiscreteReturns.to_las`.
        - `detector`, `options`: those of `returns`; `max_returns` is 15 by default, as many as the format
          holds.

        **Returns:** the `DiscreteReturns` that were written.

        **Warns:** `FileWarning` where shots have more returns than the format holds, and `max_returns` is not
        given.

        **Raises:** as `returns` and `DiscreteReturns.to_las`.

        **Example:**

        >>> import pathlib, tempfile
        >>> import jax, jaxlidar as jl
        >>> survey = jl.Survey.grid(jl.Lidar(), low=(0, 0), high=(10, 0), spacing=10.0)
        >>> many = jl.simulate_many(survey, jl.Scene(ground=jl.Ground(2.5)), key=jax.random.key(0))
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "strip.las"
        >>> print(many.to_las(path, detector="leading edge"))
        2 returns of 2 shots: 2 ground
        """
        returns = self._returns_for_las(detector, options)
        returns.to_las(path, crs=crs, extra=extra)
        return returns

    def _returns_for_las(self, detector: str | DetectorFunction, options: dict[str, Any]) -> DiscreteReturns:
        """Detect returns, no more of a shot than the format holds; warn where there are."""
        returns = self.returns(detector, **options)
        if "max_returns" in options or len(returns) == 0 or returns.n_returns.max() <= MAX_LAS_RETURNS:
            return returns
        written = strongest_returns(returns, MAX_LAS_RETURNS)
        shots = len(np.unique(returns.shot[returns.n_returns > MAX_LAS_RETURNS]))
        warn_user(
            f"{len(returns) - len(written)} of {len(returns)} returns are not written, the weakest of "
            f"{shots} shots: LAS holds {MAX_LAS_RETURNS} of each; max_returns={MAX_LAS_RETURNS} asks for "
            "these",
            FileWarning,
        )
        return written

    def to_las_waveforms(
        self,
        path: str | os.PathLike[str],
        *,
        crs: str | None = None,
        detector: str | DetectorFunction = "peak",
        point_format: int = 9,
        **options: Any,
    ) -> DiscreteReturns:
        """Write waveforms and discrete returns as LAS 1.4 with waveform packets, in a .wdp file.

        A packet has all samples of a shot's record (`recorded`, or a `record` in `options`) in 65,535 steps
        from zero, or the lowest sample of the survey if that is negative, to the largest; its gain and offset
        turn them into J. `jaxlidar.io.read_las_waveforms` reads them. A shot without a return gets a
        synthetic point, as `jaxlidar.io.write_las_waveforms` states.

        **Arguments:** `point_format`: 4, 5, 9 or 10. Default 9. The others are those of `to_las`; `path`
        ends in ".las"; missing folders are created.

        **Returns:** the `DiscreteReturns` that were written.

        **Warns:** as `to_las`.

        **Raises:** as `returns` and `jaxlidar.io.write_las_waveforms`; ValueError for records without light.

        **Example:**

        >>> import pathlib, tempfile
        >>> import jax, jaxlidar as jl
        >>> survey = jl.Survey.grid(jl.Lidar(), low=(0, 0), high=(10, 0), spacing=10.0)
        >>> many = jl.simulate_many(survey, jl.Scene(ground=jl.Ground(2.5)), key=jax.random.key(0))
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "strip.las"
        >>> returns = many.to_las_waveforms(path)
        >>> shots = jl.io.read_las_waveforms(path)
        >>> print(f"{len(shots)} shots, {shots[0].elevation[shots[0].signal.argmax()]:.1f} m")
        2 shots, 2.5 m
        """
        wavelength, record = options.get("wavelength"), options.get("record")
        crs = common_system({"the simulation": self.crs, "crs": crs})
        returns = self._returns_for_las(detector, options)
        waves = input_of_waveforms(self, wavelength)
        records = waves.recorded if record is None else _at_wavelength(record, self.wavelength, wavelength)
        write_las_waveforms(path, airborne_shots(waves, records, returns, crs), point_format=point_format)
        return returns

    def to_xarray(self) -> Any:
        """The waveforms as an `xarray.Dataset` over shots, wavelengths and times, with units.

        **Returns:** an `xarray.Dataset` of the fields, and of those of `truth`. The coordinates of its shots
        are `zenith`, `azimuth`, and of `acquisition` `gps_time`, `scan_angle`, `flight_line` and
        `range_at_time_zero`.

        **Raises:** ImportError where xarray is not installed.

        **Example:**

        >>> import jax, jaxlidar as jl
        >>> line = {"start": (0, 0), "end": (0, 10), "speed": 50.0, "pulse_rate": 10.0}
        >>> survey = jl.Survey.scan(jl.Lidar(), jl.Oscillating(20.0, 1.0), **line, flight_line=7)
        >>> many = jl.simulate_many(survey, jl.Scene(ground=jl.Ground()), key=jax.random.key(0))
        >>> dataset = many.to_xarray()
        >>> print(dataset.flight_line.values, dataset.scan_angle.values.round(1))
        [7 7 7] [ 0.  11.8 19. ]
        """
        datasets = datasets_of(self)
        dataset = datasets["/"]
        if self.acquisition is not None:
            variables = datasets["/acquisition"].data_vars.items()
            dataset = dataset.assign_coords({name: a for name, a in variables if a.dims == ("shot",)})
        if self.truth is None:
            return dataset
        # Its samples are those of the waveforms; heights follow from their times.
        truth = datasets["/truth"].drop_vars(["time", "height"]).rename(sample="time")
        return dataset.merge(truth)

    def save(self, path: str | os.PathLike[str], case: Case | None = None) -> None:
        """Write the waveforms as netCDF or Zarr, which `Waveforms.open` and `jaxlidar.open` read.

        **Arguments:**

        - `path`: the file to write, or the folder of a Zarr store (".zarr"). It appears when it is complete.
          Missing folders are created.
        - `case`: the `jaxlidar.io.Case` of the survey that was simulated, so that `jaxlidar.rerun` can do it
          again. Default None: not kept.

        **Raises:** what `jaxlidar.io.save` raises.
        """
        netcdf.save(self, path, case)

    @staticmethod
    def open(path: str | os.PathLike[str]) -> "Waveforms":
        """The waveforms of a file that `save`, or of a store that `simulate_many` wrote, with the same bits.

        Arrays of a Zarr store beyond 64 MB are read where they are used.

        **Arguments:** `path`: the file.

        **Returns:** a `Waveforms`.

        **Raises:** what `jaxlidar.open` raises; ValueError, naming the file, for one of another kind.
        """
        result = netcdf.open(path)
        if not isinstance(result, Waveforms):
            raise ValueError(f"{path}: it holds a {type(result).__name__}, not Waveforms")
        return result


keep_as_netcdf(
    Waveforms,
    "simulated lidar waveforms of a survey",
    {
        **{name: quantity for name, quantity in WAVEFORM_QUANTITIES.items() if name != "height"},
        "time": ("ns", "time of arrival relative to the two-way travel time of the aim point"),
        "position": ("m", "x and y where the beam axis meets the reference plane, or x, y, z of the sensor"),
        "zenith": ("degree", "angle between the beam and the vertical"),
        "azimuth": ("degree", "direction in which the beam travels, clockwise from north"),
        "ground_height": ("m", "height of the ground where the beam axis meets it"),
        "off_map": ("1", "fraction of the light that falls outside the voxel map"),
        "error": ("1", "relative error of the waveform"),
        "photons": ("1", "photons traced"),
    },
    dimensions={"shots": "shot", "samples": "time", "wavelengths": "wavelength", "axes": "axis"},
    items={"components": "component", "energy_budget": "fate", "energy_budget_stderr": "fate"},
    coordinates={"zenith": "shot", "azimuth": "shot"},
    rows="shots",
)


@detect_returns.register
def _returns_of_waveform(
    wave: Waveform, lidar: Lidar, detector: str | DetectorFunction, *, record: Any = None, **options: Any
) -> DiscreteReturns:
    """Detect the returns of one waveform; see `Waveform.returns`."""
    waves = _waveforms_of_one(wave, lidar)
    if record is not None:
        check_numbers("record", record)
        record = np.asarray(record)[None]
    return waves.returns(detector, record=record, **options)


@true_returns.register
def _true_returns_of_waveform(wave: Waveform, lidar: Lidar, **options: Any) -> DiscreteReturns:
    """List the true echoes of one waveform; see `Waveform.true_returns`."""
    return _waveforms_of_one(wave, lidar).true_returns(**options)


def _waveforms_of_one(wave: Waveform, lidar: Lidar) -> Waveforms:
    """Return a waveform and its lidar as the survey of one shot. **Raises:** as `Waveform.returns`."""
    check_kind("lidar", lidar, Lidar, "the Lidar of the waveform")
    if wave.has_scenes:
        raise ValueError(f"the waveform has {len(wave)} scenes; admissible is that of one, as in wave[0]")
    if not np.array_equal(np.asarray(lidar.wavelength), np.asarray(wave.wavelength)):
        raise ValueError(
            f"lidar has {np.asarray(lidar.wavelength).tolist()} nm, the waveform "
            f"{np.asarray(wave.wavelength).tolist()} nm"
        )
    # Waveforms of earlier versions, and of JAX transformations, do not say where they were recorded.
    if "altitude" in wave.info and (wave.info["altitude"] is None) != lidar.has_sensor_position:
        kinds = ("its altitude", "its sensor")
        raise ValueError(
            f"lidar is placed by {kinds[lidar.has_sensor_position]}, that of the waveform by "
            f"{kinds[not lidar.has_sensor_position]}; admissible is the lidar that was simulated"
        )
    shot, zero = Survey.of(lidar), np.zeros(1)
    arrays: dict[str, Any] = {
        name: getattr(wave, name) for name in (*OPTIONAL_ARRAYS, "neglected", "lost", "truth")
    }
    arrays = jax.tree.map(lambda a: np.asarray(a)[None], arrays)
    # The truth has the mean height of the ground over the footprint.
    heights = {} if wave.truth is None else arrays["truth"].surface_height
    return Waveforms(
        time=np.asarray(wave.time),
        wavelength=np.asarray(wave.wavelength),
        **arrays,
        position=shot.position,
        zenith=shot.zenith,
        azimuth=shot.azimuth,
        ground_height=heights.get("ground", np.full(1, np.nan)),
        off_map=zero,
        error=zero,
        photons=np.zeros(1, int),
        info={},
        acquisition=acquisition_of(shot),
    )


def _at_wavelength(record: Any, wavelengths: Any, wavelength: Any) -> np.ndarray:
    """Return the samples (shots, samples) at one wavelength of a record. **Raises:** ValueError."""
    check_numbers("record", record)
    record, count = np.asarray(record), len(wavelengths)
    if record.ndim != 3 or record.shape[1] != count:
        raise ValueError(
            f"record has shape {record.shape[-3:]}; admissible is (shots, {count}, samples), that of "
            "jaxlidar.record"
        )
    return record[:, wavelength_index(wavelength, np.asarray(wavelengths, float))]
