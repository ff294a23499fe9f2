"""Surfaces of a scene: the ground and the plates above it."""

import abc
from typing import Any, final

import equinox as eqx
from jaxtyping import Array, Float

from jaxlidar._checks import as_array, as_scalar, check_choice, check_range, concrete
from jaxlidar.optics.laws import AbstractLaw, Lambertian
from jaxlidar.optics.spectra import Spectrum
from jaxlidar.scenes.shapes import AbstractShape, Plane

# A reflectance is one number, one number per wavelength, or a spectrum.
Reflectance = Float[Array, ""] | Float[Array, "wavelengths"] | Spectrum


def as_reflectance(x: Any) -> Any:
    """Convert a reflectance to what fields hold: a `Spectrum`, an array, or None."""
    return x if isinstance(x, Spectrum) or x is None else as_array(x)


def check_reflectance(field: str, x: Any) -> None:
    """Raise ValueError for a reflectance outside [0, 1]. A `Spectrum` checks its own values."""
    if not isinstance(x, Spectrum):
        check_range(field, x, 0.0, 1.0)


def check_sum(field: str, reflectance: Any, transmittance: Any) -> None:
    """Raise ValueError if R + T exceeds 1 by more than rounding, where both values are known."""
    if isinstance(reflectance, Spectrum) or isinstance(transmittance, Spectrum):
        return
    r, t = concrete(reflectance), concrete(transmittance)
    if r is not None and t is not None:
        if r.ndim == t.ndim == 1 and r.shape != t.shape:
            raise ValueError(f"{field}: {r.size} values and {t.size} values; they must be one per wavelength")
        check_range(field, r + t, 0.0, 1.0 + 1e-6)


class AbstractSurface(eqx.Module):
    """A surface that reflects light: what the tracer and plans need to know about it.

    Derive your own surface from `AbstractGround` or `AbstractSheet`.

    **Arguments:**

    - `reflectance`: one number, one per wavelength, or a `Spectrum`; in [0, 1].
    - `law`: the scattering law, an `AbstractLaw`.

    **Example:**

    >>> import jaxlidar as jl
    >>> surfaces = (jl.Ground(reflectance=0.3), jl.Plate(height=5.0, reflectance=0.4))
    >>> [isinstance(surface, jl.AbstractSurface) for surface in surfaces]
    [True, True]
    """

    reflectance: eqx.AbstractVar[Reflectance]
    law: eqx.AbstractVar[AbstractLaw]

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """Name of the surface in `Waveform.components`. Several surfaces of one name are numbered from 1."""

    @property
    @abc.abstractmethod
    def shape(self) -> AbstractShape:
        """Shape and position of the surface."""


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
    - `coverage`: probability that light that crosses the sheet meets material, in [0, 1].
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

    - `height`: height at x = y = 0, m. Default 0.
    - `reflectance`: one number, one per wavelength, or a `Spectrum`; in [0, 1]. Default 0.3.
    - `slope`: angle from the horizontal, degrees, 0 to below 90. Default 0.
    - `aspect`: horizontal direction in which the ground falls, degrees clockwise from north (+y). Default 0.
    - `law`: the scattering law: `Lambertian()`, `EqualAngle()`, `Specular(roughness=...)`, or another
      `AbstractLaw`. Default `Lambertian()`.

    **Raises:** ValueError for a reflectance outside [0, 1], a slope outside [0, 90), and values that are not
    finite.

    **Example:**

    >>> import jaxlidar as jl
    >>> ground = jl.Ground(height=100.0, reflectance=jl.spectrum("soil-medium"), slope=20.0, aspect=180.0)
    >>> north, up = ground.shape.upward[1:]
    >>> print(f"normal: {float(north):.3f} north, {float(up):.3f} up")
    normal: -0.342 north, 0.940 up
    """

    height: Float[Array, ""] = eqx.field(converter=as_scalar, default=0.0)
    reflectance: Reflectance = eqx.field(converter=as_reflectance, default=0.3)
    slope: Float[Array, ""] = eqx.field(converter=as_scalar, default=0.0)
    aspect: Float[Array, ""] = eqx.field(converter=as_scalar, default=0.0)
    law: AbstractLaw = Lambertian()

    def __check_init__(self):
        check_range("height", self.height)
        check_reflectance("reflectance", self.reflectance)
        check_range("slope", self.slope, 0.0, 90.0, high_open=True)
        check_range("aspect", self.aspect)

    @property
    def name(self) -> str:
        return "ground"

    @property
    def shape(self) -> Plane:
        return Plane.of(self.height, self.slope, self.aspect)


@final
class Plate(AbstractSheet):
    """A leaf plate: an infinite sheet with a reflectance and a transmittance, the same on both sides.

    This is the leaf plate of the paper.

    **Arguments:**

    - `height`: height at x = y = 0, m.
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

    **Raises:** ValueError for values outside the ranges above, and for an unknown `transmission`. The sum of
    reflectance and transmittance is not checked where one of them is a `Spectrum`.

    **Example:**

    >>> import jaxlidar as jl
    >>> plate = jl.Plate(height=5.0, reflectance=0.4, transmittance=0.45, coverage=0.5)
    >>> print(f"{float(1 - plate.reflectance - plate.transmittance):.2f} of the light is absorbed")
    0.15 of the light is absorbed
    """

    height: Float[Array, ""] = eqx.field(converter=as_scalar)
    reflectance: Reflectance = eqx.field(converter=as_reflectance)
    transmittance: Reflectance = eqx.field(converter=as_reflectance, default=0.0)
    coverage: Float[Array, ""] = eqx.field(converter=as_scalar, default=1.0)
    slope: Float[Array, ""] = eqx.field(converter=as_scalar, default=0.0)
    aspect: Float[Array, ""] = eqx.field(converter=as_scalar, default=0.0)
    transmission: str = eqx.field(static=True, default="straight")
    law: AbstractLaw = Lambertian()

    def __check_init__(self):
        check_range("height", self.height)
        check_reflectance("reflectance", self.reflectance)
        check_reflectance("transmittance", self.transmittance)
        check_sum("reflectance + transmittance", self.reflectance, self.transmittance)
        check_range("coverage", self.coverage, 0.0, 1.0)
        check_range("slope", self.slope, 0.0, 90.0, high_open=True)
        check_range("aspect", self.aspect)
        check_choice("transmission", self.transmission, ("straight", "diffuse"))

    @property
    def name(self) -> str:
        return "plate"

    @property
    def shape(self) -> Plane:
        return Plane.of(self.height, self.slope, self.aspect)
