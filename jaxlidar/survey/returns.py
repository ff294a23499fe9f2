r"""Discrete returns of waveforms: detection of echoes, and their positions, strengths and materials.

With the sample times t_j and a record y(t) in J per sample, less its background:

- **peak**: a return is a local maximum of y that reaches the threshold and exceeds, by the threshold, the
  lowest sample between it and any higher neighbour (its prominence). Its time and amplitude are those of
  the apex of the parabola through ln y at three samples, which is exact for a Gaussian.
- **constant fraction**: a return is such a maximum before which the record falls below a fraction f of it.
  Its time is that at which the leading edge crosses f times the amplitude.
- **leading edge**: a return begins when the record rises through the threshold, and ends when it falls
  below half of that. Its time is that of the crossing.
- **decomposition**: the record is fitted by copies of the pulse, which may be broadened
  (`jaxlidar.survey.decomposition`).
- **a function of one's own** gives the times of the returns of each record. Amplitude, width and extent of a
  return are those about the largest sample among those that are nearer to its time than to another return's,
  and no farther from it than the pulse is long.

**Calibration.** A detector by name reads another time than the pulse's time zero: the time of its peak, or of
a level on its leading edge, interpolated between samples. What it reads of the pulse itself, scaled to the
amplitude of the return and sampled at the same phase, is subtracted. Phases are tabulated in eighths of a
sample, which leaves a flat target perpendicular to the beam an error of range of at most some per cent of a
sample, where the pulse is smooth, and of less than half a sample at the peak of a pulse of constant power.
What overlapping or broadened echoes add is the detector's error, as in instruments. An echo that the window
of the record cuts is placed at the end of the record.

**Noise.** Of a noisy record it is the larger of what its receiver adds without signal, if the survey's lidar
has it, and of what differences of neighbouring samples tell. A receiver without a pedestal (`background`)
cuts noise at zero, and such differences tell too little: then it is that of the samples beside zeros, which
are the positive half of a normal distribution, and a warning says so.

**Threshold.** If none is given, it is the larger of five standard deviations of the noise at the sample,
and 1 % of the largest sample of the shot.

**Extent.** A return owns the samples around its maximum down to the dip between it and the next return, or
until the record falls to the larger of one standard deviation of the noise and 0.1 % of the shot's largest
sample. Apparent reflectance, material and ground share are sums over them.

Source: Wagner et al. (2004), Int. Arch. Photogramm. Remote Sens. 35, part B3, 201 (detectors); ASPRS
(2019), LAS specification 1.4 (return numbers and classes).
"""

import dataclasses
import os
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple, TypeAlias, final

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int, Num, Shaped

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._fields.checks import (
    as_numpy,
    check_choice,
    check_flag,
    check_integer,
    check_kind,
    check_number,
    check_numbers,
    check_range,
    warn_user,
)
from jaxlidar._fields.crs import common_system
from jaxlidar._not_kept import NotKept
from jaxlidar.formats.airborne import AirborneShot, Returns, Segment
from jaxlidar.formats.las import LasWriter, write_las
from jaxlidar.planning.channels import unnumbered
from jaxlidar.progress import Progress, ProgressOption
from jaxlidar.scenes.scene import Scene
from jaxlidar.sensors.survey import Survey, beam_directions
from jaxlidar.survey.acquisition import PULSE_OVERSAMPLING, Acquisition
from jaxlidar.survey.labels import labels_of

DETECTORS = ("peak", "constant fraction", "leading edge", "decomposition")
# A function of the times, samples and noise of one record, (samples,) each, which gives times of returns.
DetectorFunction: TypeAlias = Callable[[np.ndarray, np.ndarray, np.ndarray], Any]
# Largest number of returns of a pulse that LAS 1.4 holds.
MAX_LAS_RETURNS = 15
# Threshold in standard deviations of the noise, and over the largest sample of the shot.
_NOISE_FACTOR, _RELATIVE_THRESHOLD = 5.0, 0.01
# The samples of a return lie above one standard deviation of the noise and this fraction of the largest
# sample.
_RELATIVE_FLOOR = 1e-3
# A leading edge discriminator is armed again when the record has fallen below this fraction of the threshold.
_HYSTERESIS = 0.5
# Samples below this fraction of the level that is crossed are raised to it before logarithms are taken.
_LOGARITHM_FLOOR = 0.01
# Background of noisy records: samples above the median by this many standard deviations are echoes; the
# fraction of a normal distribution one standard deviation or more below its median; most rounds.
_CLIPPING, _ONE_SIGMA_BELOW, _MAX_CLIPPINGS = 3.0, 0.15866, 20
# Median of the size of a normal number of unit variance. Noise is cut at zero where more than this fraction
# of neighbours are a zero and another sample.
_NORMAL_MEDIAN, _CUT_FRACTION = 0.6745, 0.1
# Relative differences of the samples of a plateau: rounding, and the range, by which energy falls.
_PLATEAU_DIFFERENCE = 1e-4
# Rounding, in samples, of the times that a function gives in single precision.
_ROUNDING_OF_TIMES = 1e-3
# Samples that are worked on at once: arrays of less than a megabyte stay in a processor's cache.
_SAMPLES_AT_ONCE = 100_000
# Records that are decomposed together, by one compiled program; fewer are filled up with empty ones.
_RECORDS_AT_ONCE = 64
# Least cosine of an axis to the vertical for which the height of a surface gives its range.
_LEAST_SLOPE = 0.01
_FWHM_OF_STD = 2.0 * np.sqrt(2.0 * np.log(2.0))
# Materials of samples in which nothing returned, and heights (m above ground) that divide vegetation into the
# classes 3, 4 and 5 of the LAS specification.
_NO_MATERIAL = "noise"
_VEGETATION_LIMITS = (0.5, 2.0)
_GROUND_CLASS, _UNCLASSIFIED, _LOW_VEGETATION, _LOW_NOISE, _HIGH_NOISE = 2, 1, 3, 7, 18
# Intensity, of 16 bits, of an apparent reflectance of one.
_FULL_INTENSITY = 65535
_ORDERS = ("first", "higher")
# Materials of plants: of voxels, and of the triangles of `leaf_mesh` and `mesh_of`.
_PLANTS = ("leaf", "bark", "mesh:leaf", "mesh:wood")
# Returns of surfaces of which no ray meets the surface: a larger part than this one is warned of.
_LARGEST_MISS = 0.1
# Materials of the parts of `DiscreteReturns.part`, by its numbers.
_PARTS = (("air", _NO_MATERIAL), ("ground",), ("leaf", "mesh:leaf"), ("bark", "mesh:wood"))


@final
class DiscreteReturns(eqx.Module):
    """Discrete returns of the shots of a survey, by shot and range. `len(returns)` is their number.

    - `shot`: (returns,) number of the shot, from 0.
    - `time`: (returns,) ns on the shot's time axis. `range`: (returns,) m from the sensor.
    - `position`: (returns, 3) m, on the axis of the beam, in double precision.
    - `amplitude`: (returns,) J per sample, largest value of the echo; of a truth, J in all.
    - `width`: (returns,) ns, full width at half maximum.
    - `reflectance`: (returns,) apparent reflectance, the sum over the samples of the return.
    - `number`, `n_returns`: (returns,) number of the return in its shot, from 1, and how many the shot has.
    - `material`: (returns,) material that most of the return's light was last scattered by: "ground", "leaf",
      "bark", "plate", "air"; "noise" where nothing returned. `ground_share`: (returns,) fraction that was
      scattered last by the ground.
    - `ground_height`: (returns,) m, of the ground below, where the beam's axis meets it; NaN where there is
      none.
    - `gps_time`: (returns,) s, NaN if unknown; `scan_angle`: (returns,) degrees; `flight_line`: (returns,).
    - `crs`: coordinate reference system of the survey and its scene; None if unknown.
    - `instance`: (returns,) number of the tree or copy that was hit, 0 for none; `normal`: (returns, 3) unit
      vectors of the surface that was hit, on the side of the sensor; `incidence`: (returns,) degrees between
      the beam and that normal; NaN for none. None unless `labelled` has found them.

    Material and ground share are from the simulation; instruments do not record them.

    **Example:**

    >>> import jax, jaxlidar as jl
    >>> plate = jl.Plate(height=6.0, reflectance=0.4, coverage=0.5)
    >>> scene = jl.Scene(plates=[plate], ground=jl.Ground(reflectance=0.3))
    >>> survey = jl.Survey.grid(jl.Lidar(), low=(0, 0), high=(10, 0), spacing=10.0)
    >>> returns = jl.simulate_many(survey, scene, key=jax.random.key(0)).returns()
    >>> print(returns)
    4 returns of 2 shots: 2 ground, 2 plate
    >>> print(returns.position[:2, 2].round(1) + 0.0, returns.number[:2])
    [6. 0.] [1 2]
    """

    shot: Int[np.ndarray, " returns"]
    time: Float[np.ndarray, " returns"]
    range: Float[np.ndarray, " returns"]
    position: Float[np.ndarray, "returns 3"]
    amplitude: Float[np.ndarray, " returns"]
    width: Float[np.ndarray, " returns"]
    reflectance: Float[np.ndarray, " returns"]
    number: Int[np.ndarray, " returns"]
    n_returns: Int[np.ndarray, " returns"]
    material: Shaped[np.ndarray, " returns"]
    ground_share: Float[np.ndarray, " returns"]
    ground_height: Float[np.ndarray, " returns"]
    gps_time: Float[np.ndarray, " returns"]
    scan_angle: Float[np.ndarray, " returns"]
    flight_line: Int[np.ndarray, " returns"]
    n_shots: int = eqx.field(static=True)
    crs: str | None = eqx.field(static=True, default=None)
    instance: Int[np.ndarray, " returns"] | None = None
    normal: Float[np.ndarray, "returns 3"] | None = None
    incidence: Float[np.ndarray, " returns"] | None = None

    def __len__(self) -> int:
        return len(self.shot)

    def __str__(self) -> str:
        names, counts = np.unique(self.material, return_counts=True)
        materials = ", ".join(f"{count:,} {name}" for name, count in zip(names, counts)) or "none"
        plural = "s" * (self.n_shots != 1)
        return f"{len(self):,} returns of {self.n_shots:,} shot{plural}: {materials}"

    @property
    def classification(self) -> Int[np.ndarray, " returns"]:
        """Classes of the LAS specification, (returns,), by the true material.

        2 ground; 3, 4 and 5 leaf and bark, of voxels or as `leaf_mesh` and `mesh_of` make them, up to 0.5 m,
        up to 2 m and higher above the ground (5 also where there is none); 1 plates and other meshes; 18 air;
        7 noise.
        """
        height = self.position[:, 2] - self.ground_height
        # Comparisons with NaN are false: without ground, vegetation is high.
        vegetation = np.full(len(self), _LOW_VEGETATION + len(_VEGETATION_LIMITS))
        for number, limit in reversed(list(enumerate(_VEGETATION_LIMITS))):
            vegetation[height <= limit] = _LOW_VEGETATION + number
        names = [name for name in set(self.material.tolist()) if unnumbered(name) in _PLANTS]
        classes = np.where(np.isin(self.material, names), vegetation, _UNCLASSIFIED)
        for name, number in (("ground", _GROUND_CLASS), ("air", _HIGH_NOISE), (_NO_MATERIAL, _LOW_NOISE)):
            classes[self.material == name] = number
        return classes

    @property
    def part(self) -> Int[np.ndarray, " returns"]:
        """Parts of the scene, (returns,): 1 ground, 2 leaf, 3 wood, 4 other surfaces, 0 air and noise."""
        names = np.array([unnumbered(name) for name in self.material.tolist()], object)
        parts = np.full(len(self), 4)
        for number, of_part in enumerate(_PARTS):
            parts[np.isin(names, of_part)] = number
        return parts

    def labelled(self, survey: Survey, scene: Scene) -> "DiscreteReturns":
        """Find what was hit: the tree or copy, the normal of its surface, and the incidence angle.

        Training data for segmentation need these. Rays over the footprint of each shot are followed to what
        they meet first; a return has the labels of most of those that come to its range. Returns of the
        voxels of a canopy, which have no surface, have the instance 0 and no normal: `leaf_mesh` makes leaves
        that have both.

        Instances are those that `MeshInstances`, or else the `Mesh`, states; `leaf_mesh` of a `Stand` numbers
        its trees from 1. Where no mesh of the scene states any, copies are numbered from 1, mesh after mesh.

        **Arguments:** `survey`, `scene`: those that were simulated.

        **Returns:** a `DiscreteReturns` with `instance`, `normal` and `incidence`.

        **Warns:** UserWarning where more than a tenth of the returns of surfaces find none, as with another
        survey or scene.

        **Raises:** ValueError for another number of shots than that of the returns; TypeError for objects of
        the wrong type, such as `SceneParts`.

        **Example:** a roof that falls to the east at 30 degrees.

        >>> import jax, jaxlidar as jl
        >>> corners = [(-3, -3, 4), (3, -3, 4 - 6 * 3**-0.5), (3, 3, 4 - 6 * 3**-0.5), (-3, 3, 4)]
        >>> roof = jl.MeshSurface((corners, [(0, 1, 2), (0, 2, 3)]), reflectance=0.3)
        >>> scene = jl.Scene(meshes=[roof], ground=jl.Ground(reflectance=0.3))
        >>> survey = jl.Survey.grid(jl.Lidar(altitude=300.0), low=(0, 0), high=(10, 0), spacing=10.0)
        >>> returns = jl.simulate_many(survey, scene, key=jax.random.key(0)).returns()
        >>> returns = returns.labelled(survey, scene)
        >>> print(returns.material, returns.instance, returns.incidence.round(1))
        ['mesh' 'ground'] [1 0] [30.  0.]
        """
        check_kind("survey", survey, Survey, "the Survey that was simulated")
        check_kind("scene", scene, Scene, "the Scene that was simulated")
        if len(survey) != self.n_shots:
            raise ValueError(
                f"survey has {len(survey)} shots; admissible is that of the returns, {self.n_shots}"
            )
        # Ranges of a survey that is disturbed are stated with their error.
        error = np.zeros(self.n_shots) if survey.stated is None else survey.stated[:, 5]
        true_range = self.range - error[self.shot]
        labels = labels_of(self.shot, true_range, self.width, self.material, survey, scene)
        is_surface = (self.part > 0) & ~np.isin(self.material, ("leaf", "bark"))
        n_surfaces, n_missed = np.sum(is_surface), np.sum(is_surface & np.isnan(labels.incidence))
        if n_missed > _LARGEST_MISS * n_surfaces:
            warn_user(
                f"{n_missed} of {n_surfaces} returns of surfaces lie where no ray meets one, and have no "
                "label: survey and scene must be those that were simulated, disturbed as they were"
            )
        return dataclasses.replace(self, **labels._asdict())

    @property
    def intensity(self) -> Int[np.ndarray, " returns"]:
        """Apparent reflectance in whole steps, (returns,): 65535 is one, or the largest above one."""
        largest = max(1.0, float(np.max(self.reflectance, initial=0.0)))
        return np.round(np.maximum(self.reflectance, 0.0) * (_FULL_INTENSITY / largest)).astype(int)

    def to_las(
        self, path: str | os.PathLike[str] | LasWriter, *, crs: str | None = None, extra: bool = True
    ) -> None:
        """Write the returns as a LAS or LAZ file: version 1.4, point format 6.

        Points have return numbers, `classification`, `intensity`, GPS time (0 if unknown), scan angle, the
        flight line as point source, and as extra bytes "width" (ns), "reflectance", "amplitude" (J) and
        "ground share"; where `labelled` has found them also "part", "instance", "incidence" (degrees) and
        "normal x", "normal y", "normal z" (0 for none). `jaxlidar.io.read_las` drops points of noise (classes
        7 and 18).

        **Arguments:**

        - `path`: the file, which ends in ".las" or ".laz". Missing folders are created. Or a
          `jaxlidar.io.LasWriter`, to which the returns are added, if there are any: there an intensity of
          65535 is a reflectance of one, and larger ones are refused.
        - `crs`: coordinate reference system of the scene, in metres, such as "EPSG:32633". Default None: that
          of the returns, or of the `LasWriter`. This needs pyproj.
        - `extra`: False for a file without extra bytes, as some readers need. Default True.

        **Raises:** as `jaxlidar.io.write_las`; ValueError for another system than that of the returns, where
        there is no return, and for more than 15 of one shot (`max_returns` of `Waveforms.returns`).

        **Example:**

        >>> import pathlib, tempfile
        >>> import jax, jaxlidar as jl
        >>> survey = jl.Survey.grid(jl.Lidar(), low=(0, 0), high=(10, 0), spacing=10.0)
        >>> many = jl.simulate_many(survey, jl.Scene(ground=jl.Ground(2.5)), key=jax.random.key(0))
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "strip.laz"
        >>> many.returns().to_las(path)
        >>> cloud = jl.io.read_las(path)
        >>> print(cloud.position[:, 2].round(2), cloud.classification)
        [2.5 2.5] [2 2]
        """
        check_flag("extra", extra)
        if isinstance(path, LasWriter):
            if crs is not None:
                raise ValueError(f"crs = {crs!r} is given together with a LasWriter, which has its own")
            if len(self):
                if (largest := np.max(self.reflectance)) > 1.0:
                    raise ValueError(
                        f"reflectance = {largest:.6g} is outside the admissible range [0, 1] of a LasWriter, "
                        f"where one is an intensity of {_FULL_INTENSITY}: give to_las a path, which scales "
                        "intensities to the largest, or write your own with LasWriter.write"
                    )
                intensity = _FULL_INTENSITY * np.maximum(self.reflectance, 0.0)
                path.write(self.position, **self._point_fields(intensity, extra), crs=self.crs)
            return
        if len(self) == 0:
            raise ValueError(
                f"{path}: the survey has no return to write: nothing in its {self.n_shots:,} shots reaches "
                "the threshold; give a lower threshold to returns or to_las (min_reflectance to "
                "true_returns), or write the waveforms with to_las_waveforms"
            )
        crs = common_system({"the simulation": self.crs, "crs": crs})
        write_las(path, self.position, crs=crs, **self._point_fields(self.intensity, extra))

    def _point_fields(self, intensity: Num[np.ndarray, " returns"], extra: bool) -> dict[str, Any]:
        """Return the arguments of `write_las` beside positions."""
        return {
            "intensity": intensity,
            "return_number": self.number,
            "number_of_returns": self.n_returns,
            "gps_time": np.where(np.isnan(self.gps_time), 0.0, self.gps_time),
            "classification": self.classification,
            "scan_angle": self.scan_angle,
            "point_source": self.flight_line,
            "extra": self._extra_numbers() if extra else {},
        }

    def _extra_numbers(self) -> dict[str, tuple[str, Num[np.ndarray, " returns"]]]:
        """Return what goes into extra bytes, by name: a description, and the numbers."""
        numbers = {
            "width": ("full width at half maximum, ns", self.width),
            "reflectance": ("apparent reflectance", self.reflectance),
            "amplitude": ("peak energy per sample, J", self.amplitude),
            "ground share": ("fraction scattered by ground", self.ground_share),
        }
        if self.instance is None or self.normal is None or self.incidence is None:
            return numbers
        numbers["part"] = ("1 ground 2 leaf 3 wood 4 other", self.part)
        numbers["instance"] = ("number of the tree, 0 for none", self.instance)
        numbers["incidence"] = ("from the normal, degrees", np.nan_to_num(self.incidence))
        for axis, values in zip("xyz", np.nan_to_num(self.normal).T):
            numbers[f"normal {axis}"] = ("of the surface that was hit", values)
        return numbers


# -- geometry ----------------------------------------------------------------------------------------------


class ShotAxes(NamedTuple):
    """Axes of beams, for the positions and ranges of what returns along them.

    - `origin`: (shots, 3) m, where the axis is at time zero: on the reference plane, or at the sensor of a
      lidar that is placed by it. - `direction`: (shots, 3) unit vectors.
    - `distance`: (shots,) m from the sensor to the origin; of a lidar that is placed by its sensor the error
      of the range. - `begins_at_sensor`: True of such a lidar.
    """

    origin: Float[np.ndarray, "shots 3"]
    direction: Float[np.ndarray, "shots 3"]
    distance: Float[np.ndarray, " shots"]
    begins_at_sensor: bool


def position_along_beam(
    origin: Float[np.ndarray, "n 3"],
    direction: Float[np.ndarray, "n 3"],
    two_way_time: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n 3"]:
    """Return where light is scattered that returns `two_way_time` ns after light from the origin, m."""
    return origin + (0.5 * SPEED_OF_LIGHT) * two_way_time[:, None] * direction


def _shot_axes(
    position: Float[np.ndarray, "shots axes"],
    zenith: Float[np.ndarray, " shots"],
    azimuth: Float[np.ndarray, " shots"],
    range_at_time_zero: Float[np.ndarray, " shots"],
) -> ShotAxes:
    """Return the axes of shots; `position` is (x, y) on the reference plane, or (x, y, z) of the sensor."""
    position, direction = np.asarray(position, float), beam_directions(zenith, azimuth)
    distance = np.asarray(range_at_time_zero, float)
    if position.shape[1] == 3:
        return ShotAxes(position + distance[:, None] * direction, direction, distance, True)
    return ShotAxes(np.pad(position, ((0, 0), (0, 1))), direction, distance, False)


# -- waveforms as input ------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class DetectorInput:
    """The waveforms of shots at one wavelength, and what is known of the shots.

    - `time`: (samples,) ns. - `recorded`, `energy`, `stderr`: (shots, samples), as those of `Waveforms`.
    - `components`: by material, (shots, samples) apparent reflectance. - `truth`: the same of
      `Truth.returns`, or None.
    - `surface_height`: of the truth, by surface, (shots,) m; empty without truth.
    - `axes`: of the beams. - `acquisition`: of the shots. - `constant`: radiometric constant, J m2.
    - `receiver_noise`: `Acquisition.noise`, J.
    - `ground_height`: (shots,) m. - `crs`: coordinate reference system, or None.
    """

    time: Float[np.ndarray, " samples"]
    recorded: Float[np.ndarray, "shots samples"]
    energy: Float[np.ndarray, "shots samples"] | NotKept
    stderr: Float[np.ndarray, "shots samples"] | NotKept
    components: Mapping[str, Float[np.ndarray, "shots samples"]]
    truth: Mapping[str, Float[np.ndarray, "shots samples"]] | None
    surface_height: Mapping[str, Float[np.ndarray, " shots"]]
    axes: ShotAxes
    acquisition: Acquisition
    constant: float
    receiver_noise: float
    ground_height: Float[np.ndarray, " shots"]
    crs: str | None = None

    def __len__(self) -> int:
        return len(self.recorded)

    @property
    def step(self) -> float:
        """Time from sample to sample, ns."""
        return float(self.time[-1] - self.time[0]) / max(self.time.size - 1, 1)

    @property
    def chunks(self) -> Iterator[slice]:
        """Slices of shots that are worked on at once."""
        size = max(_SAMPLES_AT_ONCE // self.time.size, 1)
        return (slice(i, min(i + size, len(self))) for i in range(0, len(self), size))

    def range_at(self, shot: np.ndarray, time: np.ndarray) -> np.ndarray:
        """Distances in m from the sensor, of light that returns at times in ns."""
        return self.axes.distance[shot] + 0.5 * SPEED_OF_LIGHT * time


def wavelength_index(wavelength: Any, wavelengths: np.ndarray) -> int:
    """Return the index of a wavelength in nm; None is the first."""
    if wavelength is None:
        return 0
    check_number("wavelength", wavelength, 0.0, low_open=True)
    (matches,) = np.nonzero(np.isclose(wavelengths, float(wavelength), rtol=1e-6))
    if matches.size == 0:
        raise ValueError(f"wavelength = {float(wavelength):g} nm is none of {wavelengths.tolist()}")
    return int(matches[0])


def input_of_waveforms(waves: Any, wavelength: Any) -> DetectorInput:
    """Return the input of a `Waveforms`. **Raises:** ValueError for those of an earlier version's file."""
    if waves.acquisition is None:
        raise ValueError(
            "the waveforms have no acquisition, which files of earlier versions lack: simulate them again"
        )
    w = wavelength_index(wavelength, np.asarray(waves.wavelength, float))
    zenith, azimuth = np.asarray(waves.zenith, float), np.asarray(waves.azimuth, float)
    # True heights state no point of stated axes.
    is_disturbed = waves.info.get("disturbed", False)
    return DetectorInput(
        time=np.asarray(waves.time, float),
        recorded=waves.recorded[:, w],
        # Not needed with `background` and `noise`: whoever needs them will be told that they were not kept.
        energy=waves.energy if isinstance(waves.energy, NotKept) else waves.energy[:, w],
        stderr=waves.stderr if isinstance(waves.stderr, NotKept) else waves.stderr[:, w],
        components={name: a[:, w] for name, a in waves.components.items() if name not in _ORDERS},
        truth=None if waves.truth is None else {name: a[:, w] for name, a in waves.truth.returns.items()},
        surface_height={} if waves.truth is None or is_disturbed else waves.truth.surface_height,
        axes=_shot_axes(waves.position, zenith, azimuth, waves.acquisition.range_at_time_zero),
        acquisition=waves.acquisition,
        constant=float(waves.acquisition.radiometric_constant[w]),
        receiver_noise=float(waves.acquisition.noise[w]),
        ground_height=np.asarray(waves.ground_height, float),
        crs=waves.crs,
    )


def warn_of_expected_returns(waves: DetectorInput) -> None:
    """Warn of shots that see crowns of voxels and nothing else; see `Waveforms.returns`."""
    n_shots = 0
    for shots in waves.chunks:
        light = {name: np.asarray(a[shots]).sum(axis=1) for name, a in waves.components.items()}
        crowns = light.get("leaf", 0.0) + light.get("bark", 0.0)
        n_shots += np.count_nonzero((crowns > 0.0) & (crowns >= sum(light.values())))
    if n_shots:
        warn_user(
            f"{n_shots} of {len(waves)} shots see crowns alone, by beams narrower than voxels: their returns "
            "are of the light that is expected of leaves, so that hardly any shot has none; leaf_mesh makes "
            "leaves that are hit or missed"
        )


# -- detection ---------------------------------------------------------------------------------------------


class _Echoes(NamedTuple):
    """Echoes of some records, in order of records and times; times and widths are in samples.

    - `row`: number of the record. - `time`: from the first sample. - `amplitude`: J per sample. - `width`:
      full width at half maximum. - `start`, `end`: the first sample of the echo, and the one after its last.
    """

    row: Int[np.ndarray, " echoes"]
    time: Float[np.ndarray, " echoes"]
    amplitude: Float[np.ndarray, " echoes"]
    width: Float[np.ndarray, " echoes"]
    start: Int[np.ndarray, " echoes"]
    end: Int[np.ndarray, " echoes"]


def _no_echoes() -> _Echoes:
    none, empty = np.zeros(0, int), np.zeros(0)
    return _Echoes(none, empty, empty, empty, none, none)


class _Peaks(NamedTuple):
    """Largest samples of echoes, as indices of records one after another; `row`: number of the record.

    - `first`: the first local maximum of each echo.
    - `before`, `after`: the ends of the record, or the lowest sample between the echo and its neighbour.
    """

    index: Int[np.ndarray, " echoes"]
    row: Int[np.ndarray, " echoes"]
    first: Int[np.ndarray, " echoes"]
    before: Int[np.ndarray, " echoes"]
    after: Int[np.ndarray, " echoes"]


def _find_echoes(
    detector: str,
    record: Float[np.ndarray, "shots samples"],
    noise: Float[np.ndarray, "..."],
    levels: Float[np.ndarray, "..."],
    fraction: float,
    pulse: Float[np.ndarray, " lags"],
) -> _Echoes:
    """Detect echoes in records without background; see the module's docstring.

    **Arguments:** `noise`, `levels`: (shots, 1) or (shots, samples) standard deviation, and threshold.
    """
    shots, samples = record.shape
    # A sample of zero before and after each record, so that records can lie one after another in one array.
    width = samples + 2
    padded = np.zeros((shots, width), record.dtype)
    padded[:, 1:-1] = record
    flat = padded.ravel()
    # The first sample of a plateau counts. Records without light have no threshold above zero.
    is_maximum = (record >= levels) & (record > 0) & (record > padded[:, :-2]) & (record >= padded[:, 2:])
    rows, columns = np.divmod(np.flatnonzero(is_maximum), samples)
    level = levels[rows, columns if levels.shape[1] > 1 else 0]
    peaks = _group_maxima(detector, flat, rows * width + columns + 1, rows, level, fraction, width)
    if peaks.index.size == 0:
        return _no_echoes()

    position, amplitude = _apex(flat, peaks.index)
    full_width = _full_widths(flat, peaks, position, amplitude)
    relative_level: float | np.ndarray = fraction
    if detector == "constant fraction":
        position = _crossing(flat, peaks.index, -1, fraction * amplitude, peaks.before)
    elif detector == "leading edge":
        first_amplitude = _apex(flat, peaks.first)[1]
        # The threshold where the record crosses it, which is about that at the first maximum.
        crossed = levels[peaks.row, (peaks.first % width) - 1 if levels.shape[1] > 1 else 0]
        position = _crossing(flat, peaks.first, -1, crossed, peaks.before, logarithmic=True)
        relative_level = crossed / first_amplitude
    position = _calibrated(detector, position, _readings_of_pulse(detector, pulse, relative_level))
    start, end = _extents(padded, peaks, noise)
    first_sample = peaks.row * width + 1
    return _Echoes(
        peaks.row, position - first_sample, amplitude, full_width, start - first_sample, end - first_sample
    )


def _find_echoes_by_function(
    detector: DetectorFunction,
    time: Float[np.ndarray, " samples"],
    record: Float[np.ndarray, "shots samples"],
    noise: Float[np.ndarray, "..."],
    first_shot: int,
    pulse_length: int,
) -> _Echoes:
    """Take the times of echoes from a function, and measure the records about them.

    **Arguments:** `noise`: as for `_find_echoes`. `first_shot`: number of the first record, for messages.
    `pulse_length`: in samples.
    """
    samples, step = time.size, _sample_interval(time)
    sigma = np.broadcast_to(noise, record.shape)
    positions = [
        (_detected_times(detector, time, power, sigma[i], first_shot + i) - time[0]) / step
        for i, power in enumerate(record)
    ]
    row = np.repeat(np.arange(len(record)), [len(p) for p in positions])
    position = np.concatenate(positions)
    # Samples that are nearer to an echo than to its neighbours, and within a pulse's length of it.
    start = np.maximum(np.ceil(position - pulse_length), 0).astype(int)
    end = np.minimum(np.floor(position + pulse_length) + 1, samples).astype(int)
    (pair,) = np.nonzero(row[1:] == row[:-1])
    middle = np.ceil(0.5 * (position[pair] + position[pair + 1])).astype(int)
    end[pair], start[pair + 1] = np.minimum(end[pair], middle), np.maximum(start[pair + 1], middle)
    padded = np.pad(record, ((0, 0), (1, 1)))
    width, flat = samples + 2, padded.ravel()
    first_sample = row * width + 1
    index = _first_minimum(-flat, first_sample + start, first_sample + end) if row.size else row
    is_light = flat[index] > 0
    row, position, index, first_sample = (a[is_light] for a in (row, position, index, first_sample))
    before, after = _bounds(flat, index, row, width)
    peaks = _Peaks(index, row, index, before, after)
    apex, amplitude = _apex(flat, index)
    full_width = _full_widths(flat, peaks, apex, amplitude)
    start, end = _extents(padded, peaks, noise)
    return _Echoes(row, position, amplitude, full_width, start - first_sample, end - first_sample)


def _detected_times(
    detector: DetectorFunction, time: np.ndarray, power: np.ndarray, noise: np.ndarray, shot: int
) -> Float[np.ndarray, " returns"]:
    """Call a detector on one record, and check what it gives: times in order, without NaN."""
    detected = detector(time, power, noise)
    check_numbers("what detector returns", detected)
    times = np.asarray(detected, float)
    if times.ndim != 1:
        raise ValueError(
            f"detector returns shape {times.shape} for shot {shot}; admissible is (returns,): times in ns"
        )
    times, step = np.sort(times[~np.isnan(times)]), _sample_interval(time)
    # Times of single precision are rounded.
    margin = _ROUNDING_OF_TIMES * step
    check_range(f"time that detector returns for shot {shot}", times, time[0] - margin, time[-1] + margin)
    is_close = np.diff(times) < step - margin
    if np.any(is_close):
        i = int(np.argmax(is_close))
        raise ValueError(
            f"detector returns {times[i]:g} and {times[i + 1]:g} ns for shot {shot}; admissible are times a "
            f"sample, {step:g} ns, or more apart"
        )
    return np.clip(times, time[0], time[-1])


def _sample_interval(time: Float[np.ndarray, " samples"]) -> float:
    """Return the time from sample to sample, ns; 1 for a record of a single sample."""
    return float(time[-1] - time[0]) / (time.size - 1) if time.size > 1 else 1.0


def _full_widths(flat: np.ndarray, peaks: _Peaks, position: np.ndarray, amplitude: np.ndarray) -> np.ndarray:
    """Return full widths at half maximum, in samples, of echoes with their apex at `position`."""
    half_width_before = position - _crossing(flat, peaks.index, -1, 0.5 * amplitude, peaks.before)
    half_width_after = _crossing(flat, peaks.index, 1, 0.5 * amplitude, peaks.after) - position
    # One side alone falls to half where echoes overlap. If neither does, the dips bound the echo.
    half_width_before = np.where(np.isnan(half_width_before), half_width_after, half_width_before)
    half_width_after = np.where(np.isnan(half_width_after), half_width_before, half_width_after)
    full_width = half_width_before + half_width_after
    return np.where(np.isnan(full_width), peaks.after - peaks.before, full_width)


def _group_maxima(
    detector: str,
    flat: np.ndarray,
    maximum: np.ndarray,
    row: np.ndarray,
    level: np.ndarray,
    fraction: float,
    width: int,
) -> _Peaks:
    """Group local maxima into echoes.

    Two neighbours are separated where the lowest sample between them, the dip, is low enough. Else the
    lower one is dropped, until all are separated. `level`: the threshold at each maximum.
    """
    if maximum.size == 0:
        return _Peaks(maximum, row, maximum, maximum, maximum)
    height = flat[maximum]
    # The lowest sample from each maximum to the next one of the same record.
    dip = np.minimum.reduceat(flat, maximum)
    if detector == "leading edge":
        # The discriminator does not know of maxima: an echo is all until the record has fallen.
        is_separated = (row[1:] != row[:-1]) | (dip[:-1] < _HYSTERESIS * np.minimum(level[1:], level[:-1]))
        starts = np.flatnonzero(np.r_[True, is_separated])
        highest = np.repeat(np.maximum.reduceat(height, starts), np.diff(np.r_[starts, maximum.size]))
        group = np.cumsum(np.r_[False, is_separated])
        (is_highest,) = np.nonzero(height == highest)
        index = maximum[is_highest[np.searchsorted(group[is_highest], np.arange(starts.size))]]
        first, row = maximum[starts], row[starts]
    else:
        while True:
            is_pair = row[1:] == row[:-1]
            lower = np.minimum(height[1:], height[:-1])
            limit = lower - np.where(height[1:] < height[:-1], level[1:], level[:-1])
            if detector == "constant fraction":
                # The leading edge of the later echo must begin below its fraction.
                limit = np.minimum(limit, fraction * height[1:])
            is_joined = is_pair & (dip[:-1] > limit)
            if not is_joined.any():
                break
            is_dropped = np.zeros(maximum.size, bool)
            is_dropped[1:] |= is_joined & (height[1:] <= height[:-1])
            is_dropped[:-1] |= is_joined & (height[1:] > height[:-1])
            (remaining,) = np.nonzero(~is_dropped)
            dip = np.minimum.reduceat(dip, remaining)
            maximum, row, height, level = (a[remaining] for a in (maximum, row, height, level))
        index = first = maximum
    before, after = _bounds(flat, index, row, width)
    return _Peaks(index, row, first, before, after)


def _bounds(
    flat: np.ndarray, index: np.ndarray, row: np.ndarray, width: int
) -> tuple[Int[np.ndarray, " echoes"], Int[np.ndarray, " echoes"]]:
    """Return the lowest samples between echoes and their neighbours, or the ends of the record."""
    before, after = row * width, (row + 1) * width - 1
    (pair,) = np.nonzero(row[1:] == row[:-1])
    if pair.size:
        lowest = _first_minimum(flat, index[pair], index[pair + 1])
        after[pair] = before[pair + 1] = lowest
    return before, after


def _first_minimum(flat: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the index of the smallest value in each range [start, end); the first of equal ones."""
    lengths = end - start
    offsets = np.cumsum(lengths) - lengths
    index = np.arange(lengths.sum()) + np.repeat(start - offsets, lengths)
    values = flat[index]
    (is_smallest,) = np.nonzero(values == np.repeat(np.minimum.reduceat(values, offsets), lengths))
    return index[is_smallest[np.searchsorted(is_smallest, offsets)]]


def _apex(flat: np.ndarray, peak: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions and values of maxima between samples; the middle of a plateau."""
    centre, before, after = (flat[peak + k].astype(float) for k in (0, -1, 1))
    # Parabola through logarithms; where a neighbour is not positive, through the values themselves.
    has_logarithm = (before > 0) & (after > 0)
    curves = [
        np.where(has_logarithm, np.log(np.where(has_logarithm, y, 1.0)), y / centre) for y in (before, after)
    ]
    middle = np.where(has_logarithm, np.log(centre), 1.0)
    slope, curvature = 0.5 * (curves[1] - curves[0]), curves[1] - 2.0 * middle + curves[0]
    shift = np.clip(-slope / np.where(curvature < 0, curvature, -1.0), -0.5, 0.5)
    top = middle + 0.5 * slope * shift
    value = np.where(has_logarithm, np.exp(np.where(has_logarithm, top, 0.0)), top * centre)
    first, last = (_end_of_plateau(flat, peak, direction) for direction in (-1, 1))
    # Two equal samples lie on either side of an apex.
    is_plateau = last > first + 1
    return (
        np.where(is_plateau, 0.5 * (first + last), peak + shift),
        np.where(is_plateau, centre, value),
    )


def _end_of_plateau(flat: np.ndarray, peak: np.ndarray, direction: int) -> np.ndarray:
    """Return the last samples in a direction (1 or -1) that are nearly as large as the maxima.

    A saturated record repeats its largest value, and so does a pulse of constant power.
    """
    end, lowest = peak.copy(), flat[peak] * (1.0 - _PLATEAU_DIFFERENCE)
    growing = np.flatnonzero(flat[peak + direction] >= lowest)
    while growing.size:
        end[growing] += direction
        growing = growing[flat[end[growing] + direction] >= lowest[growing]]
    return end


def _crossing(
    flat: np.ndarray,
    start: np.ndarray,
    direction: int,
    level: np.ndarray,
    bound: np.ndarray,
    *,
    logarithmic: bool = False,
) -> np.ndarray:
    """Return where records fall below levels, walking from `start` in a direction (1 or -1).

    All echoes walk at once, a sample at a time. Positions are interpolated between two samples, linearly or
    in logarithms.

    **Returns:** positions; NaN where the record does not fall below the level up to `bound`.
    """
    position = np.full(start.size, np.nan)
    current, walking = start.copy(), np.arange(start.size)
    while walking.size:
        following = current[walking] + direction
        value = flat[following]
        is_below = value < level[walking]
        crossing = walking[is_below]
        inner, outer, target = (
            a.astype(float) for a in (flat[current[crossing]], value[is_below], level[crossing])
        )
        # The level was interpolated: it may lie above the sample at which the walk starts.
        inner = np.maximum(inner, target)
        step = (inner - target) / (inner - outer)
        if logarithmic:
            # Where an edge begins, the sample before it may be zero: the floor keeps times in order.
            step = np.log(inner / target) / np.log(inner / np.maximum(outer, _LOGARITHM_FLOOR * target))
        position[crossing] = current[crossing] + direction * step
        walking = walking[~is_below & (following != bound[walking])]
        current[walking] += direction
    return position


def _readings_of_pulse(detector: str, pulse: np.ndarray, fraction: Any) -> np.ndarray:
    """Return the times that a detector reads of the pulse itself, at each phase of the samples.

    In phase k, of 0 to `PULSE_OVERSAMPLING`, the time zero of the pulse lies k / `PULSE_OVERSAMPLING` of a
    sample after sample 0. What the interpolation between samples adds is part of the reading.

    **Arguments:** `fraction`: level over amplitude, of an edge detector; a number, or one for each echo.

    **Returns:** (phases, echoes), or (phases, 1), in samples from sample 0; they increase with the phase.
    """
    levels, middle = np.atleast_1d(np.asarray(fraction, float)), pulse.size // 2
    readings = []
    for phase in range(PULSE_OVERSAMPLING + 1):
        first, offset = divmod(middle - phase, PULSE_OVERSAMPLING)
        flat = np.r_[0.0, pulse[offset::PULSE_OVERSAMPLING], 0.0]
        peak = np.array([int(np.argmax(flat))])
        reading, amplitude = _apex(flat, peak)
        if detector != "peak":
            start, bound = np.repeat(peak, levels.size), np.zeros(levels.size, int)
            is_logarithmic = detector == "leading edge"
            reading = _crossing(flat, start, -1, levels * amplitude, bound, logarithmic=is_logarithmic)
        readings.append(reading - 1 - first)
    # A pulse with a flat top is read at the same time in several phases.
    return np.maximum.accumulate(np.stack(readings), axis=0)


def _calibrated(detector: str, position: np.ndarray, readings: np.ndarray) -> np.ndarray:
    """Return the time zeros of echoes that a detector reads at `position`, in samples.

    Readings of the pulse by its phase are interpolated linearly. Those a sample later are a sample larger.
    """
    latest = _latest_time_zero(position, readings)
    if detector != "peak" or np.all(readings[1:] > readings[:-1]):
        return latest
    # The peak of a pulse with a flat top has one reading in several phases: the middle of these is taken. The
    # earliest time is the latest where time runs backwards.
    return 0.5 * (latest - _latest_time_zero(-position, 1.0 - readings[::-1]))


def _latest_time_zero(position: np.ndarray, readings: np.ndarray) -> np.ndarray:
    """Return the latest time zeros at which the pulse has the readings `position`, in samples."""
    whole = np.floor(position - readings[0])
    remainder = position - whole - readings
    # The last phase whose reading is not above that of the echo.
    before = np.minimum(np.count_nonzero(remainder >= 0, axis=0) - 1, PULSE_OVERSAMPLING - 1)
    echo = np.arange(position.size)
    low, high = remainder[before, echo], remainder[before + 1, echo]
    step = np.where(low > high, low / np.where(low > high, low - high, 1.0), 0.0)
    return whole + (before + np.clip(step, 0.0, 1.0)) / PULSE_OVERSAMPLING


def _extents(
    padded: np.ndarray, peaks: _Peaks, noise: np.ndarray
) -> tuple[Int[np.ndarray, " echoes"], Int[np.ndarray, " echoes"]]:
    """Return the first sample of each echo and the one after its last, as indices of the flat records."""
    floor = np.maximum(noise.max(axis=1), _RELATIVE_FLOOR * padded.max(axis=1))
    # The zeros before and after each record are never above the floor.
    low = np.flatnonzero(padded <= floor[:, None])
    following = np.searchsorted(low, peaks.index, "right")
    before, after = low[following - 1], low[np.minimum(following, low.size - 1)]
    # The dip between two echoes belongs to the later one.
    start = np.maximum(
        before + 1, np.where(peaks.before % padded.shape[1] == 0, peaks.before + 1, peaks.before)
    )
    return np.minimum(start, peaks.index), np.maximum(np.minimum(after, peaks.after), peaks.index + 1)


def _sums_over_extents(array: np.ndarray, echoes: _Echoes) -> Float[np.ndarray, " echoes"]:
    """Return the sums of (shots, samples) over the samples of each echo."""
    # One more value: the last range may end at the end of the array.
    flat = np.append(np.ascontiguousarray(array).ravel(), 0.0)
    first = echoes.row * array.shape[1]
    edges = np.stack([first + echoes.start, first + echoes.end], axis=1).ravel()
    return np.add.reduceat(flat, edges, dtype=float)[::2] if edges.size else np.zeros(0)


# -- assembly ----------------------------------------------------------------------------------------------


def returns_of(
    waves: DetectorInput,
    detector: str | DetectorFunction,
    *,
    record: Any = None,
    background: Any = None,
    noise: Any = None,
    threshold: Any = None,
    fraction: Any = 0.5,
    max_returns: int | None = None,
    progress: ProgressOption = None,
) -> DiscreteReturns:
    """Detect the returns of waveforms. Arguments are those of `Waveforms.returns`."""
    if not callable(detector):
        check_choice("detector", detector, DETECTORS)
    elif threshold is not None:
        raise ValueError(
            "threshold is given, but detector is a function; admissible is a function that applies its own"
        )
    check_number("fraction", fraction, 0.0, 1.0, low_open=True, high_open=True)
    if max_returns is not None:
        max_returns = check_integer("max_returns", max_returns)
    shape, is_own_record = waves.recorded.shape, record is None
    records = waves.recorded if is_own_record else np.asarray(record)
    if records.shape != shape:
        raise ValueError(f"record has shape {records.shape} at one wavelength; admissible is {shape}")
    if not is_own_record:
        # A sample that is not known would take all returns of its shot with it.
        check_range("record", records)
    settings = _Settings(detector, float(fraction), *_limits(shape, background, noise, threshold))
    start_time, blocks = time.perf_counter(), []
    if is_own_record and settings.background is None:
        settings = settings._replace(background=np.full(shape[0], _recorded_background(waves)))
    if not is_own_record and settings.noise is None:
        settings = settings._replace(noise=_noise_of_records(waves, records))
    for shots in waves.chunks:
        if detector == "decomposition":
            for block in _decompose_chunk(waves, records[shots], shots, settings):
                blocks.append(block)
        else:
            blocks.append(_detect_chunk(waves, records[shots], shots, settings))
        if callable(progress):
            progress(Progress(shots.stop, len(waves), time.perf_counter() - start_time))
    echoes = {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}
    return _assemble(waves, echoes, max_returns)


class _Settings(NamedTuple):
    """Arguments of detection: (shots,) or (shots, samples), or None for the default."""

    detector: str | DetectorFunction
    fraction: float
    background: np.ndarray | None
    noise: np.ndarray | None
    threshold: np.ndarray | None


def _limits(shape: tuple[int, ...], background: Any, noise: Any, threshold: Any) -> list[np.ndarray | None]:
    """Convert background, noise and threshold to arrays by shot."""
    limits: list[np.ndarray | None] = []
    for name, value in (("background", background), ("noise", noise), ("threshold", threshold)):
        if value is None:
            limits.append(None)
            continue
        check_range(name, value, 0.0, low_open=name == "threshold")
        array = as_numpy(value, name)
        shapes = [(), shape[:1], shape] if name == "noise" else [(), shape[:1]]
        if array.shape not in shapes:
            raise ValueError(f"{name} has shape {array.shape}; admissible is {' or '.join(map(str, shapes))}")
        limits.append(array if array.ndim == 2 else np.broadcast_to(array, shape[:1]))
    return limits


def _recorded_background(waves: DetectorInput) -> float:
    """Return the background that the receiver adds, J per sample: the median of record less signal."""
    shots = slice(None, None, max(len(waves) // 64, 1))
    difference = np.asarray(waves.recorded[shots], float) - np.asarray(waves.energy[shots], float)
    return max(float(np.median(difference)), 0.0)


def _prepare_chunk(
    waves: DetectorInput, record: np.ndarray, shots: slice, settings: _Settings
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the records of a chunk of shots without background, their noise, and their thresholds."""
    record = np.ascontiguousarray(record)
    if settings.background is not None:
        level = settings.background[shots, None]
        record = record - level.astype(record.dtype) if level.any() else record
    else:
        record = record - _median_beside_echoes(record)
    if settings.noise is not None:
        noise = settings.noise[shots].astype(record.dtype)
        noise = noise if noise.ndim == 2 else noise[:, None]
    else:
        # The standard error of the simulation, as an energy.
        stderr = np.asarray(waves.stderr[shots])
        if stderr.any():
            noise = stderr * _energy_per_reflectance(waves, shots).astype(record.dtype)
        else:
            noise = np.zeros((len(record), 1), record.dtype)
    threshold = None if settings.threshold is None else settings.threshold[shots]
    return record, noise, _levels(record, noise, threshold)


def _levels(record: np.ndarray, noise: np.ndarray, threshold: np.ndarray | None) -> np.ndarray:
    """Return the thresholds of records, (shots, 1) or (shots, samples); by default (None) by their noise."""
    if threshold is not None:
        return threshold[:, None].astype(record.dtype)
    return np.maximum(_NOISE_FACTOR * noise, _RELATIVE_THRESHOLD * record.max(axis=1, keepdims=True))


def _noise_of_records(waves: DetectorInput, records: np.ndarray) -> Float[np.ndarray, " shots"]:
    """Return the standard deviation of noise of each record, J per sample; see the module's docstring.

    **Warns:** where noise is cut at zero.
    """
    noise, n_cut = np.full(len(waves), waves.receiver_noise), 0
    for shots in waves.chunks if records.shape[1] > 1 else ():
        record = np.ascontiguousarray(records[shots])
        # Differences of neighbours have twice the variance; the median ignores the echoes.
        of_differences = np.median(np.abs(np.diff(record, axis=1)), axis=1) / (np.sqrt(2.0) * _NORMAL_MEDIAN)
        is_zero = record == 0
        # An echo without noise begins and ends once.
        is_beside_zero = is_zero[:, 1:] != is_zero[:, :-1]
        is_cut = (record.min(axis=1) == 0) & (np.mean(is_beside_zero, axis=1) > _CUT_FRACTION)
        noise[shots] = np.maximum(of_differences, waves.receiver_noise)
        for row in np.flatnonzero(is_cut):
            beside_zero = np.maximum(record[row, 1:], record[row, :-1])[is_beside_zero[row]]
            noise[shots][row] = max(noise[shots][row], np.median(beside_zero) / _NORMAL_MEDIAN)
        n_cut += np.count_nonzero(is_cut)
    if n_cut:
        warn_user(
            f"the record of {n_cut} of {len(waves)} shots has noise that is cut at zero, and its noise is "
            "estimated from what lies above: give the receiver a background of some standard deviations of "
            "its noise, or noise="
        )
    return noise


def _median_beside_echoes(record: Float[np.ndarray, "shots samples"]) -> Float[np.ndarray, "shots 1"]:
    """Return the median of the samples of each shot without its echoes.

    Samples that exceed the median by `_CLIPPING` standard deviations are left out, and the median is taken
    again, until it stays. The deviation is that of samples below the median, where no echo is.
    """
    ordered, shots = np.sort(record, axis=1), np.arange(len(record))
    count = np.full(len(record), record.shape[1])
    for _ in range(_MAX_CLIPPINGS):
        median = 0.5 * (ordered[shots, (count - 1) // 2] + ordered[shots, count // 2])
        # The quantile of a normal distribution that lies one standard deviation below its median.
        deviation = median - ordered[shots, np.round(_ONE_SIGMA_BELOW * (count - 1)).astype(int)]
        kept = np.count_nonzero(ordered <= (median + _CLIPPING * deviation)[:, None], axis=1)
        if np.array_equal(kept, count):
            break
        count = kept
    return median[:, None]


def _energy_per_reflectance(waves: DetectorInput, shots: slice) -> Float[np.ndarray, "shots samples"]:
    """Return the energy of a sample per apparent reflectance, J; of an altitude, one number for a shot.

    From an altitude, ranges hardly change over a record. From a sensor they begin at zero: the first sample
    that begins after the emission stands for those before it.
    """
    if not waves.axes.begins_at_sensor:
        return waves.constant / waves.axes.distance[shots, None] ** 2
    ranges = 0.5 * SPEED_OF_LIGHT * np.maximum(waves.time[None], 0.5 * waves.step)
    return waves.constant / ranges**2


def _detect_chunk(
    waves: DetectorInput, record: np.ndarray, shots: slice, settings: _Settings
) -> dict[str, np.ndarray]:
    """Return the columns of the returns of a chunk of shots, found by all but the decomposition."""
    record, noise, levels = _prepare_chunk(waves, record, shots, settings)
    pulse, detector = waves.acquisition.pulse, settings.detector
    if isinstance(detector, str):
        echoes = _find_echoes(detector, record, noise, levels, settings.fraction, pulse)
    else:
        length = -(-pulse.size // PULSE_OVERSAMPLING)
        echoes = _find_echoes_by_function(detector, waves.time, record, noise, shots.start, length)
    return _columns(waves, record, shots, echoes)


def _columns(
    waves: DetectorInput, record: np.ndarray, shots: slice, echoes: _Echoes
) -> dict[str, np.ndarray]:
    """Return the columns of returns that differ between the echoes of a shot."""
    shot, time = shots.start + echoes.row, waves.time[0] + waves.step * echoes.time
    ranges = waves.range_at(shot, time)
    by_material = {
        name: _sums_over_extents(np.asarray(a[shots]), echoes) for name, a in waves.components.items()
    }
    return {
        "shot": shot,
        "time": time,
        "amplitude": echoes.amplitude.astype(float),
        "width": waves.step * echoes.width,
        "reflectance": _sums_over_extents(record, echoes) * ranges**2 / waves.constant,
        **_materials(by_material, shot.size),
    }


def _materials(by_material: Mapping[str, np.ndarray], count: int) -> dict[str, np.ndarray]:
    """Return the material with the largest sum of each return, and the share of the ground."""
    names = np.array([*by_material, _NO_MATERIAL])
    # Noise of higher orders may make a sum negative.
    sums = np.maximum(np.stack([*by_material.values(), np.zeros(count)]), 0.0)
    total = sums.sum(axis=0)
    largest = np.where(total > 0, np.argmax(sums, axis=0), len(names) - 1)
    ground = np.maximum(by_material.get("ground", np.zeros(count)), 0.0)
    share = np.where(total > 0, ground / np.where(total > 0, total, 1.0), 0.0)
    return {"material": names[largest], "ground_share": share}


def _assemble(
    waves: DetectorInput, echoes: dict[str, np.ndarray], max_returns: int | None
) -> DiscreteReturns:
    """Sort echoes by shot and time, drop the weakest beyond `max_returns` of a shot, and number them."""
    order = np.lexsort((echoes["time"], echoes["shot"]))
    columns = {name: values[order] for name, values in echoes.items()}
    shot, time = columns["shot"], columns["time"]
    axes, acquisition = waves.axes, waves.acquisition
    counts = np.bincount(shot, minlength=len(waves))
    returns = DiscreteReturns(
        **columns,
        range=waves.range_at(shot, time),
        position=position_along_beam(axes.origin[shot], axes.direction[shot], time),
        number=_number_in_shot(shot),
        n_returns=counts[shot],
        ground_height=waves.ground_height[shot],
        gps_time=acquisition.gps_time[shot],
        scan_angle=acquisition.scan_angle[shot],
        flight_line=acquisition.flight_line[shot],
        n_shots=len(waves),
        crs=waves.crs,
    )
    return returns if max_returns is None else strongest_returns(returns, max_returns)


def strongest_returns(returns: DiscreteReturns, max_returns: int) -> DiscreteReturns:
    """Return the `max_returns` strongest returns of each shot, numbered anew."""
    by_strength = np.lexsort((-returns.amplitude, returns.shot))
    rank = np.empty(len(returns), int)
    rank[by_strength] = _number_in_shot(returns.shot[by_strength])
    remaining = jax.tree.map(lambda column: column[rank <= max_returns], returns)
    counts = np.minimum(remaining.n_returns, max_returns)
    return dataclasses.replace(remaining, number=_number_in_shot(remaining.shot), n_returns=counts)


def _number_in_shot(shot: Int[np.ndarray, " returns"]) -> Int[np.ndarray, " returns"]:
    """Return the numbers, from 1, of returns in their shots; those of a shot follow one another."""
    if shot.size == 0:
        return shot
    starts = np.flatnonzero(np.r_[True, shot[1:] != shot[:-1]])
    return np.arange(shot.size) - np.repeat(starts, np.diff(np.r_[starts, shot.size])) + 1


# -- decomposition -----------------------------------------------------------------------------------------


def _decompose_chunk(
    waves: DetectorInput, record: np.ndarray, shots: slice, settings: _Settings
) -> Iterator[dict[str, np.ndarray]]:
    """Decompose the records of a chunk of shots where there is signal, a batch of windows at a time.

    1. Find the stretches of each record in which it exceeds the threshold, a pulse's length more at either
    end. 2. Sort them by length, and decompose as many at once as one compiled program takes.
    """
    record, noise, levels = _prepare_chunk(waves, record, shots, settings)
    largest = record.max(axis=1, initial=0.0)[:, None]
    pulse = waves.acquisition.pulse[
        waves.acquisition.pulse.size // 2 % PULSE_OVERSAMPLING :: PULSE_OVERSAMPLING
    ]
    margin = pulse.size // 2 + 1
    windows = _signal_windows((record >= levels) & (record > 0), margin)
    # Noise-free records are decomposed to the precision of the threshold.
    sigma = np.broadcast_to(np.maximum(noise, 0.2 * _RELATIVE_THRESHOLD * largest), record.shape)
    order = np.argsort([end - start for _, start, end in windows], kind="stable")
    for first in range(0, len(order), _RECORDS_AT_ONCE):
        batch = [windows[k] for k in order[first : first + _RECORDS_AT_ONCE]]
        yield _columns(waves, record, shots, _decompose_windows(record, sigma, levels, batch, pulse))
    if not windows:
        yield _columns(waves, record, shots, _no_echoes())


def _signal_windows(is_signal: Bool[np.ndarray, "shots samples"], margin: int) -> list[tuple[int, int, int]]:
    """Return (row, start, end) of samples with signal, widened by `margin` and joined."""
    shots, samples = is_signal.shape
    wide = np.zeros((shots, samples + 2), np.int32)
    # Differences of the number of windows that are open: signal opens one `margin` samples before it.
    rows, columns = np.nonzero(is_signal)
    np.add.at(wide, (rows, np.maximum(columns - margin, 0)), 1)
    np.add.at(wide, (rows, np.minimum(columns + margin + 1, samples)), -1)
    is_open = np.cumsum(wide, axis=1) > 0
    edges = np.diff(np.pad(is_open, ((0, 0), (1, 0))).astype(np.int8), axis=1)
    start_rows, starts = np.nonzero(edges == 1)
    _, ends = np.nonzero(edges == -1)
    return list(zip(start_rows.tolist(), starts.tolist(), ends.tolist()))


def _decompose_windows(
    record: np.ndarray,
    sigma: np.ndarray,
    threshold: np.ndarray,
    windows: list[tuple[int, int, int]],
    pulse: np.ndarray,
) -> _Echoes:
    """Decompose windows of records, at most `_RECORDS_AT_ONCE` of them."""
    length = max(end - start for _, start, end in windows)
    power, noise = np.zeros((_RECORDS_AT_ONCE, length)), np.full((_RECORDS_AT_ONCE, length), np.inf)
    # Records that fill up the batch have one sample with weight, and no echo.
    noise[:, 0] = 1.0
    for k, (row, start, end) in enumerate(windows):
        power[k, : end - start], noise[k, : end - start] = record[row, start:end], sigma[row, start:end]
    # optimistix, which fits, takes a second to import: only for those who decompose.
    from jaxlidar.survey.decomposition import gaussian_decomposition

    fitted = gaussian_decomposition(np.arange(float(length)), power, noise=noise, pulse=pulse)
    echoes = fitted.count, fitted.amplitude, fitted.time, fitted.width
    rows, starts, ends = (np.array(column) for column in zip(*windows))
    count, amplitude, time, std = (np.asarray(a, float)[: len(windows)] for a in echoes)
    # Broadened by a Gaussian, a copy of the pulse is lower by the ratio of the widths.
    pulse_std = pulse.sum() / (np.sqrt(2.0 * np.pi) * pulse.max())
    height = amplitude * pulse_std / np.hypot(pulse_std, std)
    sample = np.clip(np.round(time), 0, (ends - starts)[:, None] - 1).astype(int) + starts[:, None]
    limit = np.take_along_axis(np.broadcast_to(threshold, record.shape)[rows], sample, axis=1)
    window, echo = np.nonzero((np.arange(amplitude.shape[1]) < count[:, None]) & (height >= limit))
    order = np.lexsort((time[window, echo], window))
    window, echo = window[order], echo[order]
    first_sample = starts[window]
    centre = time[window, echo]
    # Echoes of one window share its samples: each has those nearer to it than to its neighbours.
    start, end = first_sample.copy(), ends[window].copy()
    (pair,) = np.nonzero(window[1:] == window[:-1])
    middle = np.ceil(0.5 * (centre[pair] + centre[pair + 1])).astype(int) + first_sample[pair]
    end[pair] = start[pair + 1] = np.clip(middle, start[pair], end[pair])
    return _Echoes(
        rows[window],
        first_sample + centre,
        height[window, echo],
        _FWHM_OF_STD * np.hypot(pulse_std, std[window, echo]),
        start,
        np.maximum(end, start + 1),
    )


# -- truth -------------------------------------------------------------------------------------------------


def true_returns_of(waves: DetectorInput, *, min_reflectance: Any = 1e-4) -> DiscreteReturns:
    """List the true echoes of waveforms. Arguments are those of `Waveforms.true_returns`."""
    check_number("min_reflectance", min_reflectance, 0.0)
    if waves.truth is None:
        raise ValueError("the waveforms have no truth: simulate them with truth=True")
    blocks = [
        _true_echoes(waves, name, np.asarray(array[shots]), shots, float(min_reflectance))
        for shots in waves.chunks
        for name, array in waves.truth.items()
    ]
    return _assemble(
        waves, {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}, None
    )


def _true_echoes(
    waves: DetectorInput, material: str, returns: np.ndarray, shots: slice, min_reflectance: float
) -> dict[str, np.ndarray]:
    """Return the columns of the echoes of one material: stretches of samples in which it returns light."""
    index = np.flatnonzero(returns > 0)
    light = returns.ravel()[index].astype(float)
    rows, samples = np.divmod(index, returns.shape[1])
    (starts,) = np.nonzero((np.diff(index, prepend=-2) != 1) | (samples == 0))
    echo = np.repeat(np.arange(starts.size), np.diff(np.r_[starts, rows.size]))
    time = waves.time[samples]

    def total(values: np.ndarray) -> np.ndarray:
        return np.bincount(echo, values, starts.size)

    reflectance = total(light)
    mean = total(light * time) / reflectance
    variance = total(light * (time - mean[echo]) ** 2) / reflectance
    shot = shots.start + rows[starts]
    if material in waves.surface_height:
        # Samples resolve the mean to a part of their length; the height of a surface is exact.
        axes, height = waves.axes, waves.surface_height[material][shot]
        # On a nearly level axis a height states no exact point.
        slope = axes.direction[shot, 2]
        is_inclined = np.abs(slope) > _LEAST_SLOPE
        rise = (height - axes.origin[shot, 2]) / np.where(is_inclined, slope, 1.0)
        exact = rise / (0.5 * SPEED_OF_LIGHT)
        mean = np.where(is_inclined & (np.abs(exact - mean) < waves.step), exact, mean)
    (listed,) = np.nonzero(reflectance >= min_reflectance)
    columns = {
        "shot": shot,
        "time": mean,
        "amplitude": reflectance * waves.constant / waves.range_at(shot, mean) ** 2,
        "width": _FWHM_OF_STD * np.sqrt(variance),
        "reflectance": reflectance,
        "material": np.full(shot.size, material),
        "ground_share": np.full(shot.size, float(material == "ground")),
    }
    return {name: values[listed] for name, values in columns.items()}


# -- waveforms in LAS --------------------------------------------------------------------------------------


def airborne_shots(
    waves: DetectorInput,
    records: Float[np.ndarray, "shots samples"],
    returns: DiscreteReturns,
    crs: str | None,
) -> Iterator[AirborneShot]:
    """Yield shots with their discrete returns and their record, in whole steps of the largest sample.

    Electronic noise may be negative: the offset of the digitiser is the lowest sample. It is the same for all
    shots, as a LAS file has at most 255 descriptions of packets.
    """
    largest = max(float(np.max(records[shots])) for shots in waves.chunks)
    if not largest > 0:
        raise ValueError("record has no sample above zero; admissible is one with light")
    offset = min(0.0, *(float(np.min(records[shots])) for shots in waves.chunks))
    gain, start = (largest - offset) / _FULL_INTENSITY, float(waves.time[0])
    first = np.searchsorted(returns.shot, np.arange(len(waves) + 1))
    intensity, classification = returns.intensity, returns.classification
    for i in range(len(waves)):
        rows = slice(first[i], first[i + 1])
        counts = np.round((np.asarray(records[i], float) - offset) / gain).astype(np.uint16)
        time = waves.acquisition.gps_time[i]
        yield AirborneShot(
            index=i,
            anchor=waves.axes.origin[i],
            direction=0.5 * SPEED_OF_LIGHT * waves.axes.direction[i],
            returning=(Segment(counts, start, waves.step, gain=gain, offset=offset),),
            gps_time=None if np.isnan(time) else float(time),
            returns=Returns(
                position=returns.position[rows],
                time=returns.time[rows],
                intensity=intensity[rows],
                number=returns.number[rows],
                count=returns.n_returns[rows],
                classification=classification[rows],
            ),
            scan_angle=float(waves.acquisition.scan_angle[i]),
            flight_line=int(waves.acquisition.flight_line[i]),
            crs=crs,
        )
