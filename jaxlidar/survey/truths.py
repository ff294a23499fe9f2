"""What the beams of all shots of a survey meet in a scene."""

from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlidar._checks import briefly
from jaxlidar.io.datasets import keep_as_netcdf
from jaxlidar.io.netcdf import TRUTH_QUANTITIES
from jaxlidar.truth import Truth


@final
@briefly
class Truths(eqx.Module):
    """What the beams of all shots of a survey meet in a scene; axis 0 is the shots'.

    The fields are those of `Truth`, at the samples of the `Waveforms` that they belong to;
    `waves[i].truth` is the `Truth` of shot i.

    **Example:**

    >>> import jax, jaxlidar as jl
    >>> survey = jl.Survey.track(jl.Lidar(), start=(0, 0), end=(100, 0), spacing=50.0)
    >>> scene = jl.Scene(ground=jl.Ground(height=5.0, reflectance=0.4, slope=5.0, aspect=90.0))
    >>> many = jl.simulate_many(survey, scene, key=jax.random.key(0), truth=True)
    >>> print(", ".join(f"{z:.2f}" for z in many.truth.surface_height["ground"]))
    5.00, 0.63, -3.75
    >>> print(f"{float(many[2].truth.returns['ground'].sum()):.2f}")
    0.40
    """

    returns: dict[str, Float[np.ndarray, "shots wavelengths bins"]]
    gap_probability: Float[np.ndarray, "shots bins"]
    leaf_area_density: Float[np.ndarray, "shots bins"]
    bark_area_density: Float[np.ndarray, "shots bins"]
    plant_area_index: Float[np.ndarray, "shots bins"]
    top_height: Float[np.ndarray, " shots"]
    surface_height: dict[str, Float[np.ndarray, " shots"]]
    surface_spread: dict[str, Float[np.ndarray, " shots"]]

    def of_shot(self, shot: int, time: Float[Array, "bins"], height: Float[Array, "bins"]) -> Truth:
        """The truth of one shot, of which the samples are known.

        **Arguments:** `shot`: its number. `time`, `height`: as those of `Truth`.

        **Returns:** a `Truth`.
        """
        own = {name: jax.tree.map(lambda a: jnp.asarray(a[shot]), part) for name, part in vars(self).items()}
        return Truth(time=time, height=height, **own)


keep_as_netcdf(
    Truths,
    "truth of the shots of a survey",
    TRUTH_QUANTITIES,
    dimensions={"shots": "shot", "bins": "time", "wavelengths": "wavelength"},
    items={"returns": "material", "surface_height": "surface", "surface_spread": "surface"},
    rows="shots",
)
