"""The two halves of what the tracer needs of a plan: a static configuration, and numbers that are traced.

Compiled programs depend on everything in a `TraceConfig`: names, switches, sizes of loops and arrays; and on
the sizes of `TimeBins`. The numbers in `PathLimits`, and the start and the width of `TimeBins`, are arguments
of these programs, so that another height or window compiles nothing. A `Plan` holds all three, with
scalars of NumPy for numbers; a `trace.device_scene.DeviceScene` holds the latter two with JAX arrays.
"""

import dataclasses
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# Fine bins over which a return at an instant is spread: the quadratic B-spline.
KERNEL_BINS = 3
# Second moment of that B-spline, in squared bins.
KERNEL_VARIANCE = KERNEL_BINS / 12


def as_argument(tree: Any) -> Any:
    """Return Python's numbers in a pytree as scalars of NumPy, which compiled programs take as arguments.

    Python's own numbers would be constants of these programs, and each value another program.
    """
    return jax.tree.map(lambda x: np.float64(x) if isinstance(x, int | float) else x, tree)


@final
class TimeBins(eqx.Module):
    """Fine time bins, with margins at both ends that collect what falls outside.

    - `start`: centre of the first bin, ns.
    - `width`: width of a bin, ns.
    - `count`: number of bins within the window.
    - `max_span`: largest number of bins that one deposit spans; also the width of each margin.
    """

    start: float
    width: float
    count: int = eqx.field(static=True)
    max_span: int = eqx.field(static=True)

    @property
    def padded(self) -> int:
        """Number of bins with both margins."""
        return self.count + 2 * self.max_span

    def position(self, time: Float[Array, "*s"]) -> Float[Array, "*s"]:
        """Time in units of bins, clipped to the margins; integers are centres of bins."""
        return jnp.clip((time - self.start) / self.width, -self.max_span, self.count + self.max_span)

    def trim(self, padded: Float[Array, "*s padded"]) -> tuple[Float[Array, "*s bins"], Float[Array, "*s"]]:
        """Split an array over padded bins into the bins within the window, and the sum over both margins."""
        first, last = self.max_span, self.max_span + self.count
        inside = padded[..., first:last]
        before, after = padded[..., :first], padded[..., last:]
        return inside, jnp.sum(before, axis=-1) + jnp.sum(after, axis=-1)


class Scatterer(NamedTuple):
    """Indices of a material, and of its channels of reflection and transmission.

    A channel is -1 where the material has none (opaque materials have no transmission).
    """

    material: int
    reflection: int
    transmission: int


@final
class PathLimits(eqx.Module):
    """Bounds on the paths of rays and photons: scalars of NumPy in a plan, arrays in a device scene.

    - `start_distance`: distance, m, before the reference plane at which all rays start, along the beam.
    - `max_segment`: longest segment, m, of a footprint ray that is deposited at once.
    - `max_flight`: longest flight, m, between two scatterings.
    - `max_path`: longest path to the sensor, m, that is still recorded; relative to twice the range of the
      reference plane.
    - `reflection_probability`: probability of sampling reflection, rather than transmission, where a material
      does both. It does not depend on wavelength, so that histories stay monomials in the optics.
    """

    start_distance: float
    max_segment: float
    max_flight: float
    max_path: float
    reflection_probability: float


@dataclasses.dataclass(frozen=True)
class TraceConfig:
    """Static configuration of the tracer: compiled programs depend on all of it. Part of a `jaxlidar.Plan`.

    What the scene consists of:

    - `materials`, `channels`: names of materials ("leaf", "ground"), and of scatterer channels: one for what
      each material reflects ("leaf.R") and one for what it transmits ("leaf.T").
    - `leaf`, `bark`, `surfaces`: the scatterers; of the surfaces the ground comes first, then plates, then
      materials of meshes.
    - `covers_fully`, `mirrors`: for each surface, True if no ray slips through, and True if it is a mirror.
    - `n_mesh_materials`: number of the surfaces, the last ones, that are materials of meshes.
    - `has_ground`, `hotspot`: True if there is a ground, and if the canopy has the hot spot.
    - `vertical`: True if the beam is at nadir.
    - `returns_specular`: True if mirrors return light to the sensor.

    Sizes of loops and arrays:

    - `max_ray_segments`: bound on the segments of a footprint ray (first order).
    - `max_faces`: bound on the voxel faces that a flight crosses.
    - `order_steps`: length of the loop over orders of scattering; at least `Plan.orders`.
    - `deposits_per_flight`: local estimates (next-event estimation) per free flight: points of each flight
      from which light returns to the sensor.
    - `degree`, `first_degree`: largest number of scatterings and passages through plates in a history, for
      all orders and for order one.
    - `keeps_histories`: True if the response keeps scattering histories; otherwise optics are applied while
      light is traced.
    - `n_rays`, `photons_per_batch`: rays and photons of a batch.

    The footprint:

    - `uses_quadrature`: True if a quadrature rule takes the place of the rays, as over planes.
    - `random_footprint`: True if each batch shifts the rays at random.
    """

    materials: tuple[str, ...]
    channels: tuple[str, ...]
    leaf: Scatterer | None
    bark: Scatterer | None
    surfaces: tuple[Scatterer, ...]
    covers_fully: tuple[bool, ...]
    mirrors: tuple[bool, ...]
    has_ground: bool
    hotspot: bool
    vertical: bool
    returns_specular: bool
    max_ray_segments: int
    max_faces: int
    order_steps: int
    deposits_per_flight: int
    degree: int
    first_degree: int
    keeps_histories: bool
    n_rays: int
    photons_per_batch: int
    uses_quadrature: bool
    random_footprint: bool
    n_mesh_materials: int = 0

    @property
    def follows_higher_orders(self) -> bool:
        """True if light is followed beyond its first scattering."""
        return self.order_steps >= 2

    @property
    def photons_traced(self) -> int:
        """Photons that a batch traces: none where only one order is followed."""
        return self.photons_per_batch if self.follows_higher_orders else 0

    @property
    def is_random(self) -> bool:
        """True if anything is drawn at random."""
        return self.follows_higher_orders or (self.random_footprint and not self.uses_quadrature)
