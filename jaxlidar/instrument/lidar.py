"""The lidar: sensor position, beam, pulse and receiver.

Axes: x east, y north, z up; the reference plane is z = 0. With the zenith angle theta and the compass azimuth
phi in which light travels, the unit vector of the beam is

    w = (sin(theta) sin(phi), sin(theta) cos(phi), -cos(theta)).

The beam axis meets the reference plane at p = (x, y, 0), `position`. At the altitude H the slant range is
R = H / cos(theta), the sensor stands at p - R w, and the footprint, perpendicular to the beam, has the radius
R gamma / 2 for the full divergence gamma. Time zero of every waveform is the two-way travel time 2 R / c to
p, not the emission: at the altitude of a satellite, absolute times in single precision would be off by
0.1 ns.
"""

import math
from collections.abc import Sequence
from typing import ClassVar, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxlidar._checks import (
    array,
    as_array,
    check_choice,
    check_kind,
    concrete,
    coordinates,
    optional_scalar,
    scalar,
    warn_units,
)
from jaxlidar._converted import Converted
from jaxlidar._ranges import Range, check_ranges
from jaxlidar._signatures import briefly
from jaxlidar._text import object_text
from jaxlidar.instrument.photon_counter import PhotonCounter
from jaxlidar.instrument.pulse import AbstractPulse, GaussianPulse
from jaxlidar.instrument.receiver import Receiver
from jaxlidar.instrument.scan import AbstractScan


def _wavelengths(x: ArrayLike | Sequence[ArrayLike]) -> Float[Array, "..."]:
    return jnp.atleast_1d(as_array(x, "wavelength"))


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
@briefly
class Lidar(eqx.Module):
    """A full-waveform lidar: its position and pointing, beam, pulse and receiver.

    The defaults are those of Table 1 of the paper: 1064 nm, a pulse of 6 ns, a divergence of 0.3 mrad and an
    aperture of 0.2 m, looking straight down from 1000 m.

    **Arguments:**

    - `wavelength`: nm, positive, one number or several that increase strictly; stored as (wavelengths,).
      Default 1064.
    - `altitude`: height of the sensor above the reference plane z = 0 in m, positive. Default 1000.
    - `pulse`: shape of the transmitted pulse, an `AbstractPulse`. Default `GaussianPulse(fwhm=6.0)`.
    - `divergence`: full angle of the beam in mrad, not negative. For a Gaussian beam it is measured between
      the directions at 1/e^2 of the axial irradiance, for a top-hat across the disc. Default 0.3.
    - `aperture`: diameter of the receiver in m, positive. Default 0.2.
    - `zenith`: angle between the beam and the vertical in degrees, in [0, 89]. Default 0 (nadir).
    - `azimuth`: compass direction in which the beam travels, degrees clockwise from north (+y). At nadir it
      does not change the beam axis. Default 0.
    - `energy`: transmitted energy per pulse in J, positive, one number or one per wavelength. Default 1e-3.
    - `sampling_interval`: interval between the digitiser's samples in ns, positive. Default 1.
    - `profile`: irradiance across the beam, "gaussian" or "top-hat". Default "gaussian".
    - `position`: (x, y) in m where the beam axis meets the reference plane: the centre of the footprint. At
      nadir it is also the sensor's horizontal position. Default (0, 0).
    - `field_of_view`: full angle of the receiver's field of view in mrad, positive. Default None: no limit.
    - `jitter`: standard deviation of the timing error in ns, not negative. Default 0.
    - `efficiency`: of the optics and the detector together, in (0, 1], one number or one per wavelength.
      Default 1.
    - `receiver`: detection, noise and digitisation, a `Receiver`; or a `PhotonCounter`, for
      `jaxlidar.record`: waveforms then hold the expected energies. Default `Receiver()`: a perfect record.
    - `scan`: the pattern of a scanner, an `AbstractScan` for `Survey.scan`. One shot does not depend on it.
      Default None.

    **Raises:** ValueError for a value outside its range, for wavelengths that do not increase strictly, for
    an unknown profile, for a position that is not two numbers, and where the energies or efficiencies are
    neither one number nor one per wavelength; TypeError for an object of the wrong type. A value so far from
    that of any instrument that another unit is likely gives a `UnitWarning`.

    **Example:**

    >>> import jaxlidar as jl
    >>> lidar = jl.Lidar(wavelength=[532.0, 1064.0], altitude=500.0, zenith=10.0)
    >>> print(f"range {lidar.range_to_reference:.1f} m, footprint radius {lidar.footprint_radius:.4f} m")
    range 507.7 m, footprint radius 0.0762 m
    >>> print([f"{x:.1f}" for x in lidar.sensor])
    ['0.0', '-88.2', '500.0']
    """

    wavelength: Converted[Float[Array, " wavelengths"]] = eqx.field(converter=_wavelengths, default=1064.0)
    altitude: Converted[Float[Array, ""]] = eqx.field(converter=scalar("altitude"), default=1000.0)
    pulse: AbstractPulse = eqx.field(default_factory=GaussianPulse)
    divergence: Converted[Float[Array, ""]] = eqx.field(converter=scalar("divergence"), default=0.3)
    aperture: Converted[Float[Array, ""]] = eqx.field(converter=scalar("aperture"), default=0.2)
    zenith: Converted[Float[Array, ""]] = eqx.field(converter=scalar("zenith"), default=0.0)
    azimuth: Converted[Float[Array, ""]] = eqx.field(converter=scalar("azimuth"), default=0.0)
    energy: Converted[Float[Array, "..."]] = eqx.field(converter=array("energy"), default=1e-3)
    sampling_interval: Converted[Float[Array, ""]] = eqx.field(
        converter=scalar("sampling_interval"), default=1.0
    )
    profile: str = eqx.field(static=True, default="gaussian")
    position: Converted[Float[Array | np.ndarray, " 2"]] = eqx.field(
        converter=coordinates("position", 2), default=(0.0, 0.0)
    )
    field_of_view: Converted[Float[Array, ""] | None] = eqx.field(
        converter=optional_scalar("field_of_view"), default=None
    )
    jitter: Converted[Float[Array, ""]] = eqx.field(converter=scalar("jitter"), default=0.0)
    efficiency: Converted[Float[Array, "..."]] = eqx.field(converter=array("efficiency"), default=1.0)
    receiver: Receiver | PhotonCounter = eqx.field(default_factory=Receiver)
    scan: AbstractScan | None = eqx.field(static=True, default=None)

    ranges: ClassVar = {
        "wavelength": Range(0.0, low_open=True, increasing=True),
        "altitude": Range(0.0, low_open=True),
        "divergence": Range(0.0),
        "aperture": Range(0.0, low_open=True),
        "zenith": Range(0.0, 89.0, mirrored=True),
        "azimuth": Range(),
        "energy": Range(0.0, low_open=True),
        "sampling_interval": Range(0.0, low_open=True),
        "position": Range(),
        "field_of_view": Range(0.0, low_open=True),
        "jitter": Range(0.0),
        "efficiency": Range(0.0, 1.0, low_open=True),
    }

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
        for field, value in (("energy", self.energy), ("efficiency", self.efficiency)):
            if value.shape not in ((), (1,), self.wavelength.shape):
                raise ValueError(
                    f"{field} has shape {value.shape}; admissible is one number or one per wavelength, "
                    f"{self.wavelength.shape}"
                )
        warn_units(self)

    def __str__(self) -> str:
        return object_text(self)

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
    def range_to_reference(self) -> Float[Array, ""]:
        """Slant range in m: distance along the beam axis from the sensor to the reference plane."""
        return _slant_range(self.altitude, self.zenith)

    @property
    def sensor(self) -> Float[Array, " 3"]:
        """Position (3,) of the sensor in m."""
        aim_point = jnp.concatenate([self.position, jnp.zeros_like(self.position[:1])])
        return aim_point - self.range_to_reference * self.direction

    @property
    def footprint_radius(self) -> Float[Array, ""]:
        """Radius of the footprint in m: of the beam's cross-section at the reference plane.

        It is taken at 1/e^2 of the axial irradiance, or at the edge of a top-hat, and perpendicular to the
        beam. On the plane itself the footprint is longer by 1/cos(zenith) along the azimuth.
        """
        return self.range_to_reference * self.divergence * 0.5e-3

    @property
    def aperture_area(self) -> Float[Array, ""]:
        """Area of the receiver's aperture in m2."""
        return 0.25 * math.pi * self.aperture**2

    @property
    def aperture_half_angle(self) -> Float[Array, ""]:
        """Half-angle in rad of the aperture as seen from the reference plane."""
        return 0.5 * self.aperture / self.range_to_reference

    @property
    def energy_per_wavelength(self) -> Float[Array, " wavelengths"]:
        """Transmitted energy in J per pulse, (wavelengths,)."""
        return jnp.broadcast_to(self.energy, self.wavelength.shape)

    @property
    def efficiency_per_wavelength(self) -> Float[Array, " wavelengths"]:
        """Efficiency of optics and detector, (wavelengths,)."""
        return jnp.broadcast_to(self.efficiency, self.wavelength.shape)
