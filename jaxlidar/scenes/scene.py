"""What the lidar looks at: canopy, plates, ground and atmosphere, and nothing that is not there."""

from typing import Any, final

import equinox as eqx

from jaxlidar.scenes.atmosphere import Atmosphere
from jaxlidar.scenes.canopy import Canopy
from jaxlidar.scenes.surfaces import AbstractGround, AbstractSheet, AbstractSurface


def _as_plates(x: Any) -> Any:
    return x if isinstance(x, AbstractSurface) else tuple(x)


@final
class Scene(eqx.Module):
    """Everything in the beam's way. What is None or empty is not there and costs nothing.

    **Arguments:**

    - `canopy`: a `Canopy` or None (default).
    - `plates`: a tuple of `Plate`, or of other surfaces that light may pass. Default: none.
    - `ground`: a `Ground`, another surface at which light ends, or None (default).
    - `atmosphere`: an `Atmosphere` or None (default).

    **Raises:** TypeError for things of another kind.
    """

    canopy: Canopy | None = None
    plates: tuple[AbstractSheet, ...] = eqx.field(converter=_as_plates, default=())
    ground: AbstractGround | None = None
    atmosphere: Atmosphere | None = None

    def __check_init__(self):
        kinds = {"canopy": Canopy, "ground": AbstractGround, "atmosphere": Atmosphere}
        for field, kind in kinds.items():
            value = getattr(self, field)
            if value is not None and not isinstance(value, kind):
                name = kind.__name__.removeprefix("Abstract")
                raise TypeError(f"{field} is a {type(value).__name__}; admissible is a {name} or None")
        if not isinstance(self.plates, tuple):
            raise TypeError(
                f"plates is a {type(self.plates).__name__}; admissible is a tuple, as in (plate,)"
            )
        for plate in self.plates:
            if not isinstance(plate, AbstractSheet):
                raise TypeError(f"plates has a {type(plate).__name__}; admissible is a tuple of Plate")

    @property
    def surfaces(self) -> tuple[AbstractSurface, ...]:
        """The ground, if any, then the plates: the order in which the tracer counts them."""
        return (() if self.ground is None else (self.ground,)) + self.plates
