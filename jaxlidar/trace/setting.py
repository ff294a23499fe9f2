"""The scene as the tracer sees it: beam, voxels, surfaces and laws, relative to the aim point."""

import dataclasses
from collections.abc import Callable
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxlidar._programs import Program
from jaxlidar._vectors import Scalar, Vec, vec
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.optics.laws import AbstractLaw, Lambertian
from jaxlidar.optics.phase import AbstractPhase
from jaxlidar.planning.plan import Plan
from jaxlidar.planning.scatterers import letter_values
from jaxlidar.planning.setup import Setup
from jaxlidar.planning.trace_plan import Bins, TracePlan
from jaxlidar.scenes.scene import Scene
from jaxlidar.trace.footprint import Beam, beam_of
from jaxlidar.trace.histories import Histories, histories
from jaxlidar.trace.march import Box, Medium, columns, medium_of, occupied
from jaxlidar.trace.photons import Photons, Scattering
from jaxlidar.trace.scores import Scores
from jaxlidar.trace.surfaces import Surface, surfaces_of
from jaxlidar.trace.viewing import Viewing

# Number of the law by which facets, diffusely transmitting plates and most surfaces send light on: the first.
COSINE_LAW = 0

Derivatives = Literal["all", "forward", "none"]


class Sizes(NamedTuple):
    """What of a plan a trace depends on, beside its `TracePlan` and its bins.

    - `rays`, `photons`: of a batch. - `smooth`, `shifted`: whether a quadrature rule takes the place of the
      rays, and whether each batch shifts them at random. - `random`: whether anything is drawn.
    - `specular`: whether mirrors return light to the sensor. - `degree`, `first_degree`: most scatterings of
      a history.
    """

    rays: int
    photons: int
    smooth: bool
    shifted: bool
    random: bool
    specular: bool
    degree: int
    first_degree: int


def sizes_of(plan: Plan) -> Sizes:
    """The sizes of a plan."""
    return Sizes(
        plan.n_rays,
        plan.n_photons,
        plan.smooth_footprint,
        plan.random_footprint,
        plan.is_random,
        "specular return" not in plan.off,
        plan.degree,
        plan.first_degree,
    )


class Setting(eqx.Module):
    """What the first and the higher orders share. Programs that trace are compiled for its sizes alone.

    - `beam`, `medium`, `surfaces`: the geometry; ground first, then plates.
    - `laws`: by which photons are sent on. `surface_laws`, `leaf_law`, `bark_law`: numbers of them.
    - `plan`, `bins`: of the plan, with arrays for numbers.
    - `sizes`: the rest of the plan.
    - `column`: optical depth straight up from every voxel, for a beam at nadir.
    - `occupied`: the box that holds all voxels with any extinction.
    - `successor`: of every history, for every letter.
    - `optics`: of every letter, by wavelength, where they are applied while light is traced, because it is
      told apart by its place of entry (see `jaxlidar.trace.nodes`), or because histories would be too many;
      None where histories keep them.
    - `viewing`: shots that share light and see parts of it; None where there is one, or no shots.
    - `derivatives`: those that the trace may be asked for, "all", those "forward" or "none": the fewer, the
      faster.
    - `scores`: derivatives of extinction, where those of the waveform by them are asked for.
    """

    beam: Beam
    medium: Medium | None
    surfaces: tuple[Surface, ...]
    laws: tuple[AbstractLaw | AbstractPhase, ...]
    column: Float[Array, "cells"] | None
    occupied: Box | None
    successor: Int[Array, "histories letters"]
    plan: TracePlan
    bins: Bins
    surface_laws: tuple[int, ...] = eqx.field(static=True)
    leaf_law: int = eqx.field(static=True)
    bark_law: int = eqx.field(static=True)
    sizes: Sizes = eqx.field(static=True)
    optics: Float[Array, "letters wavelengths"] | None = None
    viewing: Viewing | None = None
    derivatives: Derivatives = eqx.field(static=True, default="all")
    scores: Scores | None = None

    @property
    def reverse(self) -> bool:
        """Whether derivatives are taken in reverse, too."""
        return self.derivatives == "all"

    @property
    def short(self) -> Histories:
        """Histories of order one."""
        return histories(len(self.plan.letters), self.sizes.first_degree)

    @property
    def table(self) -> Histories:
        """Histories of all orders."""
        return histories(len(self.plan.letters), self.sizes.degree)

    def thinned(self, transmittance: Float[Array, ""]) -> "Setting":
        """The setting where leaves transmit so much straight on: as if there were fewer."""
        assert self.medium is not None
        medium = self.medium.thinned(1.0 - transmittance)
        column = None if self.column is None else columns(medium)
        return dataclasses.replace(self, medium=medium, column=column)

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

    def kept(self, sent: Scattering) -> Scattering | None:
        """How photons are sent on, where derivatives ask for it."""
        return None if self.derivatives == "none" else sent

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


def setting_of(setup: Setup, *, derivatives: Derivatives = "all") -> Setting:
    """The setting of a setup, without wavelengths, unless optics are applied while light is traced."""
    return _completed(_set_out(*_arranged(setup, derivatives)), setup, derivatives)


def setting_ahead(setup: Setup) -> tuple[Setting, Callable[[], Setting]]:
    """A setting without derivatives, maybe of shapes alone, and the function that gives it with its numbers.

    It has shapes alone where the program that makes the numbers has yet to be compiled. That begins, and what
    takes the setting can be compiled beside it.
    """
    arguments = _arranged(setup, "none")

    def made() -> Setting:
        return _completed(_set_out(*arguments), setup, "none")

    if _set_out.is_compiled(*arguments):
        setting = made()
        return setting, lambda: setting
    return _completed(_set_out.begin(*arguments), setup, "none"), made


def _arranged(setup: Setup, derivatives: Derivatives) -> tuple[Lidar, Scene, TracePlan, Bins, Sizes]:
    """The arguments of `_arrange`."""
    trace, bins = jax.tree.map(jnp.asarray, (setup.plan.trace, setup.plan.bins))
    sizes = sizes_of(setup.plan)
    if derivatives != "none":
        # Every derivative has histories of its own: none beyond the last order.
        sizes = sizes._replace(degree=setup.plan.least_degree)
    return _without_spectrum(setup.lidar), setup.scene, trace, bins, sizes


def _completed(setting: Setting, setup: Setup, derivatives: Derivatives) -> Setting:
    letters = setup.plan.trace.letters
    if not setup.plan.trace.keeps_histories:
        optics = letter_values(setup.lidar, setup.scene, letters)
        setting = eqx.tree_at(lambda s: s.optics, setting, optics, is_leaf=lambda x: x is None)
    return setting if derivatives == "none" else dataclasses.replace(setting, derivatives=derivatives)


def straight_transmittance(setup: Setup) -> Float[Array, "wavelengths"] | None:
    """What leaves transmit straight on, at every wavelength; None where they do not.

    Extinction then depends on the wavelength.
    """
    canopy = setup.scene.canopy
    if canopy is None or not canopy.is_straight:
        return None
    return canopy.leaf_optics(setup.lidar.wavelength)[1]


def _without_spectrum(lidar: Lidar) -> Lidar:
    """The lidar with one wavelength: geometry is the same for all."""
    one = jnp.ones((1,), lidar.wavelength.dtype)
    return eqx.tree_at(lambda v: (v.wavelength, v.energy, v.efficiency), lidar, (one, one, one))


def _arrange(
    lidar: Lidar,
    scene: Scene,
    plan: TracePlan,
    bins: Bins,
    sizes: Sizes,
) -> Setting:
    aim = jnp.concatenate([lidar.position, jnp.zeros_like(lidar.position[:1])])
    laws: list[AbstractLaw | AbstractPhase] = [Lambertian()]

    def number(law: AbstractLaw | AbstractPhase | None) -> int:
        if law is None or isinstance(law, Lambertian):
            return COSINE_LAW
        laws.append(law)
        return len(laws) - 1

    medium, leaf_law, bark_law = None, COSINE_LAW, COSINE_LAW
    if scene.canopy is not None:
        medium = medium_of(scene.canopy, aim)
        leaf_law, bark_law = number(medium.leaf_phase), number(medium.bark_phase)
    surfaces = surfaces_of(scene, aim)
    surface_laws = tuple(number(s.law) for s in surfaces)
    return Setting(
        beam=beam_of(lidar),
        medium=medium,
        surfaces=surfaces,
        laws=tuple(laws),
        column=None if medium is None or not plan.vertical else columns(medium),
        occupied=None if medium is None else occupied(medium),
        successor=jnp.asarray(histories(len(plan.letters), sizes.degree).successor),
        plan=plan,
        bins=bins,
        surface_laws=surface_laws,
        leaf_law=leaf_law,
        bark_law=bark_law,
        sizes=sizes,
        derivatives="none",
    )


_set_out = Program(_arrange)


def aimed(setting: Setting, lidar: Lidar, by: Float[Array, "2"]) -> Setting:
    """The setting for a lidar that aims elsewhere, `by` m to the east and to the north, and otherwise.

    What the map and the terrain cost is not computed again: a shot costs the same over a map of any size.
    """
    back = -jnp.concatenate([by, jnp.zeros_like(by[:1])])
    medium = setting.medium
    if medium is not None:
        medium = eqx.tree_at(lambda m: m.origin, medium, medium.origin + back)
    surfaces = tuple(surface.moved(back) for surface in setting.surfaces)
    return dataclasses.replace(setting, beam=beam_of(lidar), medium=medium, surfaces=surfaces)


def unscattered(like: Scalar) -> Scattering:
    """The `Scattering` of photons that come from the lidar: about no normal."""
    nowhere = vec(jnp.zeros_like(like) for _ in range(3))
    return Scattering(jnp.full(like.shape, COSINE_LAW, jnp.int32), nowhere, nowhere)
