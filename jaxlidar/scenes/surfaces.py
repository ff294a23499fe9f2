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
    """A reflectance as it is kept in a field: a `Spectrum`, or an array."""
    return x if isinstance(x, Spectrum) or x is None else as_array(x)


def check_reflectance(field: str, x: Any) -> None:
    """Refuse a reflectance outside [0, 1]; a `Spectrum` checks its own."""
    if not isinstance(x, Spectrum):
        check_range(field, x, 0.0, 1.0)


def check_sum(field: str, reflectance: Any, transmittance: Any) -> None:
    """Refuse R + T above 1 (beyond rounding) where both can be read."""
    if isinstance(reflectance, Spectrum) or isinstance(transmittance, Spectrum):
        return
    r, t = concrete(reflectance), concrete(transmittance)
    if r is not None and t is not None:
        if r.ndim == t.ndim == 1 and r.shape != t.shape:
            raise ValueError(f"{field}: {r.size} values and {t.size} values; they must be one per wavelength")
        check_range(field, r + t, 0.0, 1.0 + 1e-6)


class AbstractSurface(eqx.Module):
    """A surface that light meets: what trace and plan need to know of one. Derive from one of the two below.

    - `reflectance`: one number, one per wavelength, or a `Spectrum`.
    - `law`: how it reflects.
    """

    reflectance: eqx.AbstractVar[Reflectance]
    law: eqx.AbstractVar[AbstractLaw]

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """What it is called in a waveform's components; several of a name are numbered from 1."""

    @property
    @abc.abstractmethod
    def shape(self) -> AbstractShape:
        """Where it lies."""


class AbstractGround(AbstractSurface):
    """A surface at which light ends, met from above alone; a `Scene` has one at most.

    A ground of your own is one class in one file: derive it from this, give its fields, name and shape, and
    pass it as `ground=` of a `Scene`.
    """


class AbstractSheet(AbstractSurface):
    """A surface that light meets from both sides and may pass; a `Scene` has any number of them.

    A sheet of your own is one class in one file: derive it from this, give its fields, name and shape, and
    pass it in `plates=` of a `Scene`.

    - `transmittance`: one number, one per wavelength, or a `Spectrum`.
    - `coverage`: probability that light that crosses the sheet meets it.
    - `transmission`: "straight" (the direction is kept) or "diffuse" (cosine law into the far side).
    """

    transmittance: eqx.AbstractVar[Reflectance]
    coverage: eqx.AbstractVar[Float[Array, ""]]
    transmission: eqx.AbstractVar[str]


@final
class Ground(AbstractGround):
    """The ground: an infinite opaque plane.

    **Arguments:**

    - `height`: m, at x = y = 0. Default 0.
    - `reflectance`: one number, one per wavelength, or a `Spectrum`. Default 0.3.
    - `slope`: degrees from the horizontal, 0 to below 90. Default 0.
    - `aspect`: degrees clockwise from north (+y): the horizontal direction in which the ground falls. Default
      0.
    - `law`: `Lambertian()` (default), `EqualAngle()`, `Specular(roughness=)`, or another `AbstractLaw`.

    **Raises:** ValueError for a reflectance outside [0, 1] or a slope outside [0, 90).
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
    """An infinite sheet with a reflectance and a transmittance, alike on both sides: the paper's leaf plate.

    **Arguments:**

    - `height`: m, at x = y = 0.
    - `reflectance`, `transmittance`: one number, one per wavelength, or a `Spectrum`; their sum at most 1.
      `transmittance` is 0 by default.
    - `coverage`: probability that a ray meets the sheet, independently at every crossing. Default 1.
    - `slope`, `aspect`: as for `Ground`. Default 0.
    - `transmission`: "straight" (default, as in the paper: the direction is kept) or "diffuse" (cosine
      law into the far side).
    - `law`: how it reflects. Default `Lambertian()`.

    **Raises:** ValueError for values outside [0, 1] and for reflectance + transmittance above 1.
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
