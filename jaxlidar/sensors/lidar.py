"""The lidar: sensor position, beam, pulse and receiver.

Axes: x east, y north, z up; the reference plane is z = 0. With the zenith angle theta and the compass azimuth
phi in which light travels, the unit vector of the beam is

    w = (sin(theta) sin(phi), sin(theta) cos(phi), -cos(theta)).

A lidar is placed in one of two ways.

**By its altitude** (`altitude` and `position`), above the scene. The beam axis meets the reference plane at
p = (x, y, 0), `position`. At the altitude H the slant range is R = H / cos(theta), the sensor stands at
p - R w, and the footprint, perpendicular to the beam, has the radius R gamma / 2 for the full divergence
gamma. Time zero of every waveform is the two-way travel time 2 R / c to p, not the emission: at the altitude
of a satellite, absolute times in single precision would be off by 0.1 ns.

**By its sensor** (`sensor`), anywhere, and looking anywhere. Time zero is the emission at the sensor s, so
that light of order one that arrives at the time t comes from the range r = c t / 2. The energy of a return of
the apparent reflectance rho is E eta A rho / (pi r^2) with its own range r, as for any lidar. The "aim point"
is then the point s + w, 1 m ahead of the sensor: widths of the beam are stated there.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxlidar._fields.checks import (
    Magnitude,
    as_array,
    as_optional_scalar,
    as_scalar,
    check_choice,
    check_kind,
    concrete,
    coordinates,
)
from jaxlidar._fields.ranges import (
    COMPASS,
    DEGREES,
    NANOMETRES,
    NANOSECONDS,
    NOT_NEGATIVE,
    POSITIVE,
    WAVELENGTHS,
    Range,
    check_ranges,
    quantity,
)
from jaxlidar._text import object_text
from jaxlidar.sensors.photon_counter import PhotonCounter
from jaxlidar.sensors.pulse import AbstractPulse, GaussianPulse
from jaxlidar.sensors.receiver import Receiver
from jaxlidar.sensors.scan import MAX_ZENITH, STRAIGHT_UP, AbstractScan

# Distance, m, from a sensor that is given by its position to its aim point, the origin of traced coordinates.
AIM_DISTANCE = 1.0
# Largest divergence, mrad: beyond, a beam's irradiance is no longer that of a disc across its axis.
_MAX_DIVERGENCE = 300.0


class _Default:
    """Default of an argument, by its text. It says that the argument was left out, which None does not."""

    def __init__(self, text: str):
        self.text = text

    def __repr__(self) -> str:
        return self.text


_ALTITUDE, _AIM_POINT = _Default("1000.0"), _Default("(0.0, 0.0)")
_PULSE, _RECEIVER = _Default("GaussianPulse(fwhm=6.0)"), _Default("Receiver()")


def _wavelengths(x: ArrayLike | Sequence[ArrayLike], field: str = "wavelength") -> Float[Array, "..."]:
    return jnp.atleast_1d(as_array(x, field))


def _is_sensor(position: Any) -> bool:
    """Return True for three coordinates: those of a sensor, and not of an aim point."""
    # Sequences may hold numbers that a JAX transformation traces, of which NumPy makes no array.
    if isinstance(position, list | tuple):
        return len(position) == 3
    return getattr(position, "shape", ()) == (3,)


def _position(x: Any, field: str = "position") -> Array | np.ndarray:
    """Convert (x, y) of the aim point, or (x, y, z) of the sensor."""
    return coordinates(3 if _is_sensor(x) else 2)(x, field)


def tan_half(angle: ArrayLike, xp: Any = jnp) -> Any:
    """Return the tangent of half an angle in mrad: the radius of a cone over its length.

    Angles of half a turn or more count as a little less.
    """
    return xp.tan(xp.minimum(0.5e-3 * xp.asarray(angle), 0.5 * math.pi - 1e-3))


# Compiled: plans evaluate these often, and dispatching their operations one by one takes longer.
@jax.jit
def _beam_direction(zenith: Float[Array, ""], azimuth: Float[Array, ""]) -> Float[Array, "3"]:
    zenith, azimuth = jnp.deg2rad(zenith), jnp.deg2rad(azimuth)
    horizontal = jnp.sin(zenith)
    return jnp.stack([horizontal * jnp.sin(azimuth), horizontal * jnp.cos(azimuth), -jnp.cos(zenith)])


@jax.jit
def _slant_range(altitude: Float[Array, ""], zenith: Float[Array, ""]) -> Float[Array, ""]:
    return altitude / jnp.cos(jnp.deg2rad(zenith))


@final
class Lidar(eqx.Module):
    """A full-waveform lidar: its position and pointing, beam, pulse and receiver.

    The defaults are those of Table 1 of the paper: 1064 nm, a pulse of 6 ns, a divergence of 0.3 mrad and an
    aperture of 0.2 m, looking straight down from 1000 m.

    **Arguments:**

    - `wavelength`: nm, positive, one number or several that increase strictly; stored as (wavelengths,).
      Default 1064.
    - `altitude`: height of the sensor above the reference plane z = 0 in m, positive. Default 1000. The
      field is None where `sensor` is given.
    - `pulse`: shape of the transmitted pulse, an `AbstractPulse`. Default `GaussianPulse(fwhm=6.0)`.
    - `divergence`: full angle of the beam in mrad, in [0, 300]: the diameter of the footprint over the range,
      for small angles. For a Gaussian beam it is measured between the directions at 1/e^2 of the axial
      irradiance, for a top-hat across the disc. Default 0.3.
    - `level_divergence`: that across the vertical plane of the beam, mrad, in (0, 300], of an elliptical
      Gaussian beam; `divergence` is then that within this plane, which is that of `azimuth` for a beam
      straight down. Default None: as `divergence`, a round beam.
    - `ellipse_turn`: angle by which an ellipse is rotated about the beam from that orientation, clockwise as
      seen from the sensor, degrees, in [-360, 360]. `Survey.scan` and `Survey.fly` add the rotation of the
      scanner and its platform (`AbstractScan.level_axis`). Default None: not rotated, or a round beam.
    - `aperture`: diameter of the receiver in m, positive. Default 0.2.
    - `zenith`: angle between the beam and straight down (nadir) in degrees, in [0, 89]; with `sensor` in
      [0, 180], where 90 is level and 180 straight up. Default 0.
    - `azimuth`: compass direction in which the beam travels, degrees clockwise from north (+y). At nadir it
      does not change the beam axis. Default 0.
    - `energy`: transmitted energy per pulse in J, positive, one number or one per wavelength. Default 1e-3.
    - `sampling_interval`: interval between the digitiser's samples in ns, positive. Default 1.
    - `profile`: irradiance across the beam, "gaussian" or "top-hat". Default "gaussian".
    - `position`: (x, y) in m where the beam axis meets the reference plane: the centre of the footprint. At
      nadir it is also the sensor's horizontal position. Where `sensor` is given, this field holds that
      instead. Default (0, 0).
    - `field_of_view`: full angle of the receiver's field of view in mrad, positive; from 3142 on it is the
      half-space. Default None: no limit.
    - `jitter`: standard deviation of the timing error in ns, not negative. Default 0.
    - `efficiency`: of the optics and the detector together, in (0, 1], one number or one per wavelength.
      Default 1.
    - `receiver`: detection, noise and digitisation, a `Receiver`; or a `PhotonCounter`, for
      `jaxlidar.record`: waveforms then hold the expected energies. Default `Receiver()`: a perfect record.
    - `scan`: the pattern of a scanner, an `AbstractScan` for `Survey.scan` and `Survey.fly`. One shot does
      not depend on it. Default None.
    - `sensor`: (x, y, z) of the sensor in m, in place of `altitude` and `position`: anywhere, also within or
      below a canopy. Time zero of waveforms is then the emission at the sensor. Default None: above the
      reference plane, by `altitude`.

    A sensor may stand within plants, but not below the ground or in a plate: plans refuse that, as well as a
    level beam in a canopy with periodic sides.

    The receiver of a lidar with `sensor` is a flat aperture across the beam: it sees what lies before it, in
    proportion to the cosine of the angle from the axis, within the field of view.

    **Raises:** ValueError for a value outside its range, for wavelengths that do not increase strictly, for
    an unknown profile, for a position that is not two numbers and a sensor that is not three, for a sensor
    together with an altitude or a position, and where the energies or efficiencies are neither one number
    nor one per wavelength; TypeError for an object of the wrong type. A value so far from
    that of any instrument that another unit is likely gives a `UnitWarning`.

    **Example:**

    >>> import jaxlidar as jl
    >>> lidar = jl.Lidar(wavelength=[532.0, 1064.0], altitude=500.0, zenith=10.0)
    >>> print(f"range {lidar.range_to_reference:.1f} m, footprint radius {lidar.footprint_radius:.4f} m")
    range 507.7 m, footprint radius 0.0762 m
    >>> print([f"{x:.1f}" for x in lidar.sensor])
    ['0.0', '-88.2', '500.0']
    >>> upwards = jl.Lidar(sensor=(2.0, 3.0, 1.5), zenith=150.0, azimuth=30.0)
    >>> print([f"{x:.3f}" for x in upwards.direction])
    ['0.250', '0.433', '0.866']
    """

    wavelength: Float[Array, " wavelengths"] = quantity(
        unit=NANOMETRES, range=WAVELENGTHS, converter=_wavelengths
    )
    # None where the sensor is given by its position. Plausible from a bench to beyond all orbits.
    altitude: Float[Array, ""] | None = quantity(
        unit=Magnitude("m", 1.0, 1e8, {"km": 1e3, "mm": 1e-3}), range=POSITIVE, converter=as_optional_scalar
    )
    pulse: AbstractPulse
    # Plausible from less than the diffraction of a telescope of 2 m to the largest that is admissible.
    divergence: Float[Array, ""] = quantity(
        unit=Magnitude("mrad", 4e-4, _MAX_DIVERGENCE, {"rad": 1e3, "urad": 1e-3}),
        range=Range(0.0, _MAX_DIVERGENCE),
        converter=as_scalar,
    )
    aperture: Float[Array, ""] = quantity(
        unit=Magnitude("m", 0.0, 100.0, {"mm": 1e-3, "cm": 1e-2}), range=POSITIVE, converter=as_scalar
    )
    zenith: Float[Array, ""] = quantity(
        unit=DEGREES, range=Range(0.0, STRAIGHT_UP, mirrored=True), converter=as_scalar
    )
    azimuth: Float[Array, ""] = quantity(unit=COMPASS, converter=as_scalar)
    energy: Float[Array, "..."] = quantity(
        unit=Magnitude("J", 0.0, 100.0, {"uJ": 1e-6, "mJ": 1e-3}), range=POSITIVE, converter=as_array
    )
    sampling_interval: Float[Array, ""] = quantity(
        unit=Magnitude("ns", 1e-6, np.inf, {"s": 1e9}), range=POSITIVE, converter=as_scalar
    )
    profile: str = eqx.field(static=True)
    # (x, y) of the aim point, or (x, y, z) of the sensor.
    position: Float[Array | np.ndarray, " axes"] = quantity(unit="m", converter=_position)
    # Plausible from less than a hundredth of any beam to the whole half-space.
    field_of_view: Float[Array, ""] | None = quantity(
        unit=Magnitude("mrad", 5e-5, 3.2e3, {"rad": 1e3, "urad": 1e-3}),
        range=POSITIVE,
        converter=as_optional_scalar,
    )
    jitter: Float[Array, ""] = quantity(unit=NANOSECONDS, range=NOT_NEGATIVE, converter=as_scalar)
    efficiency: Float[Array, "..."] = quantity(range=Range(0.0, 1.0, low_open=True), converter=as_array)
    receiver: Receiver | PhotonCounter
    scan: AbstractScan | None = eqx.field(static=True)
    level_divergence: Float[Array, ""] | None = quantity(
        unit=Magnitude("mrad", 4e-4, _MAX_DIVERGENCE, {"rad": 1e3, "urad": 1e-3}),
        range=Range(0.0, _MAX_DIVERGENCE, low_open=True),
        converter=as_optional_scalar,
    )
    ellipse_turn: Float[Array, ""] | None = quantity(
        unit=DEGREES, range=Range(-360.0, 360.0), converter=as_optional_scalar
    )

    # Not the one of the dataclass: `sensor` is an argument, and a property that every lidar has.
    def __init__(
        self,
        wavelength: Any = 1064.0,
        altitude: Any = _ALTITUDE,
        pulse: Any = _PULSE,
        divergence: Any = 0.3,
        aperture: Any = 0.2,
        zenith: Any = 0.0,
        azimuth: Any = 0.0,
        energy: Any = 1e-3,
        sampling_interval: Any = 1.0,
        profile: str = "gaussian",
        position: Any = _AIM_POINT,
        field_of_view: Any = None,
        jitter: Any = 0.0,
        efficiency: Any = 1.0,
        receiver: Any = _RECEIVER,
        scan: Any = None,
        level_divergence: Any = None,
        ellipse_turn: Any = None,
        sensor: Any = None,
    ):
        if sensor is not None:
            for field, value in (("altitude", altitude), ("position", position)):
                if not isinstance(value, _Default):
                    raise ValueError(
                        f"{field} is given together with sensor; admissible is one of them: Lidar.at places "
                        "a lidar that has an altitude, such as an instrument, by its sensor"
                    )
            if not _is_sensor(sensor):
                raise ValueError(f"sensor = {sensor!r}; admissible are three numbers: x, y and z, m")
            position, altitude = sensor, None
        elif altitude is None:
            # A copy by `dataclasses.replace`, or from a file: the position is that of the sensor.
            if not _is_sensor(position):
                raise TypeError("altitude is None; admissible is a number, or sensor in place of it")
        else:
            altitude = 1000.0 if isinstance(altitude, _Default) else altitude
            position = (0.0, 0.0) if isinstance(position, _Default) else position
            if _is_sensor(position):
                raise ValueError(
                    "position has shape (3,); admissible is (2,): x and y, or sensor = (x, y, z)"
                )
        self.wavelength, self.altitude, self.divergence = wavelength, altitude, divergence
        self.aperture, self.zenith, self.azimuth, self.energy = aperture, zenith, azimuth, energy
        self.sampling_interval, self.profile, self.position = sampling_interval, profile, position
        self.field_of_view, self.jitter, self.efficiency = field_of_view, jitter, efficiency
        # Made here and not with the signature: importing the package starts no device.
        self.pulse = GaussianPulse() if isinstance(pulse, _Default) else pulse
        self.receiver = Receiver() if isinstance(receiver, _Default) else receiver
        self.scan, self.level_divergence = scan, level_divergence
        if ellipse_turn is None and level_divergence is not None:
            ellipse_turn = jnp.zeros(())
        self.ellipse_turn = ellipse_turn

    def __check_init__(self):
        check_kind("pulse", self.pulse, AbstractPulse, "a pulse, such as GaussianPulse(fwhm=6.0)")
        check_kind("receiver", self.receiver, Receiver | PhotonCounter, "a Receiver or a PhotonCounter")
        check_kind("scan", self.scan, AbstractScan | None, "a scan pattern, or None")
        if self.wavelength.ndim != 1:
            raise ValueError(
                f"wavelength has shape {self.wavelength.shape}; admissible is one number or (wavelengths,)"
            )
        check_ranges(self)
        wavelength = concrete(self.wavelength)
        if wavelength is not None and (wavelength.size == 0 or np.any(np.diff(wavelength) <= 0)):
            raise ValueError(
                f"wavelength = {wavelength.tolist()} is not admissible: one or more, strictly increasing, "
                "in (0, inf)"
            )
        check_choice("profile", self.profile, ("gaussian", "top-hat"))
        if self.level_divergence is None:
            if self.ellipse_turn is not None:
                raise ValueError(
                    "ellipse_turn is given without level_divergence; admissible are both, or None"
                )
        else:
            if self.profile != "gaussian":
                raise ValueError(
                    "level_divergence is given with profile = 'top-hat'; admissible is 'gaussian', or None"
                )
            divergence = concrete(self.divergence)
            if divergence is not None and not divergence > 0:
                raise ValueError(
                    "level_divergence is given with divergence = 0; admissible are both, or None"
                )
        for field, value in (("energy", self.energy), ("efficiency", self.efficiency)):
            if value.shape not in ((), (1,), self.wavelength.shape):
                raise ValueError(
                    f"{field} has shape {value.shape}; admissible is one number or one per wavelength, "
                    f"{self.wavelength.shape}"
                )

    def __str__(self) -> str:
        return object_text(self, {"position": "sensor"} if self.has_sensor_position else None)

    def at(self, sensor: Any, zenith: Any = None, azimuth: Any = None) -> "Lidar":
        """Place this lidar by the position of its sensor, such as an instrument of `instrument` on a tripod.

        **Arguments:**

        - `sensor`: (x, y, z) in m, as that of `Lidar`: anywhere. Time zero is then the emission.
        - `zenith`, `azimuth`: direction in degrees. Default None: the present one.

        **Returns:** a `Lidar`, in all else the same.

        **Raises:** as `Lidar`.

        **Example:**

        >>> import jaxlidar as jl
        >>> drone = jl.instrument("RIEGL VUX-1UAV").at((4.0, 2.0, 60.0), zenith=10.0)
        >>> drone.sensor.tolist(), drone.altitude, float(drone.zenith)
        ([4.0, 2.0, 60.0], None, 10.0)
        """
        if not _is_sensor(sensor):
            raise ValueError(f"sensor = {sensor!r}; admissible are three numbers: x, y and z, m")
        angles = {"zenith": zenith, "azimuth": azimuth}
        angles = {name: angle for name, angle in angles.items() if angle is not None}
        return dataclasses.replace(self, position=sensor, altitude=None, **angles)

    @property
    def opens_at_first_return(self) -> bool:
        """True if the sampling bins start at the first return."""
        return isinstance(self.receiver, Receiver) and self.receiver.window == "first return"

    @property
    def noise(self) -> float | None:
        """Standard deviation of the receiver's electronic noise, J per sample; None where it has none."""
        noise = concrete(getattr(self.receiver, "electronic_noise", 0.0))
        return float(noise) if noise is not None and noise > 0 else None

    @property
    def direction(self) -> Float[Array, " 3"]:
        """Unit vector (3,) in which the beam travels."""
        return _beam_direction(self.zenith, self.azimuth)

    @property
    def has_sensor_position(self) -> bool:
        """True if the lidar is placed by its sensor, and time zero is the emission."""
        return self.altitude is None

    @property
    def ranges(self) -> dict[str, Range]:
        """Admissible range of the zenith. A beam that is to meet the reference plane must go down."""
        return {} if self.has_sensor_position else {"zenith": Range(0.0, MAX_ZENITH, mirrored=True)}

    @property
    def range_to_reference(self) -> Float[Array, ""]:
        """Distance in m along the beam axis from the sensor to the aim point.

        The aim point lies on the reference plane, at the slant range; or 1 m ahead of a `sensor`.
        """
        if self.altitude is None:
            return jnp.full_like(self.zenith, AIM_DISTANCE)
        return _slant_range(self.altitude, self.zenith)

    @property
    def range_at_time_zero(self) -> Float[Array, ""]:
        """Range in m from which light of order one arrives at time zero: that of the aim point, or zero."""
        return jnp.zeros_like(self.zenith) if self.has_sensor_position else self.range_to_reference

    @property
    def aim_point(self) -> Float[Array, " 3"]:
        """Point (3,) of the beam axis, m, that is the origin of traced coordinates."""
        if self.has_sensor_position:
            return jnp.asarray(self.position, float) + AIM_DISTANCE * self.direction
        return jnp.concatenate([self.position, jnp.zeros_like(self.position[:1])])

    @property
    def sensor(self) -> Float[Array, " 3"]:
        """Position (3,) of the sensor in m."""
        if self.has_sensor_position:
            return jnp.asarray(self.position, float)
        return self.aim_point - self.range_to_reference * self.direction

    @property
    def footprint_radius(self) -> Float[Array, ""]:
        """Radius of the footprint in m: of the beam's cross-section at the aim point.

        The aim point lies on the reference plane, or 1 m ahead of a `sensor`. The radius is taken at 1/e^2 of
        the axial irradiance, or at the edge of a top-hat, and perpendicular to the beam; it is the longer one
        of an ellipse. On the plane itself the footprint is longer by 1/cos(zenith) along the azimuth.
        """
        return self.range_to_reference * self.largest_divergence * 0.5e-3

    @property
    def largest_divergence(self) -> Float[Array, ""]:
        """The larger one of the divergences of an elliptical beam, or that of a round one, mrad."""
        level = self.level_divergence
        return self.divergence if level is None else jnp.maximum(self.divergence, level)

    @property
    def ellipse(self) -> tuple[Float[Array, ""], Float[Array, ""]] | None:
        """Semi-axes of the footprint over its radius, of both divergences; None if round."""
        if self.level_divergence is None:
            return None
        return self.divergence / self.largest_divergence, self.level_divergence / self.largest_divergence

    @property
    def view_radius(self) -> Float[Array, ""] | None:
        """Radius in m of the field of view at the aim point, across the beam; None without limit."""
        field = self.field_of_view
        return None if field is None else self.range_to_reference * tan_half(field)

    @property
    def aperture_area(self) -> Float[Array, ""]:
        """Area of the receiver's aperture in m2."""
        return 0.25 * math.pi * self.aperture**2

    @property
    def aperture_half_angle(self) -> Float[Array, ""]:
        """Half-angle in rad of the aperture as seen from the aim point."""
        return 0.5 * self.aperture / self.range_to_reference

    @property
    def energy_per_wavelength(self) -> Float[Array, " wavelengths"]:
        """Transmitted energy in J per pulse, (wavelengths,)."""
        return jnp.broadcast_to(self.energy, self.wavelength.shape)

    @property
    def efficiency_per_wavelength(self) -> Float[Array, " wavelengths"]:
        """Efficiency of optics and detector, (wavelengths,)."""
        return jnp.broadcast_to(self.efficiency, self.wavelength.shape)
