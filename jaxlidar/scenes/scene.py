"""The scene that a lidar observes: canopy, plates, ground and atmosphere, each of them optional."""

from typing import Any, final

import equinox as eqx

from jaxlidar.scenes.atmosphere import Atmosphere
from jaxlidar.scenes.canopy import Canopy
from jaxlidar.scenes.surfaces import AbstractGround, AbstractSheet, AbstractSurface


def _as_plates(x: Any) -> Any:
    return x if isinstance(x, AbstractSurface) else tuple(x)


@final
class Scene(eqx.Module):
    """A scene: the canopy, plates, ground and atmosphere that a lidar observes.

    Each part is optional. A part that is None or empty takes no computing time.

    **Arguments:**

    - `canopy`: a `Canopy`, or None. Default None.
    - `plates`: a sequence of `Plate`, or of other `AbstractSheet`. Default ().
    - `ground`: a `Ground`, another `AbstractGround`, or None. Default None.
    - `atmosphere`: an `Atmosphere`, or None. Default None.

    **Raises:** TypeError for an argument of another type.

    **Example:**

    >>> import jaxlidar as jl
    >>> plate = jl.Plate(height=5.0, reflectance=0.4, transmittance=0.4, coverage=0.5)
    >>> scene = jl.Scene(plates=[plate], ground=jl.Ground(reflectance=0.3))
    >>> [surface.name for surface in scene.surfaces]
    ['ground', 'plate']
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
        """All surfaces: the ground, if there is one, then the plates, as the tracer numbers them."""
        return (() if self.ground is None else (self.ground,)) + self.plates
