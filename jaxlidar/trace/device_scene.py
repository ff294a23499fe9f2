"""The device scene: beam, voxels, surfaces and laws as arrays on the accelerator, the input of the tracer.

The aim point, where the axis of the beam meets the reference plane, is the origin of its coordinates. It
joins the arrays and, as static fields, the `TraceConfig` and the indices of laws: programs that trace light
take one `DeviceScene` and a random key.

Throughout `jaxlidar.trace`:

    scene           a `DeviceScene`
    p               a `Photons`, the state of some photons
    x, w            position, and direction of travel (unit vector)
    v               direction towards the sensor
    k, tau          extinction coefficient (1/m), optical depth
    R, T            reflectance, transmittance of a material
    q               probability of sampling reflection rather than transmission
    channel         reflection, or transmission, by one material ("leaf.R"); no detector channel
    history         number of scatterings by each channel along a path (`trace.photons.histories`)
    number          index of a law, material, surface, channel or history in the tuple or table of these
    lane            number of a photon in its batch, which its random numbers depend on
    ratio           attached likelihood ratio: one in value, with a derivative (`trace.photons.photons`)
    parameter       theta_j of a Jacobian; "slopes" are derivatives with respect to the parameters
                    (`trace.derivatives.extinction_slopes`), but `slope_x` and `slope_y` those of terrain
"""

import dataclasses
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxlidar._jax.programs import Program
from jaxlidar._vectors import Scalar, Vec, vec
from jaxlidar.optics.laws import AbstractLaw, Lambertian
from jaxlidar.optics.phase import AbstractPhase
from jaxlidar.planning.channels import channel_optics
from jaxlidar.planning.config import PathLimits, TimeBins, TraceConfig
from jaxlidar.planning.setup import Setup
from jaxlidar.scenes.mesh_surface import MeshTree, build_mesh_tree
from jaxlidar.scenes.scene import Scene
from jaxlidar.sensors.lidar import Lidar
from jaxlidar.trace.derivatives.extinction_slopes import ExtinctionSlopes
from jaxlidar.trace.first.footprint import Beam, make_beam
from jaxlidar.trace.first.shot_views import ShotViews
from jaxlidar.trace.march.surfaces import TracedSurface, traced_surfaces
from jaxlidar.trace.march.voxel_traversal import Medium, VoxelBox, make_medium, occupied_box, vertical_depths
from jaxlidar.trace.photons.histories import Histories, histories
from jaxlidar.trace.photons.photons import LastScattering, Photons

# Index of the cosine law, by which facets, diffusely transmitting plates and most surfaces send light on.
COSINE_LAW = 0

Derivatives = Literal["all", "forward", "none"]


class DeviceScene(eqx.Module):
    """The input of all programs that trace light. Made by `build_device_scene`.

    The geometry:

    - `beam`, `medium`, `surfaces`: footprint, voxels (None: no canopy), and surfaces, ground first, then
      plates, then the materials of meshes.
    - `meshes`: the triangles of all meshes; None without any.
    - `laws`: the laws by which photons are sent on; `surface_laws`, `leaf_law`, `bark_law` are indices of
      these.
    - `depth_above`: optical depth straight up from every voxel's upper face, for photons of a beam at nadir;
      else None.
    - `occupied_box`: the block of the grid that holds all voxels with any extinction; None where derivatives
      in forward mode see all of the grid.

    The plan:

    - `config`: the static configuration. `limits`, `bins`: path limits and time bins, with arrays as numbers.
    - `orders`: number of scatterings that are followed.
    - `derivatives`: the derivatives that may be taken: "all", "forward" alone, or "none". The fewer, the
      faster.

    The tally:

    - `next_history`: index of the history after one more scattering, by history and channel.
    - `optics`: of every channel, by wavelength, where optics are applied while light is traced, because light
      is distinguished by its entry node, or because histories would be too many; None where histories keep
      them.
    - `straight_transmittance`: by wavelength, where leaves transmit straight on, so that extinction, and with
      it the trace, depends on wavelength; else None.
    - `shot_views`: shots that share light and each see a fraction of it; None for a single shot.
    - `slopes`: derivatives of extinction, where score functions are asked for; else None.
    """

    beam: Beam
    medium: Medium | None
    surfaces: tuple[TracedSurface, ...]
    laws: tuple[AbstractLaw | AbstractPhase, ...]
    depth_above: Float[Array, "cells"] | None
    occupied_box: VoxelBox | None
    next_history: Int[Array, "histories channels"]
    limits: PathLimits
    bins: TimeBins
    orders: Int[Array, ""]
    config: TraceConfig = eqx.field(static=True)
    surface_laws: tuple[int, ...] = eqx.field(static=True)
    leaf_law: int = eqx.field(static=True)
    bark_law: int = eqx.field(static=True)
    optics: Float[Array, "channels wavelengths"] | None = None
    straight_transmittance: Float[Array, "wavelengths"] | None = None
    shot_views: ShotViews | None = None
    derivatives: Derivatives = eqx.field(static=True, default="all")
    slopes: ExtinctionSlopes | None = None
    meshes: MeshTree | None = None

    @property
    def reverse(self) -> bool:
        """True if reverse-mode derivatives may be taken."""
        return self.derivatives == "all"

    @property
    def n_plates(self) -> int:
        """Number of plates."""
        return sum(surface.is_plate for surface in self.surfaces)

    @property
    def first_histories(self) -> Histories:
        """Histories of order one."""
        return histories(len(self.config.channels), self.config.first_degree)

    @property
    def histories(self) -> Histories:
        """Histories of all orders."""
        return histories(len(self.config.channels), self.config.degree)

    def with_leaf_transmittance(self, transmittance: Float[Array, ""]) -> "DeviceScene":
        """Return the scene where leaves transmit that much straight on: extinction is scaled by (1 - T)."""
        assert self.medium is not None
        # Light that is transmitted straight on is as if it had met no leaf.
        medium = self.medium.with_leaf_scaled(1.0 - transmittance)
        depth_above = None if self.depth_above is None else vertical_depths(medium)
        return dataclasses.replace(self, medium=medium, depth_above=depth_above, straight_transmittance=None)

    def longest_flight(self, p: Photons) -> Float[Array, "photons"]:
        """Return how far, m, photons may fly so that their light can still be recorded."""
        # A flight so long that its light cannot be back in time needs no march.
        recorded = self.beam.longest_flight(p.x, p.w, self.limits.max_path - p.path)
        return jnp.minimum(recorded, self.limits.max_flight)

    def history_after(
        self, history: Int[Array, "*photons"], channel: Int[Array, "*photons"] | int
    ) -> Int[Array, "*photons"]:
        """Return the history after one more scattering; unchanged where the channel is -1."""
        if isinstance(channel, int):
            return self.next_history[history, channel] if channel >= 0 else history
        # Channel -1 must not index from the end of the table.
        grown = self.next_history[history, jnp.maximum(channel, 0)]
        return jnp.where(channel >= 0, grown, history)

    def if_differentiated(self, last_scattering: LastScattering) -> LastScattering | None:
        """Return how photons were sent on; None where no derivatives are taken: nothing else needs it."""
        return None if self.derivatives == "none" else last_scattering

    def direction_density(self, last_scattering: LastScattering, w: Vec) -> Scalar:
        """Return the density (1/sr) with which photons would have been sent along `w`; at least 1e-6.

        Its derivative is that by `w` alone: photons have that by the parameters of laws in their weight since
        they were sent on.
        """
        laws = jax.tree.map(jax.lax.stop_gradient, self.laws)
        density = _density(laws[0], last_scattering, w)
        for number, law in enumerate(laws[1:], 1):
            density = jnp.where(last_scattering.law == number, _density(law, last_scattering, w), density)
        # A reparametrised direction may lie where the law sends nothing; the floor keeps the quotient of
        # densities finite.
        return jnp.maximum(density, 1e-6)


def _density(law: AbstractLaw | AbstractPhase, last_scattering: LastScattering, w: Vec) -> Scalar:
    if isinstance(law, AbstractPhase):
        return law.density(last_scattering.incident, w)
    return law.density(last_scattering.incident, last_scattering.normal, w)


def build_device_scene(setup: Setup, *, derivatives: Derivatives = "all") -> DeviceScene:
    """Build the device scene of a setup.

    It does not depend on wavelength, unless optics are applied while light is traced, or leaves transmit
    straight on.
    """
    return complete_device_scene(
        compiled_geometry(*geometry_arguments(setup, derivatives)), setup, derivatives
    )


def geometry_arguments(
    setup: Setup, derivatives: Derivatives
) -> tuple[Lidar, Scene, PathLimits, TimeBins, Int[Array, ""], TraceConfig]:
    """Return the arguments of `compiled_geometry`."""
    limits, bins = jax.tree.map(jnp.asarray, (setup.plan.limits, setup.plan.bins))
    orders = jnp.asarray(setup.plan.orders, jnp.int32)
    config = setup.plan.config
    # Orders are rounded up to sizes that programs share, which costs little time but memory for each tangent.
    if derivatives != "none":
        # Each tangent has its own tally of histories: no room for orders beyond the last.
        config = dataclasses.replace(config, degree=setup.plan.degree)
    return _without_spectrum(setup.lidar), setup.scene, limits, bins, orders, config


def complete_device_scene(geometry: DeviceScene, setup: Setup, derivatives: Derivatives) -> DeviceScene:
    """Add what `compiled_geometry` leaves out: optics, where the trace needs them."""
    optics, transmittance, canopy = None, None, setup.scene.canopy
    if not setup.plan.config.keeps_histories:
        optics = channel_optics(setup.lidar, setup.scene, setup.plan.config.channels)
    if canopy is not None and canopy.is_straight:
        transmittance = canopy.leaf_optics(setup.lidar.wavelength)[1]
    # `tree_at`, because the geometry may be made of `jax.ShapeDtypeStruct`s, which constructors refuse.
    fields = (optics, transmittance)
    scene = eqx.tree_at(
        lambda s: (s.optics, s.straight_transmittance), geometry, fields, is_leaf=lambda x: x is None
    )
    if derivatives == "none":
        return scene
    # Leaves in empty voxels around the occupied ones would attenuate flights, too. Reverse mode replays these
    # without the box (`trace.derivatives.replay`).
    box = scene.occupied_box if derivatives == "all" else None
    return dataclasses.replace(scene, derivatives=derivatives, occupied_box=box)


def _without_spectrum(lidar: Lidar) -> Lidar:
    """Return the lidar with one wavelength: the geometry is the same for all, and shares one program."""
    one = jnp.ones((1,), lidar.wavelength.dtype)
    return eqx.tree_at(lambda v: (v.wavelength, v.energy, v.efficiency), lidar, (one, one, one))


def _build_geometry(
    lidar: Lidar,
    scene: Scene,
    limits: PathLimits,
    bins: TimeBins,
    orders: Int[Array, ""],
    config: TraceConfig,
) -> DeviceScene:
    """Build the geometry of a device scene.

    1. Take the aim point as origin.
    2. Lay out the voxels and the surfaces.
    3. Number the laws by which these send light on, the cosine law as 0.
    4. Compute the tables of the march: optical depths straight up, the box of occupied voxels; and that of
       next histories.
    """
    # Coordinates relative to the aim point: map coordinates of millions of m would leave single precision no
    # digits for voxels.
    aim = lidar.aim_point
    # Photons remember their law by number: a Lambertian one, the most common, is always number zero.
    laws: list[AbstractLaw | AbstractPhase] = [Lambertian()]

    def law_number(law: AbstractLaw | AbstractPhase | None) -> int:
        if law is None or isinstance(law, Lambertian):
            return COSINE_LAW
        laws.append(law)
        return len(laws) - 1

    medium, leaf_law, bark_law = None, COSINE_LAW, COSINE_LAW
    if scene.canopy is not None:
        medium = make_medium(scene.canopy, aim)
        leaf_law, bark_law = law_number(medium.leaf_phase), law_number(medium.bark_phase)
    surfaces = traced_surfaces(scene, aim, config.covers_fully)
    meshes = build_mesh_tree(scene.meshes, scene.period).moved(-aim) if scene.meshes else None
    surface_laws = tuple(law_number(s.law) for s in surfaces)
    # Rays of the first order sum their depths on their way down. A table that nothing reads is not free: its
    # cotangent is a sum of zeros over the map, which XLA evaluates for seconds while it compiles.
    depth_above = None
    if medium is not None and config.vertical and config.follows_higher_orders:
        depth_above = vertical_depths(medium)
    return DeviceScene(
        beam=make_beam(lidar),
        medium=medium,
        surfaces=surfaces,
        laws=tuple(laws),
        depth_above=depth_above,
        occupied_box=None if medium is None else occupied_box(medium),
        next_history=jnp.asarray(histories(len(config.channels), config.degree).next_history),
        limits=limits,
        bins=bins,
        orders=orders,
        config=config,
        surface_laws=surface_laws,
        leaf_law=leaf_law,
        bark_law=bark_law,
        derivatives="none",
        meshes=meshes,
    )


compiled_geometry = Program(_build_geometry)


def aim_at(scene: DeviceScene, lidar: Lidar, offset: Float[Array, "axes"]) -> DeviceScene:
    """Return the scene for a lidar that aims `offset` m farther to the east and to the north, and up.

    Map and terrain are shifted, not built again: a shot costs the same over a map of any size.
    """
    # The aim point is the origin: the scene moves against the shot.
    back = -jnp.concatenate([offset, jnp.zeros_like(offset[: 3 - offset.size])])
    medium = scene.medium
    if medium is not None:
        medium = eqx.tree_at(lambda m: m.origin, medium, medium.origin + back)
    surfaces = tuple(surface.moved(back) for surface in scene.surfaces)
    meshes = None if scene.meshes is None else scene.meshes.moved(back)
    return dataclasses.replace(scene, beam=make_beam(lidar), medium=medium, surfaces=surfaces, meshes=meshes)


def not_scattered(like: Scalar) -> LastScattering:
    """Return the `LastScattering` of photons that come from the lidar: with no normal."""
    zero = vec(jnp.zeros_like(like) for _ in range(3))
    return LastScattering(jnp.full(like.shape, COSINE_LAW, jnp.int32), zero, zero)
