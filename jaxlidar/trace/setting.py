"""The scene as the tracer sees it: beam, voxels, surfaces and laws, relative to the aim point."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxlidar._vectors import Scalar, Vec, vec
from jaxlidar.optics.laws import AbstractLaw, Lambertian
from jaxlidar.optics.phase import AbstractPhase
from jaxlidar.planning.setup import Setup
from jaxlidar.planning.trace_plan import Bins, TracePlan
from jaxlidar.trace.footprint import Beam, beam_of
from jaxlidar.trace.histories import Histories, histories
from jaxlidar.trace.march import Box, Medium, columns, medium_of, occupied
from jaxlidar.trace.photons import Photons, Scattering
from jaxlidar.trace.surfaces import Surface, surfaces_of

# Number of the law by which facets, diffusely transmitting plates and most surfaces send light on: the first.
COSINE_LAW = 0


class Setting(eqx.Module):
    """What the first and the higher orders share.

    - `beam`, `medium`, `surfaces`: the geometry; ground first, then plates.
    - `laws`: by which photons are sent on. `surface_laws`, `leaf_law`, `bark_law`: numbers of them.
    - `plan`, `bins`: sizes.
    - `short`, `table`: histories of order one, and of all orders.
    - `column`: optical depth straight up from every voxel, for a beam at nadir.
    - `occupied`: the box that holds all voxels with any extinction.
    - `successor`: of every history, for every letter.
    """

    beam: Beam
    medium: Medium | None
    surfaces: tuple[Surface, ...]
    laws: tuple[AbstractLaw | AbstractPhase, ...]
    column: Float[Array, "cells"] | None
    occupied: Box | None
    successor: Int[Array, "histories letters"]
    surface_laws: tuple[int, ...] = eqx.field(static=True)
    leaf_law: int = eqx.field(static=True)
    bark_law: int = eqx.field(static=True)
    plan: TracePlan = eqx.field(static=True)
    bins: Bins = eqx.field(static=True)
    short: Histories = eqx.field(static=True)
    table: Histories = eqx.field(static=True)

    def budget(self, p: Photons) -> Float[Array, "photons"]:
        """How far photons may fly, m, so that their light can still be recorded."""
        return jnp.minimum(self.beam.budget(p.x, p.w, self.plan.last - p.path), self.plan.max_flight)

    def grow(
        self, history: Int[Array, "*photons"], letter: Int[Array, "*photons"] | int
    ) -> Int[Array, "*photons"]:
        """The history with one more scattering; unchanged where the letter is -1."""
        if isinstance(letter, int):
            return self.successor[history, letter] if letter >= 0 else history
        grown = self.successor[history, jnp.maximum(letter, 0)]
        return jnp.where(letter >= 0, grown, history)

    def density(self, sent: Scattering, w: Vec) -> Scalar:
        """Probability per steradian with which photons would have been sent along `w`; at least 1e-6."""
        density = _density(self.laws[0], sent, w)
        for number, law in enumerate(self.laws[1:], 1):
            density = jnp.where(sent.law == number, _density(law, sent, w), density)
        return jnp.maximum(density, 1e-6)


def _density(law: AbstractLaw | AbstractPhase, sent: Scattering, w: Vec) -> Scalar:
    if isinstance(law, AbstractPhase):
        return law.density(sent.incident, w)
    return law.density(sent.incident, sent.normal, w)


def setting_of(setup: Setup, leaf_transmittance: Float[Array, ""] | float = 0.0) -> Setting:
    """The setting of a setup.

    `leaf_transmittance` matters only where the canopy's transmission is straight: extinction is then scaled
    by one minus it.
    """
    lidar, scene, plan = setup.lidar, setup.scene, setup.plan
    aim = jnp.concatenate([lidar.position, jnp.zeros_like(lidar.position[:1])])
    laws: list[AbstractLaw | AbstractPhase] = [Lambertian()]

    def number(law: AbstractLaw | AbstractPhase | None) -> int:
        if law is None or isinstance(law, Lambertian):
            return COSINE_LAW
        laws.append(law)
        return len(laws) - 1

    medium, leaf_law, bark_law = None, COSINE_LAW, COSINE_LAW
    if scene.canopy is not None:
        factor = jnp.asarray(1.0 - leaf_transmittance if scene.canopy.is_straight else 1.0)
        medium = medium_of(scene.canopy, aim, factor)
        leaf_law, bark_law = number(medium.leaf_phase), number(medium.bark_phase)
    surfaces = surfaces_of(scene, aim)
    surface_laws = tuple(number(s.law) for s in surfaces)
    letters = len(plan.trace.letters)
    table = histories(letters, plan.degree)
    return Setting(
        beam=beam_of(lidar),
        medium=medium,
        surfaces=surfaces,
        laws=tuple(laws),
        column=columns(medium) if medium is not None and plan.trace.vertical else None,
        occupied=None if medium is None else occupied(medium),
        successor=jnp.asarray(table.successor),
        surface_laws=surface_laws,
        leaf_law=leaf_law,
        bark_law=bark_law,
        plan=plan.trace,
        bins=plan.bins,
        short=histories(letters, plan.first_degree),
        table=table,
    )


def unscattered(like: Scalar) -> Scattering:
    """The `Scattering` of photons that come from the lidar: about no normal."""
    nowhere = vec(jnp.zeros_like(like) for _ in range(3))
    return Scattering(jnp.full(like.shape, COSINE_LAW, jnp.int32), nowhere, nowhere)
