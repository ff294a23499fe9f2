"""Surfaces of a scene: the ground and the plates above it.

A surface is a shape, a reflectance rho and a scattering law; a sheet has a transmittance tau and a coverage q
as well. Light that crosses a sheet meets material with the probability q: it is reflected with the weight
rho, transmitted with tau and absorbed with 1 - rho - tau. With the probability 1 - q it passes.

Slope sigma and aspect a (the compass direction in which a surface falls) describe a plane through the height
h at the position (x0, y0):

    z = h - tan(sigma) ((x - x0) sin(a) + (y - y0) cos(a)).
"""

import abc
from typing import Any, ClassVar, TypeVar, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlidar._fields.checks import (
    as_array,
    as_numpy,
    as_scalar,
    check_choice,
    check_kind,
    check_numbers,
    check_range,
    concrete,
    coordinates,
)
from jaxlidar._fields.ranges import (
    COMPASS,
    DEGREES,
    FRACTION,
    SUM_OF_FRACTIONS,
    Range,
    check_ranges,
    quantity,
)
from jaxlidar._text import object_text
from jaxlidar.optics.laws import AbstractLaw, Lambertian
from jaxlidar.optics.spectra import Spectrum
from jaxlidar.scenes.raster import Raster
from jaxlidar.scenes.shapes import AbstractShape, Plane

# A reflectance is one number, one number per wavelength, or a spectrum.
Reflectance = Float[Array, ""] | Float[Array, "wavelengths"] | Spectrum

_SLOPES = Range(0.0, 90.0, high_open=True, mirrored=True)


def as_reflectance(x: Any, field: str = "reflectance") -> Any:
    """Convert a field that is a reflectance: a `Spectrum` stays, numbers become an array."""
    if isinstance(x, Spectrum):
        return x
    check_numbers(field, x, "real numbers or a Spectrum")
    return as_array(x, field)


def check_reflectance(field: str, x: Any) -> None:
    """Refuse a reflectance outside [0, 1] or of more axes than one.

    A `Spectrum` checks its own values.
    """
    if isinstance(x, Spectrum):
        return
    check_range(field, x, *FRACTION[:2])
    if x.ndim > 1 or x.size == 0:
        raise ValueError(
            f"{field} has shape {x.shape}; admissible is one number, one per wavelength, or a Spectrum"
        )


def check_sum(field: str, reflectance: Any, transmittance: Any) -> None:
    """Refuse a reflectance and a transmittance whose sum exceeds 1 by more than rounding, if both are known.

    Two spectra are compared over the wavelengths that both have, a spectrum and one number over those of the
    spectrum. Several numbers beside a spectrum are not checked: their wavelengths are not known.

    **Raises:** ValueError naming `field` and the sum.
    """
    quantities = (reflectance, transmittance)
    sizes = [x.size for x in quantities if not isinstance(x, Spectrum) and x.size != 1]
    if len(set(sizes)) > 1:
        raise ValueError(f"{field}: {sizes[0]} values and {sizes[1]} values; they must be one per wavelength")
    tables = [concrete(x.wavelength) for x in quantities if isinstance(x, Spectrum)]
    tables = [table for table in tables if table is not None]
    # Between samples a spectrum is linear: the sum is largest at a sample of one of them.
    wavelengths = np.concatenate([*tables, []])
    for table in tables:
        wavelengths = wavelengths[(wavelengths >= table[0]) & (wavelengths <= table[-1])]
    r, t = (_concrete_reflectance(x, wavelengths, among_spectra=bool(tables)) for x in quantities)
    if r is None or t is None:
        return
    check_range(field, r + t, *SUM_OF_FRACTIONS[:2])


def _concrete_reflectance(x: Any, wavelengths: np.ndarray, *, among_spectra: bool) -> np.ndarray | None:
    """Evaluate a spectrum at wavelengths, or return numbers as they are; None if they cannot be compared."""
    if isinstance(x, Spectrum):
        arrays = [concrete(a) for a in (x.wavelength, x.reflectance, x.scale)]
        if any(a is None for a in arrays):
            return None
        table, values, scale = map(np.asarray, arrays)
        return scale * np.interp(wavelengths, table, values)
    values = concrete(x)
    return None if values is None or (among_spectra and values.size > 1) else values


class AbstractSurface(eqx.Module):
    """A surface that reflects light: its optical properties and its shape, as the tracer and plans use them.

    Derive your own surface from `AbstractGround` or `AbstractSheet`.

    **Arguments:**

    - `reflectance`: one number, one per wavelength, or a `Spectrum`; in [0, 1].
    - `law`: the scattering law, an `AbstractLaw`.

    **Example:**

    >>> import jaxlidar as jl
    >>> surfaces = (jl.Ground(reflectance=0.3), jl.Plate(height=5.0, reflectance=0.4))
    >>> from jaxlidar.scenes.surfaces import AbstractSurface
    >>> [isinstance(surface, AbstractSurface) for surface in surfaces]
    [True, True]
    """

    reflectance: eqx.AbstractVar[Reflectance]
    law: eqx.AbstractVar[AbstractLaw]

    def __str__(self) -> str:
        return object_text(self)

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """Name of the surface in `Waveform.components`. Several surfaces of one name are numbered from 1."""

    @property
    @abc.abstractmethod
    def shape(self) -> AbstractShape:
        """Shape and position of the surface."""

    @property
    def pattern(self) -> Raster | None:
        """Factor of the reflectance at each position; None if the reflectance is uniform.

        It is part of the geometry, with which light is traced, and does not depend on the wavelength.
        """
        return None

    @property
    def brightest(self) -> Reflectance:
        """Reflectance at the brightest position."""
        return self.reflectance

    def moved(self, by: Float[np.ndarray, "2"]) -> "AbstractSurface | None":
        """Move the surface horizontally; None if its class does not define this.

        If all surfaces of a scene define it, the scene is moved to its local origin in double precision, and
        coordinates of millions of metres lose no digits.

        **Arguments:** `by`: (2,) displacement to the east and to the north, m, in double precision.
        """
        return None


class AbstractGround(AbstractSurface):
    """A ground: an opaque surface that light meets from above only. A `Scene` has at most one.

    To add your own ground, derive a class from this one, define its fields, name and shape, and pass it as
    `ground=` of a `Scene`.

    **Arguments:**

    - `reflectance`: one number, one per wavelength, or a `Spectrum`; in [0, 1].
    - `law`: the scattering law, an `AbstractLaw`.

    **Example:** a smooth water surface at z = 0.

    >>> import jax, jaxlidar as jl
    >>> class Water(jl.AbstractGround):
    ...     reflectance: jax.Array | float = 0.02
    ...     law: jl.AbstractLaw = jl.Specular(roughness=0.1)
    ...     name = "water"
    ...     shape = jl.Plane.of(0.0, 0.0, 0.0)
    >>> jl.Scene(ground=Water()).surfaces[0].name
    'water'
    """


class AbstractSheet(AbstractSurface):
    """A sheet: a surface that light meets from both sides and may pass. A `Scene` has any number of them.

    To add your own sheet, derive a class from this one, define its fields, name and shape, and pass it in
    `plates=` of a `Scene`.

    **Arguments:**

    - `reflectance`: one number, one per wavelength, or a `Spectrum`; in [0, 1].
    - `law`: the scattering law, an `AbstractLaw`.
    - `transmittance`: one number, one per wavelength, or a `Spectrum`; in [0, 1].
    - `coverage`: probability that light meets material where it crosses the sheet, in [0, 1].
    - `transmission`: "straight" (transmitted light keeps its direction) or "diffuse" (it leaves the far side
      by the cosine law).

    **Example:**

    >>> import jaxlidar as jl
    >>> sheet = jl.Plate(height=5.0, reflectance=0.4, transmittance=0.4, transmission="diffuse")
    >>> isinstance(sheet, jl.AbstractSheet), sheet.name
    (True, 'plate')
    """

    transmittance: eqx.AbstractVar[Reflectance]
    coverage: eqx.AbstractVar[Float[Array, ""]]
    transmission: eqx.AbstractVar[str]


@final
class Ground(AbstractGround):
    """The ground: an infinite opaque plane, level or sloping.

    **Arguments:**

    - `height`: height at `position`, m. Default 0.
    - `reflectance`: one number, one per wavelength, or a `Spectrum`; in [0, 1]. Default 0.3.
    - `slope`: angle from the horizontal, degrees, 0 to below 90. Default 0.
    - `aspect`: horizontal direction in which the ground falls, degrees clockwise from north (+y). Default 0.
    - `law`: the scattering law: `Lambertian()`, `EqualAngle()`, `Specular(roughness=...)`, or another
      `AbstractLaw`. Default `Lambertian()`.
    - `position`: (2,) horizontal position (x, y) in m at which the ground has its height. Default (0, 0).

    **Raises:** ValueError for a reflectance outside [0, 1] or of more axes than one, a slope outside [0, 90),
    and values that are not finite; TypeError for an object of the wrong type.

    **Example:**

    >>> import jaxlidar as jl
    >>> ground = jl.Ground(height=100.0, reflectance=jl.spectrum("soil-medium"), slope=20.0, aspect=180.0)
    >>> north, up = ground.shape.upward[1:]
    >>> print(f"normal: {float(north):.3f} north, {float(up):.3f} up")
    normal: -0.342 north, 0.940 up
    """

    height: Float[Array, ""] = quantity(unit="m", converter=as_scalar, default=0.0)
    reflectance: Reflectance = quantity(range=FRACTION, converter=as_reflectance, default=0.3)
    slope: Float[Array, ""] = quantity(unit=DEGREES, range=_SLOPES, converter=as_scalar, default=0.0)
    aspect: Float[Array, ""] = quantity(unit=COMPASS, converter=as_scalar, default=0.0)
    law: AbstractLaw = Lambertian()
    position: Float[Array | np.ndarray, " 2"] = quantity(
        unit="m", converter=coordinates(2), default=(0.0, 0.0)
    )

    def __check_init__(self):
        check_kind("law", self.law, AbstractLaw, "a law of reflection, such as Lambertian()")
        check_ranges(self)
        check_reflectance("reflectance", self.reflectance)

    @property
    def name(self) -> str:
        return "ground"

    @property
    def shape(self) -> Plane:
        return Plane.of(self.height, self.slope, self.aspect, self.position)

    def moved(self, by: Float[np.ndarray, "2"]) -> "Ground":
        return _moved(self, by)


@final
class Plate(AbstractSheet):
    """A leaf plate: an infinite sheet with a reflectance and a transmittance, the same on both sides.

    This is the leaf plate of the paper.

    **Arguments:**

    - `height`: height at `position`, m.
    - `reflectance`: one number, one per wavelength, or a `Spectrum`; in [0, 1].
    - `transmittance`: one number, one per wavelength, or a `Spectrum`; in [0, 1]. The sum of reflectance and
      transmittance is at most 1. Default 0.
    - `coverage`: probability that a ray meets the plate, independently at every crossing; in [0, 1].
      Default 1.
    - `slope`: angle from the horizontal, degrees, 0 to below 90. Default 0.
    - `aspect`: horizontal direction in which the plate falls, degrees clockwise from north (+y). Default 0.
    - `transmission`: "straight" (as in the paper: transmitted light keeps its direction) or "diffuse" (it
      leaves the far side by the cosine law). Default "straight".
    - `law`: the scattering law, an `AbstractLaw`. Default `Lambertian()`.
    - `position`: (2,) horizontal position (x, y) in m at which the plate has its height. Default (0, 0).

    **Raises:** ValueError for values outside the ranges above, and for an unknown `transmission`; TypeError
    for an object of the wrong type. The sum of a `Spectrum` and one number, or another `Spectrum`, is checked
    at all wavelengths that it has, whichever of them a lidar uses. A `Spectrum` beside one number per
    wavelength is not checked.

    **Example:**

    >>> import jaxlidar as jl
    >>> plate = jl.Plate(height=5.0, reflectance=0.4, transmittance=0.45, coverage=0.5)
    >>> print(f"{float(1 - plate.reflectance - plate.transmittance):.2f} of the light is absorbed")
    0.15 of the light is absorbed
    """

    height: Float[Array, ""] = quantity(unit="m", converter=as_scalar)
    reflectance: Reflectance = quantity(range=FRACTION, converter=as_reflectance)
    transmittance: Reflectance = quantity(range=FRACTION, converter=as_reflectance, default=0.0)
    coverage: Float[Array, ""] = quantity(range=FRACTION, converter=as_scalar, default=1.0)
    slope: Float[Array, ""] = quantity(unit=DEGREES, range=_SLOPES, converter=as_scalar, default=0.0)
    aspect: Float[Array, ""] = quantity(unit=COMPASS, converter=as_scalar, default=0.0)
    transmission: str = eqx.field(static=True, default="straight")
    law: AbstractLaw = Lambertian()
    position: Float[Array | np.ndarray, " 2"] = quantity(
        unit="m", converter=coordinates(2), default=(0.0, 0.0)
    )

    ranges: ClassVar = {"reflectance + transmittance": SUM_OF_FRACTIONS}

    def __check_init__(self):
        check_kind("law", self.law, AbstractLaw, "a law of reflection, such as Lambertian()")
        check_reflectance("reflectance", self.reflectance)
        check_reflectance("transmittance", self.transmittance)
        check_sum("reflectance + transmittance", self.reflectance, self.transmittance)
        check_ranges(self)
        check_choice("transmission", self.transmission, ("straight", "diffuse"))

    @property
    def name(self) -> str:
        return "plate"

    @property
    def shape(self) -> Plane:
        return Plane.of(self.height, self.slope, self.aspect, self.position)

    def moved(self, by: Float[np.ndarray, "2"]) -> "Plate":
        return _moved(self, by)


PlaneSurface = TypeVar("PlaneSurface", Ground, Plate)


def _moved(surface: PlaneSurface, by: Float[np.ndarray, "2"]) -> PlaneSurface:
    """Move a plane surface, and describe it by its height at x = y = 0 if slope and position are concrete.

    In double precision, the height at the new origin takes in the slope times the distance to a position that
    may be millions of metres away.
    """
    position, by = concrete(surface.position), as_numpy(by, "by")
    if position is None:
        return eqx.tree_at(lambda s: s.position, surface, surface.position + jnp.asarray(by, float))
    position = position + by
    slope, aspect = concrete(surface.slope), concrete(surface.aspect)
    if slope is None or aspect is None:
        return eqx.tree_at(lambda s: s.position, surface, jnp.asarray(position, float))
    downhill = np.stack([np.sin(np.deg2rad(aspect)), np.cos(np.deg2rad(aspect))])
    rise, height = np.tan(np.deg2rad(slope)) * downhill @ position, concrete(surface.height)
    height_at_origin = (surface.height if height is None else height) + rise
    fields = (as_array(height_at_origin), as_array(np.zeros_like(position)))
    return eqx.tree_at(lambda s: (s.height, s.position), surface, fields)
