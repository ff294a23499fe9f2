"""Surveys: one lidar and many shots, each with its position and direction.

A survey stores for each shot the zenith and azimuth of the beam, and its place in one of two ways, as a
`Lidar` does: by where the beam axis meets the reference plane z = 0 and the altitude of the sensor above
that, or by the position of the sensor. A beam of the direction w from the sensor s, at the height H = s_z,
meets the reference plane at

    p = (s_x, s_y) - H (w_x, w_y) / w_z,   zenith = atan2(hypot(w_x, w_y), -w_z),   azimuth = atan2(w_x, w_y).

How a scanner on a moving platform comes to s and w is in `jaxlidar.sensors.trajectory`. Positions stay in
double precision, as map coordinates of millions of metres need.
"""

import dataclasses
import itertools
import math
import operator
from collections.abc import Iterable, Sequence
from typing import Any, SupportsFloat, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from jaxlidar._fields.checks import (
    Magnitude,
    Numbers,
    as_numpy,
    check_integer,
    check_key,
    check_kind,
    check_number,
    check_range,
    checked_array,
    concrete_array,
    concrete_number,
    kind_of,
    warn_unit,
)
from jaxlidar._fields.crs import common_system, crs_name
from jaxlidar._jax.memory import format_bytes, machine_memory
from jaxlidar._registry import shots_within
from jaxlidar._text import number_text
from jaxlidar.sensors.lidar import AIM_DISTANCE, Lidar
from jaxlidar.sensors.scan import MAX_ZENITH, STRAIGHT_UP, AbstractScan, Panorama
from jaxlidar.sensors.trajectory import Trajectory, body_rotation, rotation_matrix

# A length that falls short of a multiple of the spacing by this fraction, as by rounding, counts as the
# multiple.
_SPACING_TOLERANCE = 1e-6
# Components of unit vectors below this are rounding.
_ROUNDING = 1e-12
# Point clouds number flight lines with 16 bits.
MAX_FLIGHT_LINE = 2**16 - 1
# Bytes of a shot while a survey is made: its position and direction, and the terms of their sums.
_BYTES_PER_SHOT = 100.0
# Plausible from one pulse in two seconds.
_PULSE_RATE = Magnitude("1/s", 0.5, np.inf, {"MHz": 1e6, "kHz": 1e3})
# Fields that are known of all shots, or of none.
_OPTIONAL_ROWS = ("gps_time", "scan_angle", "attitude")
# More positions along a line than fit into any memory.
_LARGEST_COUNT = 1e30


@final
class Survey(eqx.Module):
    """Many shots of one lidar: the place and direction of each.

    `Survey.grid`, `Survey.track`, `Survey.scan` and `Survey.fly` make surveys. `len(survey)` is the number of
    shots, `survey[i]` the `Lidar` of shot i, and `survey[a:b]` the survey of some of them. Positions are kept
    in double precision.

    **Arguments:**

    - `lidar`: the `Lidar` of all shots. Its own place is not used.
    - `position`: (shots, 2) x and y in m where the beam axis meets the reference plane z = 0. Default None:
      by `sensor`.
    - `zenith`: angle between the beam and straight down in degrees, in [0, 89], or in [0, 180] with `sensor`;
      one number or (shots,). Default None: the lidar's.
    - `azimuth`: compass direction in which the beam travels in degrees, one number or (shots,). Default None:
      the lidar's.
    - `altitude`: height of the sensor above the reference plane in m, positive, one number or (shots,), with
      `position`. Default None: the lidar's.
    - `sensor`: (shots, 3) x, y and z of the sensor in m, in place of `position`: anywhere. Time zero of every
      shot is then its emission. Default None.
    - `gps_time`: (shots,) s, as point clouds have it: seconds of the GPS week, or adjusted standard GPS time
      (GPS time less 1e9 s). Default None: not known.
    - `scan_angle`: (shots,) angle of the beam to the right of the track in degrees, in [-180, 180]. Default
      None: not known.
    - `flight_line`: number of the flight line, an integer in [0, 65535], one number or (shots,). Default
      None: not known.
    - `crs`: coordinate reference system of the positions, in metres, such as "EPSG:32633", or its EPSG
      number. `Survey.fly` takes that of the trajectory. Default None: not known.
    - `attitude`: (shots, 3) roll, pitch and yaw of the platform in degrees, as those of `Trajectory`, which
      `Survey.fly` and `Survey.scan` give. Default None: not known.
    - `ellipse_turn`: as that of `Lidar`, degrees, in [-360, 360], one number or (shots,). Default None: the
      lidar's.
    - `stated`: (shots, 6) what is stated of shots by sensors where their geometry is another one: x, y and z
      of the sensor in m, zenith and azimuth in degrees, and the error of the range in m.
      `Survey.disturbed` makes it. Default None: the geometry itself.

    **Raises:** ValueError for arrays of other shapes, no shot at all, values outside their ranges, and a
    sensor together with a position or an altitude; TypeError for objects of the wrong type.

    **Example:**

    >>> import jaxlidar as jl
    >>> survey = jl.Survey(jl.Lidar(altitude=500.0), position=[(0, 0), (10, 0), (20, 0)], zenith=[0, 5, 10])
    >>> len(survey), float(survey[1].zenith), survey[1].position.tolist()
    (3, 5.0, [10.0, 0.0])
    >>> terrestrial = jl.Survey(jl.Lidar(), sensor=[(0, 0, 1.5)] * 3, zenith=[60, 90, 120], azimuth=45.0)
    >>> terrestrial[2].sensor.tolist()
    [0.0, 0.0, 1.5]
    """

    lidar: Lidar
    # (shots, 2) aim points on the reference plane, or (shots, 3) sensors.
    position: Float[np.ndarray, "shots axes"]
    zenith: Float[np.ndarray, " shots"]
    azimuth: Float[np.ndarray, " shots"]
    altitude: Float[np.ndarray, " shots"] | None
    gps_time: Float[np.ndarray, " shots"] | None
    scan_angle: Float[np.ndarray, " shots"] | None
    flight_line: Int[np.ndarray, " shots"] | None
    crs: str | None = eqx.field(static=True)
    attitude: Float[np.ndarray, "shots 3"] | None
    ellipse_turn: Float[np.ndarray, " shots"] | None
    stated: Float[np.ndarray, "shots 6"] | None

    def __init__(
        self,
        lidar: Lidar,
        position: Numbers | None = None,
        zenith: Numbers | None = None,
        azimuth: Numbers | None = None,
        altitude: Numbers | None = None,
        sensor: Numbers | None = None,
        *,
        gps_time: Numbers | None = None,
        scan_angle: Numbers | None = None,
        flight_line: Numbers | None = None,
        crs: str | int | None = None,
        attitude: Numbers | None = None,
        ellipse_turn: Numbers | None = None,
        stated: Numbers | None = None,
    ):
        self.crs = crs_name(crs)
        check_kind("lidar", lidar, Lidar, "a Lidar, as in Survey(Lidar(), position=...)")
        position = _place(lidar, position, altitude, sensor)
        shots = len(position)
        has_sensors = position.shape[1] == 3
        # Not `==`, which compares arrays.
        if altitude is None and not has_sensors:
            altitude = lidar.altitude
            if altitude is None:
                raise ValueError(
                    "position is given, but the lidar has no altitude; admissible is sensor, or altitude"
                )
        self.position = position

        def per_shot(field: str, x: Any, low: float = -np.inf, high: float = np.inf, **limits: bool) -> Any:
            return checked_array(field, x, (shots,), low, high, one_for_all=True, **limits)

        def optional_per_shot(field: str, x: Any, *limits: float) -> Any:
            return None if x is None else per_shot(field, x, *limits)

        self.altitude = None if altitude is None else per_shot("altitude", altitude, 0.0, low_open=True)
        # The lidar is of the same kind as its shots, so that these share its compiled programs.
        self.lidar = _of_kind(lidar, has_sensors)
        max_zenith = STRAIGHT_UP if has_sensors else MAX_ZENITH
        self.zenith = per_shot("zenith", lidar.zenith if zenith is None else zenith, 0.0, max_zenith)
        self.azimuth = per_shot("azimuth", lidar.azimuth if azimuth is None else azimuth)
        self.gps_time = optional_per_shot("gps_time", gps_time)
        self.scan_angle = optional_per_shot("scan_angle", scan_angle, -180.0, 180.0)
        lines = optional_per_shot("flight_line", flight_line, 0, MAX_FLIGHT_LINE)
        if lines is not None and np.any(lines != np.floor(lines)):
            raise ValueError("flight_line has values that are not whole numbers")
        self.flight_line = None if lines is None else lines.astype(int)
        self.attitude = None if attitude is None else checked_array("attitude", attitude, (shots, 3))
        self.ellipse_turn = optional_per_shot("ellipse_turn", ellipse_turn, -360.0, 360.0)
        if self.ellipse_turn is not None and lidar.level_divergence is None:
            raise ValueError("ellipse_turn is given, but the beam of lidar is round; admissible is None")
        self.stated = None if stated is None else checked_array("stated", stated, (shots, 6))
        if self.stated is not None and not has_sensors:
            raise ValueError("stated is given with position; admissible is sensor, or stated = None")

    def __len__(self) -> int:
        return len(self.position)

    def __str__(self) -> str:
        coordinates = zip("xyz", self.position.T, "mmm")
        columns = (*coordinates, ("zenith", self.zenith, ""))
        spans = ", ".join(
            f"{name} {number_text(a.min())} to {number_text(a.max())} {unit}" for name, a, unit in columns
        )
        return f"Survey of {len(self):,} shots: {spans}degrees\n{self.lidar}"

    def __getitem__(self, shot: int | slice) -> "Lidar | Survey":
        if isinstance(shot, slice):
            return self.subset(shot)
        i = self._index(shot)
        return self._lidar_at(self.position[i], i)

    def __iter__(self):
        return (self[i] for i in range(len(self)))

    def subset(self, shots: slice | Int[np.ndarray, " chosen"]) -> "Survey":
        """Return the survey of some shots: a slice, or their numbers."""

        def rows(a: np.ndarray | None) -> np.ndarray | None:
            return None if a is None else a[shots]

        names = ("zenith", "azimuth", "altitude", *_OPTIONAL_ROWS, "ellipse_turn", "flight_line", "stated")
        place = {"sensor" if self.has_sensor_position else "position": self.position[shots]}
        fields = {name: rows(getattr(self, name)) for name in names}
        return Survey(self.lidar, **place, **fields, crs=self.crs)

    def within(self, scene: Any, margin: SupportsFloat = 0.0) -> "Survey":
        """Return the survey of the shots that meet a scene, such as those of a strip over a plot.

        A scene ends where its open terrain ends, or, over ground without a border, at the box around its
        canopy with open sides and its meshes. A scene with none of these has no end, and all shots meet it.

        - On open terrain, the footprint must lie on it, as `simulate_many` asks for; of shots that are placed
          by their sensors, the beam axis must meet the terrain, or the box around canopy and meshes.
        - Elsewhere the beam axis must meet that box, and ground that has a border.

        **Arguments:**

        - `scene`: a `Scene`.
        - `margin`: m from the border of the scene, inwards, that shots must keep; where light is scattered
          many times, they miss what would stand beyond it. Negative: outwards. Default 0.

        **Returns:** a `Survey`, its shots in their order.

        **Raises:** ValueError where no shot meets the scene, and for a margin that is not finite; TypeError
        for objects of the wrong type.

        **Example:**

        >>> import numpy as np, jaxlidar as jl
        >>> plot = jl.Scene(ground=jl.Terrain(np.zeros((21, 21)), spacing=1.0, origin=(0.0, 0.0)))
        >>> strip = jl.Survey.track(jl.Lidar(), start=(-50, 10), end=(50, 10), spacing=5.0)
        >>> strip.within(plot, margin=2.0).position[:, 0].tolist()
        [5.0, 10.0, 15.0]
        """
        check_number("margin", margin)
        return self.subset(np.flatnonzero(shots_within(self, scene, float(margin))))

    def _lidar_at(self, position: Float[np.ndarray, "axes"], shot: int) -> Lidar:
        """Place the lidar at a position, in the direction of a shot."""
        angles = {name: jnp.asarray(getattr(self, name)[shot], float) for name in ("zenith", "azimuth")}
        altitude = None if self.altitude is None else jnp.asarray(self.altitude[shot], float)
        if self.ellipse_turn is not None:
            angles["ellipse_turn"] = jnp.asarray(self.ellipse_turn[shot], float)
        return dataclasses.replace(self.lidar, position=position, altitude=altitude, **angles)

    def _index(self, shot: Any) -> int:
        """Return the index of a shot from the start; negative numbers count from the end."""
        n, i = len(self), operator.index(shot)
        if not -n <= i < n:
            raise IndexError(f"shot {i}: the survey has {n}; admissible are -{n} to {n - 1}")
        return i % n

    @staticmethod
    def of(lidar: Lidar) -> "Survey":
        """Make the survey of one shot: that of a lidar in its own place and direction."""
        check_kind("lidar", lidar, Lidar, "a Lidar, as in Survey.of(Lidar())")
        place: dict[str, Any] = {
            "sensor" if lidar.has_sensor_position else "position": concrete_array(lidar.position)[None]
        }
        zenith, azimuth = concrete_number(lidar.zenith), concrete_number(lidar.azimuth)
        return Survey(lidar, **place, zenith=zenith, azimuth=azimuth)

    @staticmethod
    def join(surveys: Any) -> "Survey":
        """Join surveys of one lidar, such as flight lines, into one.

        **Arguments:** `surveys`: one or more `Survey`s, all placed by their sensors or all by their altitude.
        Their lidars are equal but for place and direction, which are those of the shots.

        **Returns:** a `Survey` of all shots in that order, each with its own `ellipse_turn`. `gps_time`,
        `scan_angle` and `attitude` are known where they are for all of the surveys, and `flight_line` is
        theirs; where one has none, it numbers the surveys from 1.

        **Raises:** ValueError for no survey, and for lidars or a `crs` that differ; TypeError for other
        objects.

        **Example:**

        >>> import jaxlidar as jl
        >>> lines = [jl.Survey.track(jl.Lidar(), (x, 0), (x, 20), 10.0) for x in (0, 30)]
        >>> survey = jl.Survey.join(lines)
        >>> len(survey), survey.flight_line.tolist()
        (6, [1, 1, 1, 2, 2, 2])
        """
        # A survey is iterable, too: its items are the lidars of its shots.
        if isinstance(surveys, Survey) or not isinstance(surveys, Iterable):
            raise TypeError(f"surveys is {kind_of(surveys)}; admissible is a sequence of Survey")
        surveys = list(surveys)
        if not surveys:
            raise ValueError("surveys is empty; admissible are one or more")
        for survey in surveys:
            check_kind("surveys", survey, Survey, "a sequence of Survey")
        first = surveys[0]
        for number, survey in enumerate(surveys):
            if not eqx.tree_equal(_at_place_of(first.lidar, survey.lidar), first.lidar):
                raise ValueError(f"surveys: the lidar of survey {number} is not that of the first")

        def rows(name: str) -> np.ndarray | None:
            arrays = [getattr(survey, name) for survey in surveys]
            return None if any(a is None for a in arrays) else np.concatenate(arrays)

        fields = {name: rows(name) for name in ("zenith", "azimuth", "altitude", *_OPTIONAL_ROWS)}
        if first.lidar.level_divergence is not None:
            fields["ellipse_turn"] = np.concatenate([survey._turn_of_ellipse for survey in surveys])
        if any(survey.stated is not None for survey in surveys):
            fields["stated"] = np.concatenate([survey.stated_rows for survey in surveys])
        crs = common_system({f"surveys[{i}]": survey.crs for i, survey in enumerate(surveys)})
        place = {"sensor" if first.has_sensor_position else "position": rows("position")}
        flight_line = rows("flight_line")
        if flight_line is None:
            flight_line = np.repeat(np.arange(1, len(surveys) + 1), [len(survey) for survey in surveys])
        return Survey(first.lidar, **place, **fields, flight_line=flight_line, crs=crs)

    @property
    def has_sensor_position(self) -> bool:
        """True if shots are placed by their sensors, and time zero is the emission."""
        return self.altitude is None

    @property
    def aim_position(self) -> Float[np.ndarray, "shots 2"] | None:
        """The argument `position` that makes this survey; None where that is `sensor`."""
        return None if self.has_sensor_position else self.position

    @property
    def sensor_position(self) -> Float[np.ndarray, "shots 3"] | None:
        """The argument `sensor` that makes this survey; None where that is `position`."""
        return self.position if self.has_sensor_position else None

    @property
    def middle(self) -> Lidar:
        """`Lidar` in the middle of all positions, in the direction of the largest zenith angle."""
        middle = 0.5 * (self.position.min(axis=0) + self.position.max(axis=0))
        return self._lidar_at(middle, int(np.argmax(self.zenith)))

    def relative_to(self, origin: Float[np.ndarray, "2"]) -> "Survey":
        """Make the same survey with positions relative to `origin`, (2,) x and y in m."""
        origin = checked_array("origin", origin, (2,))
        shift = np.pad(origin, (0, self.position.shape[1] - 2))
        moved = eqx.tree_at(lambda s: s.position, self, self.position - shift)
        if self.stated is None:
            return moved
        return eqx.tree_at(lambda s: s.stated, moved, self.stated - np.pad(origin, (0, 4)))

    def disturbed(
        self,
        *,
        boresight: Numbers = (0.0, 0.0, 0.0),
        position: Numbers = 0.0,
        attitude: Numbers = 0.0,
        range: SupportsFloat = 0.0,
        key: PRNGKeyArray | None = None,
    ) -> "Survey":
        """Make a survey whose beams are not where it states that they are, so that strips disagree.

        Light goes where the true geometry leads, which is that of the survey that is returned. Results have
        the stated geometry, which is that of this survey: positions of returns, files, and
        `Waveforms.position`. Errors of position and attitude are drawn for each number of a flight line and
        stay the same along it; those of ranges, for each shot. With the rotation R(a) of the platform at the
        attitude a, the error e of that, the boresight error B and the position error d, a stated beam w of
        the sensor s travels along R(a + e) B R(a)^T w from s + d.

        **Arguments:**

        - `boresight`: (roll, pitch, yaw) in degrees by which the scanner is turned in the body of the
          platform beyond its stated mounting. Default (0, 0, 0).
        - `position`: standard deviation in m of the sensor's position, one number, or three: east, north and
          up; not negative. Default 0.
        - `attitude`: standard deviation in degrees, one number, or three: roll, pitch and yaw; not negative.
          Default 0.
        - `range`: standard deviation of measured ranges in m, not negative. Default 0.
        - `key`: a JAX random key, with any of these deviations. Default None: none of them.

        **Returns:** a `Survey` that is placed by its sensors, so that time zero is the emission.

        **Raises:** ValueError for values outside their ranges, deviations without a key, and a boresight or
        an attitude where the survey has no `attitude`; TypeError for objects of the wrong type.

        **Source:** Skaloud and Lichti (2006), ISPRS J. Photogramm. Remote Sens. 61, 47, equation 1.

        **Example:** a roll of 0.1 degrees, right wing down, turns a beam from 60 m to the left.

        >>> import jaxlidar as jl
        >>> flight = jl.Trajectory([0.0, 1.0], [(0, 0, 60), (0, 5, 60)])
        >>> drone = jl.Lidar(sensor=(0, 0, 0))
        >>> strip = jl.Survey.fly(flight, jl.Conical(half_angle=1e-6, frequency=1.0), lidar=drone)
        >>> true = strip.disturbed(boresight=(0.1, 0.0, 0.0))
        >>> print(jl.ground_position(true, jl.Scene(ground=jl.Ground()))[0, :2].round(3))
        [-0.105  0.   ]
        """
        turn = checked_array("boresight", boresight, (3,))
        deviations = {
            name: checked_array(name, x, (3,), 0.0, one_for_all=True)
            for name, x in (("position", position), ("attitude", attitude))
        }
        check_number("range", range, 0.0)
        is_random = float(range) > 0 or any(deviation.any() for deviation in deviations.values())
        if is_random and key is None:
            raise ValueError("key is None, but errors are to be drawn; admissible is a JAX random key")
        turns = bool(turn.any() or deviations["attitude"].any())
        if turns and self.attitude is None:
            raise ValueError(
                "boresight or attitude is given, but the survey has no attitude; admissible is one that "
                "Survey.fly or Survey.scan makes, or the argument attitude of Survey"
            )
        shots = len(self)
        error: dict[str, Any] = dict.fromkeys(deviations, 0.0)
        range_error = np.zeros(shots)
        if key is not None:
            check_key(key)
            seed = np.asarray(jax.random.bits(key, (8,), np.uint32))
            of_lines, of_shots = np.random.default_rng(seed).spawn(2)
            # By the number of the line: it has the same errors whichever other lines there are.
            lines = np.zeros(shots, int) if self.flight_line is None else self.flight_line
            draws = of_lines.normal(size=(lines.max() + 1, len(deviations), 3))[lines]
            error = {name: d * draws[:, i] for i, (name, d) in enumerate(deviations.items())}
            range_error = float(range) * of_shots.normal(size=shots)
        zenith, azimuth, ellipse_turn = self.zenith, self.azimuth, self.ellipse_turn
        if turns:
            assert self.attitude is not None
            to_body = body_rotation(*self.attitude.T)
            true_rotation = body_rotation(*(self.attitude + error["attitude"]).T)
            rotation = np.einsum("sij,jk,slk->sil", true_rotation, rotation_matrix(*turn), to_body)
            zenith, azimuth = beam_angles(np.einsum("sij,sj->si", rotation, self.direction))
            if self.lidar.level_divergence is not None:
                level_axis = np.einsum("sij,sj->si", rotation, self._axes_of_ellipse[1])
                ellipse_turn = _turn_about_beam(zenith, azimuth, level_axis)
        stated = self.stated_rows
        stated[:, 5] += range_error
        names = (*_OPTIONAL_ROWS, "flight_line")
        return Survey(
            self.lidar,
            sensor=self.sensor + error["position"],
            zenith=zenith,
            azimuth=azimuth,
            **{name: getattr(self, name) for name in names},
            crs=self.crs,
            ellipse_turn=ellipse_turn,
            stated=stated,
        )

    @property
    def stated_rows(self) -> Float[np.ndarray, "shots 6"]:
        """The argument `stated`; where it is None, the survey's own geometry."""
        if self.stated is not None:
            return self.stated.copy()
        return np.column_stack([self.sensor, self.zenith, self.azimuth, np.zeros(len(self))])

    @property
    def direction(self) -> Float[np.ndarray, "shots 3"]:
        """Unit vectors (shots, 3) in which the beams travel."""
        return beam_directions(self.zenith, self.azimuth)

    @property
    def slant_range(self) -> Float[np.ndarray, " shots"]:
        """Distances (shots,) in m from the sensor to the aim point, as `Lidar.range_to_reference`."""
        if self.altitude is None:
            return np.full(len(self), AIM_DISTANCE)
        return self.altitude / np.cos(np.deg2rad(self.zenith))

    @property
    def aim_point(self) -> Float[np.ndarray, "shots 3"]:
        """Points (shots, 3) in m as `Lidar.aim_point`: on the reference plane, or 1 m ahead of the sensor."""
        if self.has_sensor_position:
            return self.position + AIM_DISTANCE * self.direction
        return np.pad(self.position, ((0, 0), (0, 1)))

    @property
    def sensor(self) -> Float[np.ndarray, "shots 3"]:
        """Positions (shots, 3) of the sensor in m."""
        if self.has_sensor_position:
            return self.position
        return self.aim_point - self.slant_range[:, None] * self.direction

    @property
    def footprint_radius(self) -> Float[np.ndarray, " shots"]:
        """Radii (shots,) in m of the beams at the aim point, as `Lidar.footprint_radius`."""
        return self.slant_range * concrete_number(self.lidar.largest_divergence) * 0.5e-3

    @property
    def footprint_axes(self) -> tuple[Float[np.ndarray, "shots 3"], Float[np.ndarray, "shots 3"]]:
        """Semi-axes (shots, 3) of footprints over `footprint_radius`: those of `divergence`, then the others.

        Unless ellipses are turned, the first lie in the vertical planes of beams, and the others are level.
        """
        ratios = [1.0, 1.0] if self.lidar.ellipse is None else map(concrete_number, self.lidar.ellipse)
        first, second = (ratio * axis for ratio, axis in zip(ratios, self._axes_of_ellipse))
        return first, second

    @property
    def level_footprint_axes(self) -> tuple[Float[np.ndarray, "shots 2"], Float[np.ndarray, "shots 2"]]:
        """The radii `footprint_axes` projected along the beams onto a level plane, (shots, 2) each.

        Of beams less than a degree from the level, onto a plane that such a beam meets at one degree.
        """
        direction = self.direction
        least = np.cos(np.deg2rad(MAX_ZENITH))
        down = np.copysign(np.maximum(np.abs(direction[:, 2:]), least), direction[:, 2:])
        first, second = (a[:, :2] - a[:, 2:] / down * direction[:, :2] for a in self.footprint_axes)
        return first, second

    @property
    def _turn_of_ellipse(self) -> Float[np.ndarray, " shots"]:
        """The argument `ellipse_turn`; where it is None, that of the lidar, zero for round beams."""
        if self.ellipse_turn is not None:
            return self.ellipse_turn
        turn = self.lidar.ellipse_turn
        return np.full(len(self), 0.0 if turn is None else concrete_number(turn))

    @property
    def _axes_of_ellipse(self) -> tuple[Float[np.ndarray, "shots 3"], Float[np.ndarray, "shots 3"]]:
        """Unit vectors along which `divergence` and `level_divergence` lie."""
        vertical, level = _axes_across(self.zenith, self.azimuth)
        turn = np.deg2rad(self._turn_of_ellipse)[:, None]
        return np.cos(turn) * vertical + np.sin(turn) * level, np.cos(turn) * level - np.sin(turn) * vertical

    @staticmethod
    def grid(
        lidar: Lidar,
        low: Numbers,
        high: Numbers,
        spacing: Numbers,
        *,
        crs: str | int | None = None,
    ) -> "Survey":
        """Make a survey of a regular grid of footprints, row after row from the south-west.

        **Arguments:**

        - `lidar`: the `Lidar` of all shots.
        - `low`: (x, y) of the first footprint in m.
        - `high`: (x, y) of the opposite corner, m, not below `low`. No footprint lies beyond it.
        - `spacing`: m between neighbours, positive, one number or (along x, along y).
        - `crs`: coordinate reference system, as that of `Survey`. Default None: not known.

        **Returns:** a `Survey`; along each axis it has one footprint at `low` and as many more as fit.

        **Raises:** ValueError for values outside their ranges, other shapes, and more shots than memory has
        room for; TypeError for arguments that are not numbers.

        **Example:**

        >>> import jaxlidar as jl
        >>> survey = jl.Survey.grid(jl.Lidar(), low=(0, 0), high=(20, 10), spacing=10.0)
        >>> survey.position.tolist()
        [[0.0, 0.0], [10.0, 0.0], [20.0, 0.0], [0.0, 10.0], [10.0, 10.0], [20.0, 10.0]]
        """
        first, last = checked_array("low", low, (2,)), checked_array("high", high, (2,))
        step = checked_array("spacing", spacing, (2,), 0.0, one_for_all=True, low_open=True)
        if np.any(last < first):
            raise ValueError(f"high = {last.tolist()} lies below low = {first.tolist()}")
        counts = [_count_along(float(last[k] - first[k]), float(step[k])) for k in range(2)]
        _check_number_of_shots(f"spacing = {step.tolist()}", counts[0] * counts[1])
        x, y = (first[k] + step[k] * np.arange(counts[k]) for k in range(2))
        return Survey(lidar, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2), crs=crs)

    @staticmethod
    def track(
        lidar: Lidar,
        start: Numbers,
        end: Numbers,
        spacing: SupportsFloat,
        *,
        beams: int = 1,
        beam_spacing: SupportsFloat = 600.0,
        crs: str | int | None = None,
    ) -> "Survey":
        """Make a survey of footprints along a line, of one beam or of several side by side as GEDI has.

        **Arguments:**

        - `lidar`: the `Lidar` of all shots.
        - `start`, `end`: (x, y) in m of the first footprint and of the end of the track. With several beams,
          the track is their middle line.
        - `spacing`: m between footprints along the track, positive; GEDI's are 60 m.
        - `beams`: number of beams, at least 1. Default 1; GEDI has 8.
        - `beam_spacing`: m between beams across the track, positive. Default 600, GEDI's.
        - `crs`: coordinate reference system, as that of `Survey`. Default None: not known.

        **Returns:** a `Survey`: all footprints of the leftmost beam first, then those of the next.

        **Raises:** ValueError for values outside their ranges, a line without length, and more shots than
        memory has room for; TypeError for arguments that are not numbers.

        **Example:**

        >>> import jaxlidar as jl
        >>> line = {"start": (0, 0), "end": (0, 120), "spacing": 60.0}
        >>> survey = jl.Survey.track(jl.Lidar(), **line, beams=2, beam_spacing=10.0)
        >>> survey.position.tolist()
        [[-5.0, 0.0], [-5.0, 60.0], [-5.0, 120.0], [5.0, 0.0], [5.0, 60.0], [5.0, 120.0]]
        """
        first, forward, right, length = _line(start, end)
        check_number("spacing", spacing, 0.0, low_open=True)
        check_number("beam_spacing", beam_spacing, 0.0, low_open=True)
        count = check_integer("beams", beams)
        count_along = _count_along(length, float(spacing))
        _check_number_of_shots(f"spacing = {float(spacing):g} with beams = {count}", count_along * count)
        along = float(spacing) * np.arange(count_along)
        across = float(beam_spacing) * (np.arange(count) - 0.5 * (count - 1))
        positions = first + across[:, None, None] * right + along[None, :, None] * forward
        return Survey(lidar, positions.reshape(-1, 2), crs=crs)

    @staticmethod
    def scan(
        lidar: Lidar,
        pattern: AbstractScan,
        start: Numbers | None = None,
        end: Numbers | None = None,
        speed: SupportsFloat | None = None,
        pulse_rate: SupportsFloat | None = None,
        *,
        gps_time: SupportsFloat = 0.0,
        flight_line: int = 1,
        crs: str | int | None = None,
    ) -> "Survey":
        """Make a survey of the shots of a scanner on a level platform that flies along a line.

        The platform flies at the lidar's altitude above the reference plane. Zenith, azimuth and scan angle
        (across the track, positive to the right) follow from the pattern. A lidar that is placed by its
        sensor stands there, as on a tripod that looks north, and scans a `Panorama`.

        **Arguments:**

        - `lidar`: the `Lidar` of all shots. Its own direction is not used; an ellipse keeps its place in the
          scanner (`AbstractScan.level_axis`), turned by its own `ellipse_turn`.
        - `pattern`: an `Oscillating`, a `RotatingPolygon`, a `Conical`, or another `AbstractScan`.
        - `start`, `end`: (x, y) in m of the platform at the first shot and at the end of the line.
        - `speed`: of the platform in m/s, positive.
        - `pulse_rate`: shots per s, positive. A scanner that stands still takes none of these four.
        - `gps_time`: GPS time of the first shot in s, as that of `Survey`. Default 0.
        - `flight_line`: number of the flight line. Default 1.
        - `crs`: coordinate reference system, as that of `Survey`. Default None: not known.

        **Returns:** a `Survey`, its shots in the order of time.

        **Raises:** ValueError for values outside their ranges, a line without length, more shots than memory
        has room for, and a pattern that looks more than 89 degrees from the vertical; TypeError for objects
        of the wrong type.

        **Example:**

        >>> import jaxlidar as jl
        >>> line = {"start": (0, 0), "end": (0, 100), "speed": 50.0, "pulse_rate": 1000.0}
        >>> survey = jl.Survey.scan(jl.Lidar(), jl.Conical(half_angle=20.0, frequency=40.0), **line)
        >>> print(len(survey), survey.zenith[:2].round(3).tolist())
        2001 [20.0, 20.0]
        >>> tripod = jl.Lidar(sensor=(0.0, 0.0, 1.7))
        >>> len(jl.Survey.scan(tripod, jl.Panorama(zenith=(30.0, 150.0), step=10.0)))
        468
        """
        check_kind(
            "pattern", pattern, AbstractScan, "a scan pattern, as in Conical(half_angle=20, frequency=40)"
        )
        check_kind("lidar", lidar, Lidar, "a Lidar, as in Survey.scan(Lidar(), ...)")
        check_number("gps_time", gps_time)
        flown = {"start": start, "end": end, "speed": speed, "pulse_rate": pulse_rate}
        if lidar.altitude is None:
            return _station(lidar, pattern, flown, float(gps_time), flight_line, crs)
        for field, value in flown.items():
            if value is None:
                raise ValueError(
                    f"{field} is None; admissible is that of a line, or a lidar that stands still, "
                    "lidar.at(...)"
                )
        if isinstance(pattern, Panorama):
            raise ValueError(
                "pattern is a Panorama, but lidar has an altitude and flies; admissible is a lidar that "
                "stands still, lidar.at(...), or another pattern"
            )
        first, forward, _, length = _line(start, end)
        check_number("speed", speed, 0.0, low_open=True)
        check_number("pulse_rate", pulse_rate, 0.0, low_open=True)
        warn_unit("pulse_rate", pulse_rate, _PULSE_RATE)
        assert speed is not None
        assert pulse_rate is not None
        shots = _count_along(length, float(speed) / float(pulse_rate))
        rate = f"pulse_rate = {float(pulse_rate):g} at speed = {float(speed):g}"
        _check_number_of_shots(rate, shots)
        # A level and straight flight: the last shot may lie beyond the end of the line by rounding.
        duration = max(length / float(speed), (shots - 1) / float(pulse_rate), 1.0 / float(pulse_rate))
        ends = np.stack([first, first + float(speed) * duration * forward])
        position = np.pad(ends, ((0, 0), (0, 1)), constant_values=float(lidar.altitude))
        yaw = np.rad2deg(np.arctan2(forward[0], forward[1]))
        flight = Trajectory([0.0, duration], position, yaw=yaw, crs=crs)
        time = np.arange(shots) / float(pulse_rate)
        survey = _strip(lidar, flight.at(time), pattern, flight_line)
        # Added last: GPS times of 3e8 s leave the times since the first shot fewer digits.
        return eqx.tree_at(lambda s: s.gps_time, survey, float(gps_time) + time)

    @staticmethod
    def fly(
        trajectory: Trajectory | Sequence[Trajectory],
        scan: AbstractScan | None = None,
        *,
        lidar: Lidar | None = None,
        pulse_rate: SupportsFloat | None = None,
        mounting: Numbers = (0.0, 0.0, 0.0),
        lever_arm: Numbers = (0.0, 0.0, 0.0),
        above: Any = None,
    ) -> "Survey":
        """Make a survey of the shots of a scanner on a platform that moves along a trajectory.

        The place of the lidar follows from the trajectory. A lidar with an altitude must look down from above
        the reference plane at every shot, and time zero is that of the plane; with a `sensor` it may look
        anywhere, and time zero is the emission (see `Lidar`).

        **Arguments:**

        - `trajectory`: a `Trajectory`, or a sequence of them: strips, which are joined. Its times are GPS
          times, as those of `Survey`, if they are to be those of a point cloud.
        - `scan`: an `Oscillating`, a `RotatingPolygon`, a `Conical`, or another `AbstractScan`, in the frame
          of the scanner. Its time is that since the start of the strip. Default None: `lidar.scan`.
        - `lidar`: the `Lidar` of all shots. Its own place and direction are not used; an ellipse keeps its
          place in the scanner (`AbstractScan.level_axis`), turned by its own `ellipse_turn`. Default None:
          `Lidar()`.
        - `pulse_rate`: shots per s, positive, from the start of each strip to its end. Default None: one shot
          at each time of the trajectory.
        - `mounting`: (roll, pitch, yaw) in degrees that turn the scanner into the body of the platform
          (boresight angles); or (channels, 3), for an instrument of several channels that fly together, such
          as [(0, 0, 14), (0, 0, -14)] for the crossed lines of the RIEGL VQ-1560i. Default (0, 0, 0).
        - `lever_arm`: (forward, right, down) in m from the trajectory's position to the sensor, in the frame
          of the body. Default (0, 0, 0).
        - `above`: a `Terrain`: heights of the trajectory are then above that, and not above z = 0. Default
          None.

        **Returns:** a `Survey`, its shots in the order of time within each strip, with `gps_time`, the time
        of the trajectory, `scan_angle`, and `flight_line`, which numbers the strips from 1: all those of the
        first channel, then those of the next.

        **Raises:** ValueError for values outside their ranges, no scan pattern, more shots than memory has
        room for, more than 65535 strips, a position off the terrain, and shots that look up, or more than 89
        degrees from the vertical, or from below the reference plane, with a lidar that has an altitude;
        TypeError for objects of the wrong type.

        **Source:** see `jaxlidar.sensors.trajectory` for the rotations.

        **Example:** a wing of 10 degrees down turns a beam straight down to the left.

        >>> import jaxlidar as jl
        >>> flight = jl.Trajectory([0.0, 1.0], [(0, 0, 500), (0, 60, 500)], roll=10.0)
        >>> survey = jl.Survey.fly(flight, jl.Conical(half_angle=1e-6, frequency=1.0), pulse_rate=1.0)
        >>> survey.zenith.round(3).tolist(), survey.azimuth.round(1).tolist()
        ([10.0, 10.0], [270.0, 270.0])
        """
        lidar = Lidar() if lidar is None else lidar
        check_kind("lidar", lidar, Lidar, "a Lidar, as in Survey.fly(..., lidar=Lidar())")
        scan = lidar.scan if scan is None else scan
        if scan is None:
            raise ValueError(
                "scan is None, and the lidar has none; admissible is a scan pattern, or lidar.scan"
            )
        check_kind("scan", scan, AbstractScan, "a scan pattern, as in Conical(half_angle=20, frequency=40)")
        strips = [trajectory] if isinstance(trajectory, Trajectory) else list(trajectory)
        if not strips:
            raise ValueError("trajectory is empty; admissible is a Trajectory, or one or more in a sequence")
        for strip in strips:
            check_kind("trajectory", strip, Trajectory, "a Trajectory, or a sequence of them")
        if pulse_rate is not None:
            check_number("pulse_rate", pulse_rate, 0.0, low_open=True)
            warn_unit("pulse_rate", pulse_rate, _PULSE_RATE)
        angles = as_numpy(mounting, "mounting")
        if angles.ndim not in (1, 2) or angles.shape[-1] != 3 or angles.size == 0:
            raise ValueError(f"mounting has shape {angles.shape}; admissible is (3,) or (channels, 3)")
        turns = [rotation_matrix(*checked_array("mounting", row, (3,))) for row in np.atleast_2d(angles)]
        arm = checked_array("lever_arm", lever_arm, (3,))
        durations = [float(strip.time[-1] - strip.time[0]) for strip in strips]
        if pulse_rate is not None:
            counts = [_count_along(duration, 1.0 / float(pulse_rate)) for duration in durations]
            _check_number_of_shots(f"pulse_rate = {float(pulse_rate):g}", len(turns) * sum(counts))
            strips = [
                strip.at(np.minimum(strip.time[0] + np.arange(count) / float(pulse_rate), strip.time[-1]))
                for strip, count in zip(strips, counts)
            ]
        if above is not None:
            strips = [_lifted(strip, above) for strip in strips]
        return Survey.join(
            _strip(lidar, strip, scan, number, turn, arm)
            for number, (turn, strip) in enumerate(itertools.product(turns, strips), 1)
        )


def _lifted(flight: Trajectory, terrain: Any) -> Trajectory:
    """Return a trajectory whose heights are above a terrain as one whose heights are above z = 0."""
    if not callable(getattr(terrain, "height_at", None)):
        raise TypeError(f"above is a {type(terrain).__name__}; admissible is a Terrain, or None")
    crs = common_system({"trajectory": flight.crs, "above": getattr(terrain, "crs", None)})
    ground = np.asarray(terrain.height_at(flight.position[:, 0], flight.position[:, 1]), float)
    lifted = flight.position + np.pad(ground[:, None], ((0, 0), (2, 0)))
    return dataclasses.replace(flight, position=lifted, crs=crs)


def _station(
    lidar: Lidar,
    pattern: AbstractScan,
    flown: dict[str, Any],
    gps_time: float,
    flight_line: int,
    crs: str | int | None,
) -> Survey:
    """Return the survey of a scanner that stands at the lidar's sensor, level, and looks north."""
    for field, value in flown.items():
        if value is not None:
            raise ValueError(
                f"{field} is given, but lidar is placed by its sensor and stands still; admissible is an "
                "altitude, or Survey.fly"
            )
    if not isinstance(pattern, Panorama):
        raise ValueError(
            f"pattern is {kind_of(pattern)}, but lidar is placed by its sensor and stands still; admissible "
            "is a Panorama, or Survey.fly with a trajectory of two times in one place"
        )
    lines, shots = pattern.shape
    _check_number_of_shots(f"step = {pattern.step}", lines * shots)
    time = pattern.time
    place = np.broadcast_to(concrete_array(lidar.position), (time.size, 3))
    survey = _strip(lidar, Trajectory(time, place, yaw=0.0, crs=crs), pattern, flight_line)
    return eqx.tree_at(lambda s: s.gps_time, survey, gps_time + time)


def _strip(
    lidar: Lidar,
    flight: Trajectory,
    pattern: AbstractScan,
    flight_line: Any,
    scanner_turn: Float[np.ndarray, "3 3"] | None = None,
    lever_arm: Float[np.ndarray, "3"] | None = None,
) -> Survey:
    """Return the survey of one strip, with one shot at each time of the trajectory.

    1. Directions in the frame of the scanner, turned into that of the body, and into east, north and up.
    2. The sensors, off the trajectory by the lever arm.
    3. Zenith, azimuth and scan angle; where beams meet the reference plane, for a lidar with an altitude.
    4. The turn of an elliptical footprint about each beam.
    """
    time, turn, sensor = flight.time - flight.time[0], flight.rotation, flight.position

    def to_map(vectors: Float[np.ndarray, "shots 3"]) -> Float[np.ndarray, "shots 3"]:
        in_body = vectors if scanner_turn is None else vectors @ scanner_turn.T
        return np.einsum("sij,sj->si", turn, in_body)

    direction = to_map(np.asarray(pattern.direction(time), float))
    if lever_arm is not None:
        sensor = sensor + turn @ lever_arm
    east, north, up = direction.T
    zenith, azimuth = beam_angles(direction)
    # Positive to the right of the platform's heading. A level beam along it has none, and no rounding either.
    yaw = np.deg2rad(flight.yaw)
    right = east * np.cos(yaw) - north * np.sin(yaw)
    is_along = np.hypot(right, up) < _ROUNDING
    scan_angle = np.where(is_along, 0.0, np.rad2deg(np.arctan2(right, -up)))
    order: dict[str, Any] = {"gps_time": flight.time, "scan_angle": scan_angle, "flight_line": flight_line}
    order |= {"crs": flight.crs, "attitude": np.stack([flight.roll, flight.pitch, flight.yaw], axis=1)}
    if lidar.level_divergence is not None:
        assert lidar.ellipse_turn is not None
        level_axis = pattern.level_axis(time)
        level_axis = checked_array("level_axis of the scan pattern", level_axis, (len(time), 3))
        turn_of_lidar = concrete_number(lidar.ellipse_turn)
        order["ellipse_turn"] = (
            _turn_about_beam(zenith, azimuth, to_map(level_axis)) + turn_of_lidar
        ) % 180.0
    if lidar.has_sensor_position:
        return Survey(lidar, sensor=sensor, zenith=zenith, azimuth=azimuth, **order)
    # A pattern at the limit may exceed it by rounding.
    if not np.all(zenith <= MAX_ZENITH + 1e-9):
        raise ValueError(
            f"pattern looks {float(np.max(zenith)):g} degrees from the vertical; admissible is "
            f"[0, {MAX_ZENITH:g}], or a lidar with a sensor"
        )
    if not np.all(sensor[:, 2] > 0):
        raise ValueError(
            f"position: the sensor is at z = {float(np.min(sensor[:, 2])):g} m; admissible is above the "
            "reference plane z = 0, or a lidar with a sensor"
        )
    aim = sensor[:, :2] - sensor[:, 2:] * direction[:, :2] / up[:, None]
    return Survey(lidar, aim, np.minimum(zenith, MAX_ZENITH), azimuth, sensor[:, 2], **order)


def beam_angles(direction: Float[np.ndarray, "shots 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the zenith and azimuth in degrees of unit vectors, the inverse of `beam_directions`."""
    east, north, up = direction.T
    sine = np.hypot(east, north)
    azimuth = np.rad2deg(np.arctan2(east, north)) % 360.0
    # A remainder of a small negative angle is rounded to 360.
    azimuth = np.where((sine > 0) & (azimuth < 360.0), azimuth, 0.0)
    return np.rad2deg(np.arctan2(sine, -up)), azimuth


def beam_directions(
    zenith: Float[np.ndarray, " shots"], azimuth: Float[np.ndarray, " shots"]
) -> Float[np.ndarray, "shots 3"]:
    """Compute the unit vectors of beams from zenith and azimuth in degrees."""
    zenith, azimuth = np.deg2rad(zenith), np.deg2rad(azimuth)
    horizontal = np.sin(zenith)
    return np.stack([horizontal * np.sin(azimuth), horizontal * np.cos(azimuth), -np.cos(zenith)], axis=-1)


def _axes_across(
    zenith: Float[np.ndarray, " shots"], azimuth: Float[np.ndarray, " shots"]
) -> tuple[Float[np.ndarray, "shots 3"], Float[np.ndarray, "shots 3"]]:
    """Return unit vectors across beams: in the vertical plane, upwards; and level, to the right."""
    zenith, azimuth = np.deg2rad(zenith), np.deg2rad(azimuth)
    sin, cos = np.sin(azimuth), np.cos(azimuth)
    vertical = np.stack([np.cos(zenith) * sin, np.cos(zenith) * cos, np.sin(zenith)], axis=-1)
    return vertical, np.stack([cos, -sin, np.zeros_like(sin)], axis=-1)


def _turn_about_beam(
    zenith: Float[np.ndarray, " shots"],
    azimuth: Float[np.ndarray, " shots"],
    level_axis: Float[np.ndarray, "shots 3"],
) -> Float[np.ndarray, " shots"]:
    """Return by how many degrees ellipses are turned with `level_divergence` along these vectors.

    Zero where a vector lies along its beam.
    """
    upward, aside = (np.sum(axis * level_axis, axis=1) for axis in _axes_across(zenith, azimuth))
    is_along = np.hypot(upward, aside) <= 1e-9 * np.linalg.norm(level_axis, axis=1)
    # An ellipse is the same after half a turn.
    return np.where(is_along, 0.0, np.rad2deg(np.arctan2(-upward, aside)) % 180.0)


def _place(lidar: Lidar, position: Any, altitude: Any, sensor: Any) -> Float[np.ndarray, "shots axes"]:
    """Return aim points or sensors of all shots; refuse both, and neither."""
    if sensor is not None:
        for field, value in (("position", position), ("altitude", altitude)):
            if value is not None:
                raise ValueError(f"{field} is given together with sensor; admissible is one of them")
    elif position is None:
        raise ValueError("neither position nor sensor is given; admissible is one of them")
    field, value, size = ("position", position, 2) if sensor is None else ("sensor", sensor, 3)
    check_range(field, value)
    positions = as_numpy(value, field)
    if positions.ndim != 2 or positions.shape[1] != size or len(positions) == 0:
        hint = "; places of sensors are sensor=" if size == 2 and positions.shape[1:] == (3,) else ""
        raise ValueError(
            f"{field} has shape {positions.shape}; admissible is (shots, {size}), one shot or more{hint}"
        )
    return positions


def _at_place_of(place: Lidar, lidar: Lidar) -> Lidar:
    """Return a lidar in the place and direction of another; as it is where these are of different kinds."""
    if lidar.has_sensor_position != place.has_sensor_position:
        return lidar
    fields = ["position", "altitude", "zenith", "azimuth"]
    if lidar.level_divergence is not None and place.level_divergence is not None:
        fields.append("ellipse_turn")
    return dataclasses.replace(lidar, **{name: getattr(place, name) for name in fields})


def _of_kind(lidar: Lidar, has_sensors: bool) -> Lidar:
    """Return the lidar as one that is placed by its sensor, or by its altitude."""
    if lidar.has_sensor_position == has_sensors:
        return lidar
    # The angles of shots take the place of the lidar's, which may not be admissible for the other kind.
    if has_sensors:
        return lidar.at(concrete_array(lidar.sensor), zenith=0.0)
    return dataclasses.replace(lidar, position=(0.0, 0.0), altitude=1000.0, zenith=0.0)


def _line(start: Any, end: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return the start, the unit vectors forward and to the right, and the length of a line."""
    first, last = checked_array("start", start, (2,)), checked_array("end", end, (2,))
    length = float(np.hypot(*(last - first)))
    if not length > 0:
        raise ValueError(f"end = {last.tolist()} is start; admissible is a line with a length")
    forward = (last - first) / length
    return first, forward, np.array([forward[1], -forward[0]]), length


def _count_along(length: float, step: float) -> int:
    """Count the positions that lie `step` apart on a line of a given length, including its start."""
    # A step that underflows in the division counts as one that no memory has room for.
    steps = min(length / step, _LARGEST_COUNT) if step > 0 else _LARGEST_COUNT
    return math.floor(steps * (1 + _SPACING_TOLERANCE) + _SPACING_TOLERANCE) + 1


def _check_number_of_shots(cause: str, shots: int) -> None:
    """Refuse a survey that does not fit into memory. `cause`: the arguments that ask for the shots."""
    memory = machine_memory()
    if shots * _BYTES_PER_SHOT > memory:
        raise ValueError(
            f"{cause} asks for {shots:.3g} shots, which take about {format_bytes(shots * _BYTES_PER_SHOT)} "
            f"of memory; admissible are at most {memory / _BYTES_PER_SHOT:.3g} in the "
            f"{format_bytes(memory)} of this machine"
        )
