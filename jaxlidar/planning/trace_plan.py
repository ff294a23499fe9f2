"""The static shape of a trace: time bins, scatterers and their letters, and the sizes of all loops."""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

# Elements up to which the pulse is a matrix of fine bins and samples; beyond, it is a band.
DENSE = 1 << 22
# Bins over which a return at an instant is spread.
KERNEL = 3


@dataclasses.dataclass(frozen=True)
class Bins:
    """Fine time bins, with margins at both ends that collect what falls outside.

    - `start`: centre of the first bin, ns.
    - `width`: of a bin, ns.
    - `count`: bins within the window.
    - `row`: the most bins that one deposit spans.
    - `kernel`: bins over which a return at an instant is spread.
    """

    start: float
    width: float
    count: int
    row: int
    kernel: int = KERNEL

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


class TracePlan(NamedTuple):
    """Everything that the tracer must know before it is compiled. Made by `jaxlidar.plan`.

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
    - `orders`: scatterings followed.
    - `ends`: points of each flight from which light returns.
    - `drawn_first`: whether order one returns from drawn collisions, as the others do.
    - `independent`: whether photons draw independent numbers.
    """

    materials: tuple[str, ...]
    letters: tuple[str, ...]
    leaf: Scatterer | None
    bark: Scatterer | None
    surfaces: tuple[Scatterer, ...]
    full_cover: tuple[bool, ...]
    mirrors: tuple[bool, ...]
    has_ground: bool
    hotspot: bool
    vertical: bool
    upstream: float
    first_steps: int
    march_steps: int
    max_step: float
    max_flight: float
    last: float
    lobe: float
    orders: int
    ends: int
    drawn_first: bool
    independent: bool
