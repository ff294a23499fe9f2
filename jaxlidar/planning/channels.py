"""The materials of a scene, and the scatterer channels whose exponents make up scattering histories.

Every material has a channel for what it reflects ("leaf.R", "ground.R"), and another for what it transmits
("leaf.T") unless it is opaque. A path that was scattered n_s times by each channel s carries the optical
weight prod_s optics_s ** n_s; the tuple (n_s) is its history.
"""

import re
from collections import Counter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlidar._fields.checks import concrete, fixed_array, has_tracers
from jaxlidar.optics.phase import AbstractPhase
from jaxlidar.optics.spectra import reflectance_at
from jaxlidar.planning.config import Scatterer
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.surfaces import AbstractSheet, check_sum
from jaxlidar.sensors.lidar import Lidar


class MaterialOptics(NamedTuple):
    """Reflectance and transmittance (None: opaque) of one material, each (wavelengths,)."""

    name: str
    reflectance: Float[Array, "wavelengths"]
    transmittance: Float[Array, "wavelengths"] | None

    @property
    def transmits(self) -> bool:
        """True unless the transmittance is zero at all wavelengths; a traced one may become positive."""
        transmittance = None if self.transmittance is None else concrete(self.transmittance)
        return self.transmittance is not None and (transmittance is None or bool(np.any(transmittance > 0)))


class ScattererChannels(NamedTuple):
    """Numbered materials and channels. `surfaces` has the ground first, if there is one, then the plates."""

    materials: tuple[str, ...]
    channels: tuple[str, ...]
    leaf: Scatterer | None
    bark: Scatterer | None
    surfaces: tuple[Scatterer, ...]


def surface_names(scene: Scene) -> list[str]:
    """Return the names of the scene's surfaces, in their order; repeated names are numbered from 1."""
    names = [surface.name for surface in scene.surfaces]
    # A name that occurs once is not numbered, as "ground" and the plate of most scenes.
    totals, seen = Counter(names), Counter()
    numbered = []
    for name in names:
        seen[name] += 1
        numbered.append(name if totals[name] == 1 else f"{name} {seen[name]}")
    return numbered


def unnumbered(name: str) -> str:
    """Return the name of a surface without the number that tells it from others of its name."""
    return re.sub(r" \d+$", "", name)


def scene_optics(lidar: Lidar, scene: Scene) -> list[MaterialOptics]:
    """Return the optics of every material at the lidar's wavelengths: leaf, bark, ground, plates.

    Where leaves transmit straight on (regular transmittance, without scattering), transmitted light stays on
    its ray and extinction is scaled by (1 - T): a collision then reflects R / (1 - T), and nothing is
    transmitted.
    """
    wavelength, optics = lidar.wavelength, []
    canopy = scene.canopy
    if canopy is not None and canopy.voxels.leaf is not None:
        r, t = canopy.leaf_optics(wavelength)
        if canopy.transmission == "straight":
            # T = 1 would divide by zero; such leaves have no extinction, so that the quotient never counts.
            optics.append(MaterialOptics("leaf", r / jnp.maximum(1.0 - t, 1e-6), None))
        else:
            # A phase function redirects all scattered light: one channel, with the albedo as its reflectance.
            optics.append(MaterialOptics("leaf", r, None if isinstance(canopy.leaf, AbstractPhase) else t))
    if canopy is not None and canopy.voxels.bark is not None:
        optics.append(MaterialOptics("bark", canopy.bark_reflectance(wavelength), None))
    for name, surface in zip(surface_names(scene), scene.surfaces):
        r = reflectance_at(surface.brightest, wavelength, f"{name} reflectance")
        t = None
        if isinstance(surface, AbstractSheet):
            t = reflectance_at(surface.transmittance, wavelength, f"{name} transmittance")
            check_sum(f"{name} reflectance + transmittance", r, t)
        optics.append(MaterialOptics(name, r, t))
    return optics


def number_channels(optics: list[MaterialOptics]) -> ScattererChannels:
    """Number materials and channels. A transmittance that is zero at all wavelengths gets no channel."""
    channels: list[str] = []
    scatterers: dict[str, Scatterer] = {}
    for material, material_optics in enumerate(optics):
        name = material_optics.name
        channels.append(f"{name}.R")
        reflection, transmission = len(channels) - 1, -1
        if material_optics.transmits:
            channels.append(f"{name}.T")
            transmission = len(channels) - 1
        scatterers[name] = Scatterer(material, reflection, transmission)
    surfaces = tuple(s for name, s in scatterers.items() if name not in ("leaf", "bark"))
    return ScattererChannels(
        tuple(scatterers), tuple(channels), scatterers.get("leaf"), scatterers.get("bark"), surfaces
    )


def channel_optics(
    lidar: Lidar, scene: Scene, channels: tuple[str, ...]
) -> Float[Array, "channels wavelengths"]:
    """Return the reflectance or transmittance of every channel, by wavelength."""
    values: dict[str, Array] = {}
    for material_optics in scene_optics(lidar, scene):
        values[f"{material_optics.name}.R"] = material_optics.reflectance
        if material_optics.transmittance is not None:
            values[f"{material_optics.name}.T"] = material_optics.transmittance
    rows = [values[channel] for channel in channels]
    if not rows:
        return jnp.zeros((0, lidar.wavelength.size))
    # By NumPy where values are known: JAX would compile a program for every shape.
    return jnp.stack(rows) if has_tracers(rows) else jax.device_put(np.stack(rows))


def largest_albedo(optics: list[MaterialOptics], xp: Any = np) -> Any:
    """Return the largest R + T of any material and wavelength; 1 where its value is being traced.

    With `xp` = jax.numpy a traced value counts as it is.
    """
    albedos: list[Any] = [0.0]
    for material_optics in optics:
        terms = [a for a in (material_optics.reflectance, material_optics.transmittance) if a is not None]
        if xp is jnp:
            albedos.append(jnp.max(sum(fixed_array(a, jnp) for a in terms)))
            continue
        values = [value for value in map(concrete, terms) if value is not None]
        albedos.append(float(np.max(sum(values))) if len(values) == len(terms) else 1.0)
    return max(albedos) if xp is np else jnp.max(jnp.stack([jnp.asarray(a) for a in albedos]))


def reflection_probability(optics: list[MaterialOptics]) -> float:
    """Return the probability of sampling reflection rather than transmission: about the mean of R / (R + T).

    Any value in (0, 1) is unbiased; this one gives both lobes weights near one. It is kept within 0.2 to 0.8,
    so that no weight becomes large, and rounded to a tenth, so that small changes of optics leave the random
    paths as they are.
    """
    fractions = []
    for material_optics in optics:
        r = concrete(material_optics.reflectance)
        t = None if material_optics.transmittance is None else concrete(material_optics.transmittance)
        if r is not None and t is not None and np.any(t > 0):
            fractions.append(float(np.sum(r) / np.sum(r + t)))
    return round(min(max(float(np.mean(fractions)), 0.2), 0.8), 1) if fractions else 0.5
