r"""The clear atmosphere between lidar and target: molecules and aerosol in exponential layers.

**Extinction.** Molecules after Bodhaine et al. (1999): with n the refractive index of standard air (Peck
and Reeder 1972, for 360 ppm CO2) and F its depolarisation (King) factor,

    sigma = 24 pi^3 (n^2 - 1)^2 F / (lambda^4 N^2 (n^2 + 2)^2)
    tau_R = sigma P A / (m_a g)                                 at sea level and 45 degrees of latitude

with the scattering cross-section sigma of a molecule, the number density N of standard air, the pressure P,
Avogadro's number A, the mean molecular mass m_a and the gravity g. (Their fit, eq. 30, holds to 850 nm only
and is 0.8 % too high at 1550 nm.) The extinction of aerosol follows from the visibility V,

    k = 3.912 / V * (lambda / 550 nm)^-q                        per km for V in km,

with the exponent q(V) of Kruse et al. (1962) or of Kim et al. (2001), which differ below 6 km only. Strictly,
3.912/V is the extinction of molecules and aerosol together; as is customary, it is taken as that of the
aerosol alone (at 550 nm and 23 km the molecules are 7 % of it).

**Layers.** Both densities fall with height as exp(-z / H). The one-way optical depth along a beam at the
zenith angle theta between a target at the height h and a sensor at the altitude a is, for each,

    tau = k H exp(-h / H) (1 - exp(-(a - h) / H)) / cos(theta),   k the extinction coefficient at z = 0.

**Return.** A white Lambertian target across the beam at range R sends E A_r T^2 / (pi R^2) of a pulse of
energy E into an aperture A_r, where T^2 is the two-way transmittance. Its apparent reflectance, the internal
unit, is T^2. A layer dr of air with the backscatter coefficient beta (1/m/sr) sends E A_r beta dr T^2 / R^2.
The apparent reflectance of the air per metre of range is therefore pi beta T^2, with

    beta = molecules' extinction / (8 pi / 3 sr) + aerosol's extinction / lidar ratio.

Multiple scattering in the air and absorption by gases are not simulated. Avoid wavelengths in the absorption
bands of water vapour (0.94, 1.13, 1.38, 1.87 micrometres) and oxygen (0.76).
"""

import math
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxlidar._fields.checks import (
    Magnitude,
    as_array,
    as_optional_scalar,
    as_scalar,
    check_choice,
    check_flag,
    check_range,
)
from jaxlidar._fields.ranges import POSITIVE, Range, check_ranges, quantity
from jaxlidar._text import object_text

# Admissible wavelengths, nm. Peck and Reeder's formula is fitted to 230..1690 nm and smooth far beyond; the
# exponents of aerosol hold to about 2500 nm.
_WAVELENGTH_RANGE = (230.0, 3000.0)
# Volume mixing ratio of carbon dioxide.
_CO2 = 360e-6
# Molecules per cm3 at 288.15 K and 1013.25 hPa.
_NUMBER_DENSITY = 2.546899e19
# Molecules per cm2 above sea level: P A / (m_a g), with g at the air's centre of mass, 5517.56 m, at 45
# degrees of latitude.
_COLUMN = 1013250.0 * 6.0221367e23 / ((28.9595 + 15.0556 * _CO2) * 978.9158)
_MICROMETRE4_PER_CM4 = 1e16
# Ratio of extinction to backscatter coefficient of the Rayleigh phase function, sr.
_MOLECULAR_LIDAR_RATIO = 8 * math.pi / 3


def _checked_wavelength(wavelength: ArrayLike) -> Float[Array, "..."]:
    wavelength = as_array(wavelength, "wavelength")
    check_range("wavelength", wavelength, *_WAVELENGTH_RANGE)
    return wavelength


def _outer(a: Float[Array, "..."], b: Float[Array, "..."]) -> Float[Array, "..."]:
    """Multiply every element of `a` by every element of `b`; the axes of `a` come first."""
    return a.reshape(a.shape + (1,) * b.ndim) * b.reshape((1,) * a.ndim + b.shape)


def rayleigh_optical_depth(wavelength: ArrayLike) -> Float[Array, "..."]:
    """Compute the Rayleigh optical depth of the whole atmosphere above sea level.

    It holds for 1013.25 hPa, a latitude of 45 degrees and 360 ppm CO2.

    **Arguments:**

    - `wavelength`: nm, any shape, 230 to 3000.

    **Returns:** an array of the shape of `wavelength`.

    **Raises:** ValueError for a wavelength outside its range.

    **Source:** Bodhaine, Wood, Dutton and Slusser 1999, J. Atmos. Oceanic Technol. 16, 1854.

    **Example:**

    >>> from jaxlidar.scenes.atmosphere import rayleigh_optical_depth
    >>> print(f"{float(rayleigh_optical_depth(532.0)):.3f}")
    0.111
    """
    return _rayleigh_optical_depth(_checked_wavelength(wavelength) * 1e-3)


@jax.jit
def _rayleigh_optical_depth(micrometres: Float[Array, "..."]) -> Float[Array, "..."]:
    """Compute the Rayleigh optical depth at wavelengths in micrometres."""
    # In the notation of the source: w is the squared wavenumber in 1/micrometre^2, d = n - 1. The small
    # difference d is computed by itself, as n would lose its digits.
    w = micrometres**-2
    d = 1e-8 * (8060.51 + 2480990.0 / (132.274 - w) + 17455.7 / (39.32957 - w))
    d = d * (1 + 0.54 * (_CO2 - 300e-6))
    # King factors, weighted by the per cent by volume of nitrogen, oxygen, argon (1) and carbon dioxide
    # (1.15).
    nitrogen = 1.034 + 3.17e-4 * w
    oxygen = 1.096 + 1.385e-3 * w + 1.448e-4 * w * w
    co2_percent = 100 * _CO2
    king = (78.084 * nitrogen + 20.946 * oxygen + 0.934 + 1.15 * co2_percent) / (
        78.084 + 20.946 + 0.934 + co2_percent
    )
    lorentz = d * (2 + d) / (3 + d * (2 + d))  # (n^2 - 1) / (n^2 + 2)
    # A Python float, as the square of the density does not fit into single precision.
    scale = _COLUMN * 24 * math.pi**3 / _NUMBER_DENSITY**2 * _MICROMETRE4_PER_CM4
    return scale * (lorentz * w) ** 2 * king


def aerosol_extinction(
    wavelength: ArrayLike, visibility: ArrayLike, model: str = "kim"
) -> Float[Array, "..."]:
    """Compute the extinction coefficient of aerosol in 1/m at the height where the visibility is measured.

    Differentiable in wavelength and visibility, except at the jumps of the exponent at 50 km and (Kruse)
    6 km.

    **Arguments:**

    - `wavelength`: nm, any shape, 230 to 3000.
    - `visibility`: km, positive, a scalar: the distance at which the contrast of a black target falls to 2 %
      at 550 nm.
    - `model`: "kim" or "kruse": the exponent of wavelength for visibilities below 6 km. Default "kim".

    **Returns:** an array of the shape of `wavelength`.

    **Raises:** ValueError for a value outside its range and for an unknown model.

    **Source:** Kruse, McGlauchlin and McQuistan 1962, Elements of Infrared Technology; Kim, McArthur and
    Korevaar 2001, Proc. SPIE 4214, 26.

    **Example:**

    >>> from jaxlidar.scenes.atmosphere import aerosol_extinction
    >>> print(f"{1000 * float(aerosol_extinction(550.0, 23.0)):.3f} per km")
    0.170 per km
    """
    check_range("visibility", visibility, 0.0, low_open=True)
    check_choice("model", model, ("kim", "kruse"))
    v = as_scalar(visibility, "visibility")
    if model == "kruse":
        low_exponent = 0.585 * jnp.cbrt(v)
    else:
        low_exponent = jnp.where(v > 1.0, 0.16 * v + 0.34, jnp.maximum(v - 0.5, 0.0))
    exponent = jnp.where(v > 50.0, 1.6, jnp.where(v < 6.0, low_exponent, 1.3))
    return 3.912e-3 / v * jnp.exp(-exponent * jnp.log(_checked_wavelength(wavelength) / 550.0))


@final
class Atmosphere(eqx.Module):
    """A clear atmosphere: molecules and aerosol whose densities fall exponentially with height.

    Heights are above the reference plane z = 0, in m, and may be negative. All arguments but `rayleigh` and
    `aerosol_model` are differentiable.

    **Arguments:**

    - `visibility`: visibility at z = 0 in km, positive, or None: no aerosol. Default 23 ("clear").
    - `rayleigh`: True if molecules scatter light (Rayleigh scattering). Default True.
    - `aerosol_model`: "kim" or "kruse": the exponent of the wavelength in aerosol extinction for visibilities
      below 6 km (Kim et al. 2001, Kruse et al. 1962). Default "kim".
    - `rayleigh_scale_height`: m, positive. Default 8450: the ratio of the air column above sea level to the
      density there at 15 degrees Celsius, so that both optical depth and extinction at sea level are right.
    - `aerosol_scale_height`: m, positive. Default 1400, within the customary 1200 (Elterman 1968, UV,
      Visible, and IR Attenuation for Altitudes to 50 km) to 2000. A visibility of 23 km is then an optical
      depth of 0.24 at 550 nm.
    - `lidar_ratio`: ratio of extinction to backscatter coefficient of the aerosol, sr, positive; from 20 (sea
      salt) to 80 (smoke). Default None: no return from the air, neither from aerosol nor from molecules.
    - `base_height`: height of the reference plane above sea level, m, -500 to 9000. It reduces the density of
      molecules only; `visibility` holds at z = 0 whatever the base height. Default 0.

    **Raises:** ValueError for a value outside its range and for an unknown model; TypeError for an object of
    the wrong type. A scale height that is likely given in km gives a `UnitWarning`.

    **Source:** see `jaxlidar.scenes.atmosphere` for the equations.

    **Example:**

    >>> import jaxlidar as jl
    >>> air = jl.Atmosphere(visibility=10.0)
    >>> transmittance = air.two_way_transmittance(1064.0, height=0.0, altitude=1000.0)
    >>> print(f"{float(transmittance):.3f}")
    0.788
    """

    # Plausible from dense fog; air without any aerosol has some 300 km.
    visibility: Float[Array, ""] | None = quantity(
        unit=Magnitude("km", 1e-3, 1e3, {"m": 1e-3}),
        range=POSITIVE,
        converter=as_optional_scalar,
        default=23.0,
    )
    rayleigh: bool = eqx.field(static=True, default=True)
    aerosol_model: str = eqx.field(static=True, default="kim")
    rayleigh_scale_height: Float[Array, ""] = quantity(
        unit=Magnitude("m", 100.0, 1e5, {"km": 1e3}), range=POSITIVE, converter=as_scalar, default=8450.0
    )
    aerosol_scale_height: Float[Array, ""] = quantity(
        unit=Magnitude("m", 10.0, 1e5, {"km": 1e3}), range=POSITIVE, converter=as_scalar, default=1400.0
    )
    lidar_ratio: Float[Array, ""] | None = quantity(
        unit="sr", range=POSITIVE, converter=as_optional_scalar, default=None
    )
    base_height: Float[Array, ""] = quantity(
        unit="m", range=Range(-500.0, 9000.0), converter=as_scalar, default=0.0
    )

    def __str__(self) -> str:
        return object_text(self)

    def __check_init__(self):
        check_flag("rayleigh", self.rayleigh)
        check_choice("aerosol_model", self.aerosol_model, ("kim", "kruse"))
        check_ranges(self)

    def _layers(self, wavelength: ArrayLike) -> list[tuple[Array, Array, Array | float]]:
        """List extinction at z = 0 (1/m), scale height (m) and lidar ratio (sr) of molecules and aerosol."""
        layers: list[tuple[Array, Array, Array | float]] = []
        if self.rayleigh:
            height = self.rayleigh_scale_height
            at_base = jnp.exp(-self.base_height / height) / height
            layers.append((rayleigh_optical_depth(wavelength) * at_base, height, _MOLECULAR_LIDAR_RATIO))
        if self.visibility is not None:
            aerosol = aerosol_extinction(wavelength, self.visibility, self.aerosol_model)
            ratio = jnp.inf if self.lidar_ratio is None else self.lidar_ratio
            layers.append((aerosol, self.aerosol_scale_height, ratio))
        return layers

    def extinction(self, wavelength: ArrayLike, height: ArrayLike) -> Float[Array, "..."]:
        """Compute the extinction coefficient of the air in 1/m.

        **Arguments:**

        - `wavelength`: nm, any shape, 230 to 3000.
        - `height`: m, any shape.

        **Returns:** an array of the shape of `wavelength` followed by that of `height`.

        **Raises:** ValueError for a wavelength outside its range.
        """
        wavelength, height = _checked_wavelength(wavelength), as_array(height, "height")
        check_range("height", height)
        total = jnp.zeros(wavelength.shape + height.shape)
        for at_zero, scale, _ in self._layers(wavelength):
            total = total + _outer(at_zero, jnp.exp(-height / scale))
        return total

    def optical_depth(
        self, wavelength: ArrayLike, height: ArrayLike, altitude: ArrayLike, zenith: ArrayLike = 0.0
    ) -> Float[Array, "..."]:
        """Compute the one-way optical depth of the air along the beam between sensor and target.

        The exponentials are integrated in closed form, exact to rounding for thin and for deep layers. The
        atmosphere is plane-parallel.

        **Arguments:**

        - `wavelength`: nm, any shape, 230 to 3000.
        - `height`: height of the target, m, any shape. For a target above the sensor the result is zero.
        - `altitude`: height of the sensor, m, a scalar.
        - `zenith`: zenith angle of the beam, degrees, 0 to 89, a scalar. Default 0.

        **Returns:** an array of the shape of `wavelength` followed by that of `height`.

        **Raises:** ValueError for a value outside its range.
        """
        wavelength, height = _checked_wavelength(wavelength), as_array(height, "height")
        altitude, zenith = as_scalar(altitude, "altitude"), as_scalar(zenith, "zenith")
        check_range("height", height)
        check_range("altitude", altitude)
        check_range("zenith", zenith, 0.0, 89.0)
        return self._optical_depth(wavelength, height, altitude, zenith)

    @eqx.filter_jit
    def _optical_depth(self, wavelength: Array, height: Array, altitude: Array, zenith: Array) -> Array:
        """Compute the one-way optical depth of admissible arguments."""
        slant = 1 / jnp.cos(jnp.deg2rad(zenith))
        thickness = jnp.maximum(altitude - height, 0.0)
        total = jnp.zeros(wavelength.shape + height.shape)
        for at_zero, scale, _ in self._layers(wavelength):
            # expm1 keeps the digits of layers that are thin against the scale height.
            column = -jnp.expm1(-thickness / scale) * jnp.exp(-height / scale) * scale
            total = total + _outer(at_zero, column)
        return total * slant

    def two_way_transmittance(
        self, wavelength: ArrayLike, height: ArrayLike, altitude: ArrayLike, zenith: ArrayLike = 0.0
    ) -> Float[Array, "..."]:
        """Compute the two-way transmittance of the air between sensor and target, in [0, 1].

        **Arguments:** `wavelength`, `height`, `altitude`, `zenith`: as for `optical_depth`.

        **Returns:** an array of the shape of `wavelength` followed by that of `height`.

        **Raises:** ValueError for a value outside its range.
        """
        return jnp.exp(-2 * self.optical_depth(wavelength, height, altitude, zenith))

    def two_way_transmittance_along(
        self, wavelength: ArrayLike, distance: ArrayLike, sensor_height: ArrayLike, zenith: ArrayLike
    ) -> Float[Array, "..."]:
        """Compute the two-way transmittance of the air along a beam in any direction, in [0, 1].

        With the heights z_s of the sensor and z = z_s - d cos(zenith) of the target, the optical depth of a
        layer of scale height h is, with u = |z - z_s| / h,

            k exp(-min(z, z_s) / h) d (1 - exp(-u)) / u,

        which for a level beam, u = 0, is k exp(-z_s / h) d.

        **Arguments:**

        - `wavelength`: nm, any shape, 230 to 3000.
        - `distance`: of the target from the sensor, m, any shape.
        - `sensor_height`: height of the sensor, m, a scalar.
        - `zenith`: angle between the beam and straight down, degrees, 0 to 180, a scalar.

        **Returns:** an array of the shape of `wavelength` followed by that of `distance`.

        **Raises:** ValueError for a value outside its range.

        **Example:** 1 km along the ground.

        >>> import jaxlidar as jl
        >>> air = jl.Atmosphere(visibility=10.0)
        >>> print(f"{float(air.two_way_transmittance_along(1064.0, 1000.0, 0.0, 90.0)):.3f}")
        0.716
        """
        wavelength, distance = _checked_wavelength(wavelength), as_array(distance, "distance")
        start, zenith = as_scalar(sensor_height, "sensor_height"), as_scalar(zenith, "zenith")
        check_range("distance", distance)
        check_range("sensor_height", start)
        check_range("zenith", zenith, 0.0, 180.0)
        end = start - distance * jnp.cos(jnp.deg2rad(zenith))
        total = jnp.zeros(wavelength.shape + distance.shape)
        for at_zero, scale, _ in self._layers(wavelength):
            u = jnp.abs(end - start) / scale
            # The quotient loses its digits, and its derivative more, where the beam is nearly level.
            is_level = u < 1e-3
            safe = jnp.where(is_level, 1.0, u)
            mean = jnp.where(is_level, 1.0 - 0.5 * u + u * u / 6.0, -jnp.expm1(-safe) / safe)
            column = jnp.exp(-jnp.minimum(start, end) / scale) * distance * mean
            total = total + _outer(at_zero, column)
        return jnp.exp(-2 * total)

    def backscatter(
        self, wavelength: ArrayLike, height: ArrayLike, altitude: ArrayLike, zenith: ArrayLike = 0.0
    ) -> Float[Array, "..."]:
        """Compute the return of the air itself: apparent reflectance per metre of range, in 1/m.

        This is pi times backscatter coefficient times two-way transmittance (see
        `jaxlidar.scenes.atmosphere`), for light scattered once. A range bin of length dr returns dr times
        this. It is zero if `lidar_ratio` is None. For ranges other than the reference range, the caller
        applies the inverse square of range.

        **Arguments:** `wavelength`, `height`, `altitude`, `zenith`: as for `optical_depth`.

        **Returns:** an array of the shape of `wavelength` followed by that of `height`.

        **Raises:** ValueError for a value outside its range.
        """
        transmittance = self.two_way_transmittance(wavelength, height, altitude, zenith)
        if self.lidar_ratio is None:
            return jnp.zeros_like(transmittance)
        height = as_array(height, "height")
        total = jnp.zeros_like(transmittance)
        for at_zero, scale, ratio in self._layers(wavelength):
            total = total + _outer(at_zero / ratio, jnp.exp(-height / scale))
        return math.pi * total * transmittance
