"""Surfaces of a scene: the ground and the plates above it."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar, TypeVar, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlidar._checks import (
    as_array,
    briefly,
    check_choice,
    check_kind,
    check_numbers,
    check_range,
    concrete,
    coordinates,
    scalar,
)
from jaxlidar._ranges import FRACTION, SUM_OF_FRACTIONS, Range, check_ranges
from jaxlidar.optics.laws import AbstractLaw, Lambertian
from jaxlidar.optics.spectra import Spectrum
from jaxlidar.scenes.raster import Raster
from jaxlidar.scenes.shapes import AbstractShape, Plane

# A reflectance is one number, one number per wavelength, or a spectrum.
Reflectance = Float[Array, ""] | Float[Array, "wavelengths"] | Spectrum

_PLACED = {
    "height": Range(),
    "slope": Range(0.0, 90.0, high_open=True, mirrored=True),
    "aspect": Range(),
    "position": Range(),
}


def reflectance_field(field: str) -> Callable[[Any], Any]:
    """The converter of a field that is a reflectance: a `Spectrum` as it is, or numbers to an array."""

    def convert(x: Any) -> Any:
        if isinstance(x, Spectrum):
            return x
        check_numbers(field, x, "real numbers or a Spectrum")
        return as_array(x, field)

    return convert


def check_reflectance(field: str, x: Any) -> None:
    """Raise ValueError for a reflectance outside [0, 1] or of more axes than one.

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
    """Raise ValueError if R + T exceeds 1 by more than rounding, where both values are known.

    A spectrum is compared with one number, or over the wavelengths that both have with a spectrum. Of several
    numbers beside a spectrum nothing can be said: their wavelengths are not known.
    """
    both = (reflectance, transmittance)
    sizes = [x.size for x in both if not isinstance(x, Spectrum) and x.size != 1]
    if len(set(sizes)) > 1:
        raise ValueError(f"{field}: {sizes[0]} values and {sizes[1]} values; they must be one per wavelength")
    tables = [
        known for x in both if isinstance(x, Spectrum) and (known := concrete(x.wavelength)) is not None
    ]
    # Between samples a spectrum is linear: the sum is largest at a sample.
    at = np.concatenate([*tables, []])
    for table in tables:
        at = at[(at >= table[0]) & (at <= table[-1])]
    r, t = (_known(x, at, among_spectra=bool(tables)) for x in both)
    if r is None or t is None:
        return
    check_range(field, r + t, *SUM_OF_FRACTIONS[:2])


def _known(x: Any, at: np.ndarray, *, among_spectra: bool) -> np.ndarray | None:
    """Values of a reflectance: of a spectrum at some wavelengths, of numbers as they are. None: not known."""
    if isinstance(x, Spectrum):
        parts = [concrete(part) for part in (x.wavelength, x.reflectance, x.scale)]
        if any(part is None for part in parts):
            return None
        wavelength, values, factor = map(np.asarray, parts)
        return factor * np.interp(at, wavelength, values)
    values = concrete(x)
    return None if values is None or (among_spectra and values.size > 1) else values


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

    @property
    def pattern(self) -> Raster | None:
        """What the reflectance is multiplied by at each place; None where it is the same everywhere.

        It belongs to the geometry: light is traced with it.
        """
        return None

    @property
    def brightest(self) -> Reflectance:
        """The reflectance at the brightest place."""
        return self.reflectance

    def moved(self, by: Float[np.ndarray, "2"]) -> "AbstractSurface | None":
        """The same surface, moved horizontally; None where a surface does not define this.

        Scenes of surfaces that all define it lose nothing in single precision where coordinates are millions
        of metres.

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
@briefly
class Ground(AbstractGround):
    """The ground: an infinite opaque plane, level or sloping.

    **Arguments:**

    - `height`: height at `position`, m. Default 0.
    - `reflectance`: one number, one per wavelength, or a `Spectrum`; in [0, 1]. Default 0.3.
    - `slope`: angle from the horizontal, degrees, 0 to below 90. Default 0.
    - `aspect`: horizontal direction in which the ground falls, degrees clockwise from north (+y). Default 0.
    - `law`: the scattering law: `Lambertian()`, `EqualAngle()`, `Specular(roughness=...)`, or another
      `AbstractLaw`. Default `Lambertian()`.
    - `position`: (2,) horizontal place (x, y) in m at which the ground has its height. Default (0, 0).

    **Raises:** ValueError for a reflectance outside [0, 1] or of more axes than one, a slope outside [0, 90),
    and values that are not finite; TypeError for a thing of another kind.

    **Example:**

    >>> import jaxlidar as jl
    >>> ground = jl.Ground(height=100.0, reflectance=jl.spectrum("soil-medium"), slope=20.0, aspect=180.0)
    >>> north, up = ground.shape.upward[1:]
    >>> print(f"normal: {float(north):.3f} north, {float(up):.3f} up")
    normal: -0.342 north, 0.940 up
    """

    height: Float[Array, ""] = eqx.field(converter=scalar("height"), default=0.0)
    reflectance: Reflectance = eqx.field(converter=reflectance_field("reflectance"), default=0.3)
    slope: Float[Array, ""] = eqx.field(converter=scalar("slope"), default=0.0)
    aspect: Float[Array, ""] = eqx.field(converter=scalar("aspect"), default=0.0)
    law: AbstractLaw = Lambertian()
    position: Float[Array | np.ndarray, " 2"] = eqx.field(
        converter=coordinates("position", 2), default=(0.0, 0.0)
    )

    ranges: ClassVar = _PLACED | {"reflectance": FRACTION}

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
@briefly
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
    - `position`: (2,) horizontal place (x, y) in m at which the plate has its height. Default (0, 0).

    **Raises:** ValueError for values outside the ranges above, and for an unknown `transmission`; TypeError
    for a thing of another kind. A `Spectrum` is added to one number, or to another `Spectrum`, at all
    wavelengths that it has, whichever of them a lidar uses. A `Spectrum` beside one number per wavelength is
    not checked.

    **Example:**

    >>> import jaxlidar as jl
    >>> plate = jl.Plate(height=5.0, reflectance=0.4, transmittance=0.45, coverage=0.5)
    >>> print(f"{float(1 - plate.reflectance - plate.transmittance):.2f} of the light is absorbed")
    0.15 of the light is absorbed
    """

    height: Float[Array, ""] = eqx.field(converter=scalar("height"))
    reflectance: Reflectance = eqx.field(converter=reflectance_field("reflectance"))
    transmittance: Reflectance = eqx.field(converter=reflectance_field("transmittance"), default=0.0)
    coverage: Float[Array, ""] = eqx.field(converter=scalar("coverage"), default=1.0)
    slope: Float[Array, ""] = eqx.field(converter=scalar("slope"), default=0.0)
    aspect: Float[Array, ""] = eqx.field(converter=scalar("aspect"), default=0.0)
    transmission: str = eqx.field(static=True, default="straight")
    law: AbstractLaw = Lambertian()
    position: Float[Array | np.ndarray, " 2"] = eqx.field(
        converter=coordinates("position", 2), default=(0.0, 0.0)
    )

    ranges: ClassVar = _PLACED | {
        "reflectance": FRACTION,
        "transmittance": FRACTION,
        "reflectance + transmittance": SUM_OF_FRACTIONS,
        "coverage": FRACTION,
    }

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


Planar = TypeVar("Planar", Ground, Plate)


def _moved(surface: Planar, by: Float[np.ndarray, "2"]) -> Planar:
    """The surface moved; where its slope is known, what has its height is told at x = y = 0."""
    place = concrete(surface.position)
    if place is None:
        return eqx.tree_at(lambda s: s.position, surface, surface.position + jnp.asarray(by, float))
    place = place + by
    slope, aspect = concrete(surface.slope), concrete(surface.aspect)
    if slope is None or aspect is None:
        return eqx.tree_at(lambda s: s.position, surface, jnp.asarray(place, float))
    fall = np.tan(np.deg2rad(slope)) * np.stack([np.sin(np.deg2rad(aspect)), np.cos(np.deg2rad(aspect))])
    rise, known = fall @ place, concrete(surface.height)
    height = surface.height + rise if known is None else known + rise
    here = (jnp.asarray(height, float), jnp.asarray(np.zeros_like(place), float))
    return eqx.tree_at(lambda s: (s.height, s.position), surface, here)
