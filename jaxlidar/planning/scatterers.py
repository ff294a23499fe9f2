"""The scatterers of a scene and the letters with which histories are spelled: leaf.R, leaf.T, ground.R ..."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlidar._checks import concrete
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.optics.phase import Isotropic
from jaxlidar.optics.spectra import reflectance_at
from jaxlidar.planning.trace_plan import Scatterer
from jaxlidar.scenes.scene import Scene, leaf_optics


class Optics(NamedTuple):
    """What one scatterer does to light: (wavelengths,) reflectance and transmittance (None: opaque)."""

    name: str
    reflectance: Float[Array, "wavelengths"]
    transmittance: Float[Array, "wavelengths"] | None


class Letters(NamedTuple):
    """Materials and letters by number. `surfaces` has the ground first, if there is one, then the plates."""

    materials: tuple[str, ...]
    letters: tuple[str, ...]
    leaf: Scatterer | None
    bark: Scatterer | None
    surfaces: tuple[Scatterer, ...]


def scene_optics(lidar: Lidar, scene: Scene) -> list[Optics]:
    """Optics of every scatterer at the lidar's wavelengths: leaf, bark, ground, plates, as far as there.

    Where the canopy's transmission is straight, transmitted light never left its ray: a collision
    then reflects R / (1 - T), and nothing is transmitted.
    """
    wavelength, found = lidar.wavelength, []
    canopy = scene.canopy
    if canopy is not None and canopy.voxels.leaf is not None:
        r, t = leaf_optics(canopy, wavelength)
        if canopy.transmission == "straight":
            found.append(Optics("leaf", r / jnp.maximum(1.0 - t, 1e-6), None))
        else:
            found.append(Optics("leaf", r, None if isinstance(canopy.leaf, Isotropic) else t))
    if canopy is not None and canopy.voxels.bark is not None:
        bark = canopy.bark.albedo if isinstance(canopy.bark, Isotropic) else canopy.bark
        assert bark is not None
        found.append(Optics("bark", reflectance_at(bark, wavelength, "bark"), None))
    if scene.ground is not None:
        r = reflectance_at(scene.ground.reflectance, wavelength, "ground reflectance")
        found.append(Optics("ground", r, None))
    for i, p in enumerate(scene.plates):
        name = "plate" if len(scene.plates) == 1 else f"plate {i + 1}"
        r = reflectance_at(p.reflectance, wavelength, f"{name} reflectance")
        found.append(Optics(name, r, reflectance_at(p.transmittance, wavelength, f"{name} transmittance")))
    return found


def spell(optics: list[Optics]) -> Letters:
    """Number materials and letters; a transmittance known to be zero throughout has no letter."""
    letters: list[str] = []
    scatterers: dict[str, Scatterer] = {}
    for material, o in enumerate(optics):
        letters.append(f"{o.name}.R")
        reflected, transmitted = len(letters) - 1, -1
        if o.transmittance is not None:
            known = concrete(o.transmittance)
            if known is None or np.any(known > 0):
                letters.append(f"{o.name}.T")
                transmitted = len(letters) - 1
        scatterers[o.name] = Scatterer(material, reflected, transmitted)
    surfaces = tuple(s for name, s in scatterers.items() if name not in ("leaf", "bark"))
    names = tuple(scatterers)
    return Letters(names, tuple(letters), scatterers.get("leaf"), scatterers.get("bark"), surfaces)


def largest_albedo(optics: list[Optics]) -> float:
    """Largest R + T of any scatterer and wavelength; 1 where it is being traced."""
    albedos = [0.0]
    for o in optics:
        total = concrete(o.reflectance if o.transmittance is None else o.reflectance + o.transmittance)
        albedos.append(1.0 if total is None else float(np.max(total)))
    return max(albedos)


def lobe_probability(optics: list[Optics]) -> float:
    """With what probability photons are reflected rather than transmitted: about R / (R + T) on average.

    In steps of a tenth, so that small changes of optics do not recompile.
    """
    shares = []
    for o in optics:
        r, t = concrete(o.reflectance), None if o.transmittance is None else concrete(o.transmittance)
        if r is not None and t is not None and np.any(t > 0):
            shares.append(float(np.sum(r) / np.sum(r + t)))
    return round(min(max(float(np.mean(shares)), 0.2), 0.8), 1) if shares else 0.5
