"""What the lidar looks at: canopy, plates, ground and atmosphere, and nothing that is not there."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlidar._checks import as_array, as_scalar, check_choice, check_range, concrete
from jaxlidar.optics.laws import AbstractLaw, Lambertian
from jaxlidar.optics.phase import Isotropic
from jaxlidar.optics.spectra import Spectrum, reflectance_at
from jaxlidar.scenes.atmosphere import Atmosphere
from jaxlidar.scenes.voxels import VoxelMap

# A reflectance is one number, one number per wavelength, or a spectrum.
Reflectance = Float[Array, ""] | Float[Array, "wavelengths"] | Spectrum


def _as_reflectance(x: Any) -> Any:
    return x if isinstance(x, Spectrum) or x is None else as_array(x)


def _as_bark(x: Any) -> Any:
    return x if isinstance(x, Isotropic) else _as_reflectance(x)


def _check_reflectance(field: str, x: Any) -> None:
    if not isinstance(x, Spectrum):
        check_range(field, x, 0.0, 1.0)


class Plane(eqx.Module):
    """A plane through (0, 0, height), its upper normal tilted by `slope` towards the azimuth `aspect`."""

    height: Float[Array, ""]
    normal: Float[Array, "3"]


def _plane(height: Array, slope: Array, aspect: Array) -> Plane:
    s, a = jnp.deg2rad(slope), jnp.deg2rad(aspect)
    return Plane(height, jnp.stack([jnp.sin(s) * jnp.sin(a), jnp.sin(s) * jnp.cos(a), jnp.cos(s)]))


class Ground(eqx.Module):
    """The ground: an infinite opaque plane.

    **Arguments:**

    - `height`: m, at x = y = 0. Default 0.
    - `reflectance`: one number, one per wavelength, or a `Spectrum`.
    - `slope`: degrees from the horizontal, 0 to below 90. Default 0.
    - `aspect`: degrees clockwise from north (+y): the horizontal direction in which the ground falls.
    - `law`: `Lambertian()` (default), `EqualAngle()` or `Specular(roughness=)`.

    **Raises:** ValueError for a reflectance outside [0, 1] or a slope outside [0, 90).
    """

    height: Float[Array, ""] = eqx.field(converter=as_scalar, default=0.0)
    reflectance: Reflectance = eqx.field(converter=_as_reflectance, default=0.3)
    slope: Float[Array, ""] = eqx.field(converter=as_scalar, default=0.0)
    aspect: Float[Array, ""] = eqx.field(converter=as_scalar, default=0.0)
    law: AbstractLaw = Lambertian()

    def __check_init__(self):
        check_range("height", self.height)
        _check_reflectance("reflectance", self.reflectance)
        check_range("slope", self.slope, 0.0, 90.0, high_open=True)
        check_range("aspect", self.aspect)

    @property
    def plane(self) -> Plane:
        """Where it lies."""
        return _plane(self.height, self.slope, self.aspect)


class Plate(eqx.Module):
    """An infinite sheet with a reflectance and a transmittance, alike on both sides: the paper's leaf plate.

    **Arguments:**

    - `height`: m, at x = y = 0.
    - `reflectance`, `transmittance`: one number, one per wavelength, or a `Spectrum`; their sum at most 1.
    - `coverage`: probability that a ray meets the sheet, independently at every crossing. Default 1.
    - `slope`, `aspect`: as for `Ground`.
    - `transmission`: "straight" (default, as in the paper: the direction is kept) or "diffuse" (cosine
      law into the far side).
    - `law`: how it reflects. Default `Lambertian()`.

    **Raises:** ValueError for values outside [0, 1] and for reflectance + transmittance above 1.
    """

    height: Float[Array, ""] = eqx.field(converter=as_scalar)
    reflectance: Reflectance = eqx.field(converter=_as_reflectance)
    transmittance: Reflectance = eqx.field(converter=_as_reflectance, default=0.0)
    coverage: Float[Array, ""] = eqx.field(converter=as_scalar, default=1.0)
    slope: Float[Array, ""] = eqx.field(converter=as_scalar, default=0.0)
    aspect: Float[Array, ""] = eqx.field(converter=as_scalar, default=0.0)
    transmission: str = eqx.field(static=True, default="straight")
    law: AbstractLaw = Lambertian()

    def __check_init__(self):
        check_range("height", self.height)
        _check_reflectance("reflectance", self.reflectance)
        _check_reflectance("transmittance", self.transmittance)
        check_sum("reflectance + transmittance", self.reflectance, self.transmittance)
        check_range("coverage", self.coverage, 0.0, 1.0)
        check_range("slope", self.slope, 0.0, 90.0, high_open=True)
        check_range("aspect", self.aspect)
        check_choice("transmission", self.transmission, ("straight", "diffuse"))

    @property
    def plane(self) -> Plane:
        """Where it lies."""
        return _plane(self.height, self.slope, self.aspect)


class Canopy(eqx.Module):
    """Leaf and bark in voxels.

    **Arguments:**

    - `voxels`: a `VoxelMap`.
    - `leaf`: leaf optics: a `Prospect`, a `LeafOptics`, anything that gives (reflectance, transmittance)
      for wavelengths in nm, or an `Isotropic` volume scatterer. Needed where the map has leaf.
    - `bark`: reflectance of bark: one number, one per wavelength, a `Spectrum`, or an `Isotropic`. Needed
      where the map has bark.
    - `transmission`: "diffuse" (default: transmitted light leaves the far side of the leaf by the cosine
      law) or "straight" (the paper: it keeps its direction; extinction then depends on the wavelength).
    - `hotspot`: False (default): the ways in and out are independent, first order as exp(-2 tau). True:
      first-order light returns through the gap by which it came, exp(-tau), as gap models assume.
    - `sides`: "open" (default: nothing beyond the map) or "periodic" (the map repeats without end).

    **Raises:** ValueError for missing optics, bark reflectance outside [0, 1] or unknown choices.
    """

    voxels: VoxelMap
    leaf: Callable | Isotropic | None = None
    bark: Reflectance | Isotropic | None = eqx.field(converter=_as_bark, default=None)
    transmission: str = eqx.field(static=True, default="diffuse")
    hotspot: bool = eqx.field(static=True, default=False)
    sides: str = eqx.field(static=True, default="open")

    def __check_init__(self):
        if self.voxels.leaf is not None and self.leaf is None:
            raise ValueError("leaf = None, but the voxel map has leaf: give its optics")
        if self.voxels.bark is not None and self.bark is None:
            raise ValueError("bark = None, but the voxel map has bark: give its reflectance")
        if not isinstance(self.bark, Isotropic | None):
            _check_reflectance("bark", self.bark)
        check_choice("transmission", self.transmission, ("diffuse", "straight"))
        check_choice("sides", self.sides, ("open", "periodic"))


class Scene(eqx.Module):
    """Everything in the beam's way. What is None or empty is not there and costs nothing.

    **Arguments:**

    - `canopy`: a `Canopy` or None.
    - `plates`: a tuple of `Plate`.
    - `ground`: a `Ground` or None.
    - `atmosphere`: an `Atmosphere` or None.
    """

    canopy: Canopy | None = None
    plates: tuple[Plate, ...] = eqx.field(converter=tuple, default=())
    ground: Ground | None = None
    atmosphere: Atmosphere | None = None

    @property
    def surfaces(self) -> tuple[Ground | Plate, ...]:
        """The ground, if any, then the plates: the order in which the tracer counts them."""
        return (() if self.ground is None else (self.ground,)) + self.plates


def check_sum(field: str, reflectance: Any, transmittance: Any) -> None:
    """Refuse R + T above 1 (beyond rounding) where both can be read."""
    if isinstance(reflectance, Spectrum) or isinstance(transmittance, Spectrum):
        return
    r, t = concrete(reflectance), concrete(transmittance)
    if r is not None and t is not None:
        if r.ndim == t.ndim == 1 and r.shape != t.shape:
            raise ValueError(f"{field}: {r.size} values and {t.size} values; they must be one per wavelength")
        check_range(field, r + t, 0.0, 1.0 + 1e-6)


def leaf_optics(
    canopy: Canopy, wavelength: Float[Array, "wavelengths"]
) -> tuple[Float[Array, "wavelengths"], Float[Array, "wavelengths"]]:
    """Leaf reflectance and transmittance; for `Isotropic`, the albedo and zero.

    **Raises:** ValueError if R + T exceeds 1.
    """
    if isinstance(canopy.leaf, Isotropic):
        albedo = reflectance_at(canopy.leaf.albedo, wavelength, "leaf albedo")
        return albedo, jnp.zeros_like(albedo)
    assert canopy.leaf is not None
    wl = np.asarray(wavelength) if concrete(wavelength) is not None else wavelength
    r, t = canopy.leaf(wl)
    check_range("leaf reflectance", r, 0.0, 1.0 + 1e-6)
    check_range("leaf transmittance", t, 0.0, 1.0 + 1e-6)
    check_range("leaf reflectance + transmittance", r + t, 0.0, 1.0 + 1e-5)
    return reflectance_at(r, wavelength, "leaf reflectance"), reflectance_at(
        t, wavelength, "leaf transmittance"
    )
