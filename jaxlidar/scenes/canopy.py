"""The canopy: a voxel map with the optical properties of its leaf and bark.

Leaf is a medium of flat scatterers with the reflectance R and the transmittance T. With diffuse transmission
the single scattering albedo is R + T. With straight transmission the fraction T of the light goes on as if it
had met no leaf. This is exactly an extinction that is smaller by the factor 1 - T, with the albedo R / (1 -
T).
"""

from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxlidar._fields.checks import (
    check_choice,
    check_flag,
    check_kind,
    check_numbers,
    check_range,
    concrete,
    kind_of,
)
from jaxlidar._fields.ranges import FRACTION, quantity
from jaxlidar._text import object_text
from jaxlidar.optics.phase import AbstractPhase
from jaxlidar.optics.spectra import Spectrum, reflectance_at
from jaxlidar.scenes.surfaces import Reflectance, as_reflectance, check_reflectance
from jaxlidar.scenes.voxels import VoxelMap


def _as_bark(x: Any, field: str = "bark") -> Any:
    return x if isinstance(x, AbstractPhase | None) else as_reflectance(x, field)


@final
class Canopy(eqx.Module):
    """A canopy: leaf and bark in voxels, with their optical properties.

    **Arguments:**

    - `voxels`: a `VoxelMap`.
    - `leaf`: leaf optics: a `Prospect`, a `LeafOptics`, any function of the wavelengths in nm that returns
      (reflectance, transmittance), or a volume scatterer such as `Isotropic`. Required if the map has leaf.
      Default None.
    - `bark`: reflectance of bark: one number, one per wavelength, a `Spectrum`, or a volume scatterer. In
      [0, 1]. Required if the map has bark. Default None.
    - `transmission`: "diffuse": transmitted light leaves the far side of the leaf by the cosine law.
      "straight" (as in the paper): it keeps its direction; extinction then depends on the wavelength.
      Default "diffuse".
    - `hotspot`: True: first-order light returns through the gap by which it entered, attenuated by exp(-tau),
      as source and receiver look along one line (the hot spot; Kuusk 1985). False: the attenuations on the
      way in and out are independent, and it is attenuated by exp(-2 tau), as in the paper. Light of higher
      orders leaves along another path than it came by; its attenuations are independent in both cases.
      Default True.
    - `sides`: "open": there is no canopy beyond the map. "periodic": the map repeats without end. Default
      "open".

    **Raises:** ValueError for missing optics, a bark reflectance outside [0, 1] and unknown choices;
    TypeError for an object of the wrong type.

    **Example:**

    >>> import numpy as np, jaxlidar as jl
    >>> voxels = jl.VoxelMap.from_lad(np.full((4, 4, 10), 0.5), voxel_size=1.0)
    >>> canopy = jl.Canopy(voxels, leaf=jl.Prospect(N=1.5, Cab=40.0, Car=8.0, Cw=0.01, Cm=0.009))
    >>> reflectance, transmittance = canopy.leaf_optics(np.array([1064.0]))
    >>> print(f"R = {float(reflectance[0]):.2f}, T = {float(transmittance[0]):.2f}")
    R = 0.44, T = 0.48
    """

    voxels: VoxelMap
    leaf: Callable | AbstractPhase | None = None
    bark: Reflectance | AbstractPhase | None = quantity(range=FRACTION, converter=_as_bark, default=None)
    transmission: str = eqx.field(static=True, default="diffuse")
    hotspot: bool = eqx.field(static=True, default=True)
    sides: str = eqx.field(static=True, default="open")

    def __str__(self) -> str:
        return object_text(self)

    def __check_init__(self):
        check_kind("voxels", self.voxels, VoxelMap, "a VoxelMap")
        # Classes and spectra can be called, too, but do not return reflectance and transmittance.
        if isinstance(self.leaf, type | Spectrum) or not (
            callable(self.leaf) or isinstance(self.leaf, AbstractPhase | None)
        ):
            raise TypeError(
                f"leaf is {kind_of(self.leaf)}; admissible are leaf optics, such as "
                "LeafOptics(reflectance=0.4, transmittance=0.3), or a volume scatterer"
            )
        check_flag("hotspot", self.hotspot)
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
        """The phase function of leaf if leaf is a volume scatterer, else None."""
        return self.leaf if isinstance(self.leaf, AbstractPhase) else None

    @property
    def bark_phase(self) -> AbstractPhase | None:
        """The phase function of bark if bark is a volume scatterer, else None."""
        return self.bark if isinstance(self.bark, AbstractPhase) else None

    @property
    def is_straight(self) -> bool:
        """True if transmitted light keeps its direction; extinction then depends on the wavelength."""
        return self.leaf is not None and self.transmission == "straight"

    def leaf_optics(
        self, wavelength: Float[ArrayLike, "wavelengths"]
    ) -> tuple[Float[Array, "wavelengths"], Float[Array, "wavelengths"]]:
        """Evaluate leaf reflectance and transmittance; for a volume scatterer, its albedo and zero.

        **Arguments:**

        - `wavelength`: (wavelengths,) nm.

        **Returns:** (reflectance, transmittance), each (wavelengths,).

        **Raises:** ValueError if one of them is outside [0, 1], or their sum exceeds 1; TypeError where the
        leaf optics do not return the two.
        """
        check_numbers("wavelength", wavelength)
        if isinstance(self.leaf, AbstractPhase):
            albedo = reflectance_at(self.leaf.albedo, wavelength, "leaf albedo")
            return albedo, jnp.zeros_like(albedo)
        assert self.leaf is not None
        wl = np.asarray(wavelength) if concrete(wavelength) is not None else wavelength
        optics = self.leaf(wl)
        if not isinstance(optics, tuple) or len(optics) != 2:
            raise TypeError(f"leaf returns {kind_of(optics)}; admissible is (reflectance, transmittance)")
        r, t = optics
        check_range("leaf reflectance", r, 0.0, 1.0 + 1e-6)
        check_range("leaf transmittance", t, 0.0, 1.0 + 1e-6)
        reflectance, transmittance = concrete(r), concrete(t)
        if reflectance is not None and transmittance is not None:
            check_range("leaf reflectance + transmittance", reflectance + transmittance, 0.0, 1.0 + 1e-5)
        names = ("leaf reflectance", "leaf transmittance")
        r, t = (reflectance_at(value, wavelength, name) for value, name in zip((r, t), names))
        return r, t

    def bark_reflectance(self, wavelength: Float[ArrayLike, "wavelengths"]) -> Float[Array, "wavelengths"]:
        """Evaluate the reflectance of bark; for a volume scatterer, its albedo.

        **Arguments:**

        - `wavelength`: (wavelengths,) nm.

        **Returns:** (wavelengths,) reflectance.

        **Raises:** ValueError if the number of values is not that of the wavelengths, and for a wavelength
        outside the range of a spectrum.
        """
        bark = self.bark.albedo if isinstance(self.bark, AbstractPhase) else self.bark
        assert bark is not None
        return reflectance_at(bark, wavelength, "bark")
