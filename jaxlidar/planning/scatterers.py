"""The scatterers of a scene, and the letters that spell their histories: leaf.R, leaf.T, ground.R."""

from collections import Counter
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlidar._checks import concrete
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.optics.phase import AbstractPhase
from jaxlidar.optics.spectra import reflectance_at
from jaxlidar.planning.trace_plan import Scatterer
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.surfaces import AbstractSheet, check_sum


class Optics(NamedTuple):
    """Reflectance and transmittance (None: opaque) of one scatterer, each (wavelengths,)."""

    name: str
    reflectance: Float[Array, "wavelengths"]
    transmittance: Float[Array, "wavelengths"] | None


class Letters(NamedTuple):
    """Numbered materials and letters. `surfaces` has the ground first, if there is one, then the plates."""

    materials: tuple[str, ...]
    letters: tuple[str, ...]
    leaf: Scatterer | None
    bark: Scatterer | None
    surfaces: tuple[Scatterer, ...]


def surface_names(scene: Scene) -> list[str]:
    """Names of the scene's surfaces, in their order; several of one name are numbered from 1."""
    names = [surface.name for surface in scene.surfaces]
    many, seen = Counter(names), Counter()
    numbered = []
    for name in names:
        seen[name] += 1
        numbered.append(name if many[name] == 1 else f"{name} {seen[name]}")
    return numbered


def scene_optics(lidar: Lidar, scene: Scene) -> list[Optics]:
    """Optics of every scatterer in the scene at the lidar's wavelengths: leaf, bark, ground, plates.

    Where the canopy's transmission is straight, transmitted light stays on its ray: a collision then reflects
    R / (1 - T), and nothing is transmitted.
    """
    wavelength, found = lidar.wavelength, []
    canopy = scene.canopy
    if canopy is not None and canopy.voxels.leaf is not None:
        r, t = canopy.leaf_optics(wavelength)
        if canopy.transmission == "straight":
            found.append(Optics("leaf", r / jnp.maximum(1.0 - t, 1e-6), None))
        else:
            found.append(Optics("leaf", r, None if isinstance(canopy.leaf, AbstractPhase) else t))
    if canopy is not None and canopy.voxels.bark is not None:
        found.append(Optics("bark", canopy.bark_reflectance(wavelength), None))
    for name, surface in zip(surface_names(scene), scene.surfaces):
        r = reflectance_at(surface.brightest, wavelength, f"{name} reflectance")
        t = None
        if isinstance(surface, AbstractSheet):
            t = reflectance_at(surface.transmittance, wavelength, f"{name} transmittance")
            check_sum(f"{name} reflectance + transmittance", r, t)
        found.append(Optics(name, r, t))
    return found


def spell(optics: list[Optics]) -> Letters:
    """Numbers of materials and letters; a transmittance known to be zero throughout has no letter."""
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


def letter_values(
    lidar: Lidar, scene: Scene, letters: tuple[str, ...]
) -> Float[Array, "letters wavelengths"]:
    """Reflectance or transmittance of every letter, by wavelength."""
    values: dict[str, Array] = {}
    for o in scene_optics(lidar, scene):
        values[f"{o.name}.R"] = o.reflectance
        if o.transmittance is not None:
            values[f"{o.name}.T"] = o.transmittance
    rows = [values[letter] for letter in letters]
    return jnp.stack(rows) if rows else jnp.zeros((0, lidar.wavelength.size))


def largest_albedo(optics: list[Optics]) -> float:
    """Largest R + T of any scatterer and wavelength; 1 where its value is being traced."""
    albedos = [0.0]
    for o in optics:
        given = [a for a in (o.reflectance, o.transmittance) if a is not None]
        known = [share for share in map(concrete, given) if share is not None]
        albedos.append(float(np.max(sum(known))) if len(known) == len(given) else 1.0)
    return max(albedos)


def lobe_probability(optics: list[Optics]) -> float:
    """Probability with which photons are reflected rather than transmitted: about the mean of R / (R + T).

    It is rounded to a tenth, so that small changes of optics do not recompile.
    """
    shares = []
    for o in optics:
        r, t = concrete(o.reflectance), None if o.transmittance is None else concrete(o.transmittance)
        if r is not None and t is not None and np.any(t > 0):
            shares.append(float(np.sum(r) / np.sum(r + t)))
    return round(min(max(float(np.mean(shares)), 0.2), 0.8), 1) if shares else 0.5
