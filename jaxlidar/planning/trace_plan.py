"""What a trace must know: time bins, scatterers and their letters, lengths, and the sizes of all loops.

Compiled programs depend on what is static here, names and sizes. Numbers are their arguments: a setting has
arrays in their place (see `jaxlidar.trace.setting`).
"""

from typing import NamedTuple, final

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

# Elements up to which the pulse is a matrix of fine bins and samples; beyond, it is a band.
DENSE = 1 << 22
# Bins over which a return at an instant is spread.
KERNEL = 3


@final
class Bins(eqx.Module):
    """Fine time bins, with margins at both ends that collect what falls outside.

    - `start`: centre of the first bin, ns.
    - `width`: of a bin, ns.
    - `count`: bins within the window.
    - `row`: the most bins that one deposit spans.
    - `kernel`: bins over which a return at an instant is spread.
    """

    start: float
    width: float
    count: int = eqx.field(static=True)
    row: int = eqx.field(static=True)
    kernel: int = eqx.field(static=True, default=KERNEL)

    @property
    def kernel_variance(self) -> float:
        """Second moment of the kernel, a B-spline, in bins^2."""
        return self.kernel / 12

    @property
    def padded(self) -> int:
        """Number of bins with the margins."""
        return self.count + 2 * self.row

    def position(self, time: Float[Array, "*s"]) -> Float[Array, "*s"]:
        """Time in units of bins, clipped to the margins; integers are centres of bins."""
        return jnp.clip((time - self.start) / self.width, -self.row, self.count + self.row)

    def trimmed(
        self, padded: Float[Array, "*s padded"]
    ) -> tuple[Float[Array, "*s bins"], Float[Array, "*s"]]:
        """Without the margins, and what these hold together: all that falls outside."""
        inside = padded[..., self.row : self.row + self.count]
        before, after = padded[..., : self.row], padded[..., self.row + self.count :]
        return inside, jnp.sum(before, axis=-1) + jnp.sum(after, axis=-1)


class Scatterer(NamedTuple):
    """Numbers of a material and of its letters; -1 where it has no such letter."""

    material: int
    reflected: int
    transmitted: int


@final
class TracePlan(eqx.Module):
    """Everything that the tracer must know of a plan. Made by `jaxlidar.plan`.

    - `materials`, `letters`: names, in order.
    - `leaf`, `bark`, `surfaces`: the scatterers.
    - `full_cover`, `mirrors`: for each surface, whether no ray slips through, and whether it is a mirror.
    - `has_ground`, `hotspot`: whether the scene has a ground, and a canopy with the hot spot.
    - `vertical`: whether the beam is at nadir.
    - `upstream`: where rays start, m above the reference plane along the axis.
    - `first_steps`, `march_steps`: bounds on the faces crossed by a ray of order one, and by a flight.
    - `max_step`, `max_flight`: longest stretch of order one, and longest flight, m.
    - `last`: longest path to the sensor that is recorded, m relative to the way to the reference plane.
    - `lobe`: probability with which reflection is chosen over transmission.
    - `orders`: scatterings followed. `order_steps`: the length of the loop over them.
    - `ends`: points of each flight from which light returns.
    - `drawn_first`: whether order one returns from drawn collisions, as the others do.
    - `independent`: whether photons draw independent numbers.
    - `keeps_histories`: whether histories keep optics apart; else these are applied while light is traced.
    """

    materials: tuple[str, ...] = eqx.field(static=True)
    letters: tuple[str, ...] = eqx.field(static=True)
    leaf: Scatterer | None = eqx.field(static=True)
    bark: Scatterer | None = eqx.field(static=True)
    surfaces: tuple[Scatterer, ...] = eqx.field(static=True)
    full_cover: tuple[bool, ...] = eqx.field(static=True)
    mirrors: tuple[bool, ...] = eqx.field(static=True)
    has_ground: bool = eqx.field(static=True)
    hotspot: bool = eqx.field(static=True)
    vertical: bool = eqx.field(static=True)
    upstream: float
    first_steps: int = eqx.field(static=True)
    march_steps: int = eqx.field(static=True)
    max_step: float
    max_flight: float
    last: float
    lobe: float
    orders: int
    order_steps: int = eqx.field(static=True)
    ends: int = eqx.field(static=True)
    drawn_first: bool = eqx.field(static=True)
    independent: bool = eqx.field(static=True)
    keeps_histories: bool = eqx.field(static=True, default=True)
