"""The canopy: a voxel map with the optics of its leaf and bark."""

from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlidar._checks import check_choice, check_range, concrete
from jaxlidar.optics.phase import AbstractPhase
from jaxlidar.optics.spectra import reflectance_at
from jaxlidar.scenes.surfaces import Reflectance, as_reflectance, check_reflectance
from jaxlidar.scenes.voxels import VoxelMap


def _as_bark(x: Any) -> Any:
    return x if isinstance(x, AbstractPhase) else as_reflectance(x)


@final
class Canopy(eqx.Module):
    """Leaf and bark in voxels.

    **Arguments:**

    - `voxels`: a `VoxelMap`.
    - `leaf`: leaf optics: a `Prospect`, a `LeafOptics`, anything that gives (reflectance, transmittance)
      for wavelengths in nm, or a volume scatterer such as `Isotropic`. Needed where the map has leaf.
    - `bark`: reflectance of bark: one number, one per wavelength, a `Spectrum`, or a volume scatterer. Needed
      where the map has bark.
    - `transmission`: "diffuse" (default: transmitted light leaves the far side of the leaf by the cosine
      law) or "straight" (the paper: it keeps its direction; extinction then depends on the wavelength).
    - `hotspot`: False (default): the ways in and out are independent, first order as exp(-2 tau). True:
      first-order light returns through the gap by which it came, exp(-tau), as gap models assume.
    - `sides`: "open" (default: nothing beyond the map) or "periodic" (the map repeats without end).

    **Raises:** ValueError for missing optics, bark reflectance outside [0, 1] or unknown choices.
    """

    voxels: VoxelMap
    leaf: Callable | AbstractPhase | None = None
    bark: Reflectance | AbstractPhase | None = eqx.field(converter=_as_bark, default=None)
    transmission: str = eqx.field(static=True, default="diffuse")
    hotspot: bool = eqx.field(static=True, default=False)
    sides: str = eqx.field(static=True, default="open")

    def __check_init__(self):
        if not isinstance(self.voxels, VoxelMap):
            raise TypeError(f"voxels is a {type(self.voxels).__name__}; admissible is a VoxelMap")
        if self.voxels.leaf is not None and self.leaf is None:
            raise ValueError("leaf = None, but the voxel map has leaf: give its optics")
        if self.voxels.bark is not None and self.bark is None:
            raise ValueError("bark = None, but the voxel map has bark: give its reflectance")
        if not isinstance(self.bark, AbstractPhase | None):
            check_reflectance("bark", self.bark)
        check_choice("transmission", self.transmission, ("diffuse", "straight"))
        check_choice("sides", self.sides, ("open", "periodic"))

    @property
    def leaf_phase(self) -> AbstractPhase | None:
        """The phase function of the leaf, where it is no facets."""
        return self.leaf if isinstance(self.leaf, AbstractPhase) else None

    @property
    def bark_phase(self) -> AbstractPhase | None:
        """The phase function of the bark, where it is no facets."""
        return self.bark if isinstance(self.bark, AbstractPhase) else None

    @property
    def is_straight(self) -> bool:
        """Whether leaves transmit straight on, so that every wavelength has an extinction of its own."""
        return self.leaf is not None and self.transmission == "straight"

    def leaf_optics(
        self, wavelength: Float[Array, "wavelengths"]
    ) -> tuple[Float[Array, "wavelengths"], Float[Array, "wavelengths"]]:
        """Leaf reflectance and transmittance; for a volume scatterer, the albedo and zero.

        **Arguments:** `wavelength`: nm.

        **Raises:** ValueError if R + T exceeds 1.
        """
        if isinstance(self.leaf, AbstractPhase):
            albedo = reflectance_at(self.leaf.albedo, wavelength, "leaf albedo")
            return albedo, jnp.zeros_like(albedo)
        assert self.leaf is not None
        wl = np.asarray(wavelength) if concrete(wavelength) is not None else wavelength
        r, t = self.leaf(wl)
        check_range("leaf reflectance", r, 0.0, 1.0 + 1e-6)
        check_range("leaf transmittance", t, 0.0, 1.0 + 1e-6)
        check_range("leaf reflectance + transmittance", r + t, 0.0, 1.0 + 1e-5)
        names = ("leaf reflectance", "leaf transmittance")
        r, t = (reflectance_at(value, wavelength, name) for value, name in zip((r, t), names))
        return r, t

    def bark_reflectance(self, wavelength: Float[Array, "wavelengths"]) -> Float[Array, "wavelengths"]:
        """Reflectance of bark; for a volume scatterer, the albedo.

        **Arguments:** `wavelength`: nm.
        """
        bark = self.bark.albedo if isinstance(self.bark, AbstractPhase) else self.bark
        assert bark is not None
        return reflectance_at(bark, wavelength, "bark")
