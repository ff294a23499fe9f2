"""`Truth`: reference quantities of a waveform, from the scene itself. `jaxlidar.truth` computes them."""

import dataclasses
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlidar._fields.checks import check_index


@final
class Truth(eqx.Module):
    """Truth of a waveform, sample by sample: gaps, areas and heights along the beam, from the scene itself.

    - `time`: (samples,) ns, `height`: (samples,) m, of the samples, as those of `Waveform`. Off nadir samples
      are shells of equal range, and `height` is where these meet the beam's axis.
    - `returns`: dict of (wavelengths, samples) apparent reflectance by material ("ground", "leaf", "bark",
      "plate", "air"): order one, as recorded of a pulse without duration. Its sums over samples are the
      amplitudes of layers. What returns at one instant is spread over three fine bins of the plan.
    - `gap_probability`: (samples,) fraction of the beam's energy that meets no leaf, bark or plate down to
      the lower end of each sample. Its last is that of all above the ground.
    - `leaf_area_density`, `bark_area_density`: (samples,) m2/m3, half of the total surface area per volume
      (twice the extinction coefficient where G = 1/2), mean over the footprint, weighted by the beam's
      energy. Below the ground there is none.
    - `plant_area_index`: (samples,) cumulative plant area index, m2 of leaf and bark per m2 of ground, above
      the lower end of each sample: the sum of densities times the distance of samples in height.
    - `top_height`: () m, the height above which plants and plates intercept 1 % of the beam's energy, to
      within a sample; NaN where they intercept less, or do so above the record.
    - `surface_height`, `surface_spread`: dict of () m, by surface ("ground", "plate", or "plate 1", ...):
      mean height and standard deviation of where the beam would meet it if nothing lay above, weighted by
      the beam's energy; NaN where it does not meet it.

    Gaps are those of the geometry, whatever the wavelength and whatever leaves transmit.

    The truth of the shots of a survey (`Waveforms.truth`) has one more axis, the first, of shots; they
    share `time`. `truth[i]` is the truth of shot i, and that of `waves[i]`.

    **Example:** a plate that covers half of the beam, above sloping ground.

    >>> import jaxlidar as jl
    >>> scene = jl.Scene(plates=[jl.Plate(3.0, 0.4, coverage=0.5)], ground=jl.Ground(1.0, slope=10.0))
    >>> truth = jl.truth_of(jl.Lidar(altitude=1e4, divergence=1.0), scene)
    >>> {name: round(float(z), 2) for name, z in truth.surface_height.items()}
    {'ground': 1.0, 'plate': 3.0}
    >>> print(f"{float(truth.surface_spread['ground']):.2f} m")  # tan(10 degrees) of half the radius of 5 m
    0.44 m
    >>> print(f"{float(truth.gap_probability[-1]):.2f}")
    0.50
    """

    time: Float[Array, "samples"]
    height: Float[Array, "*shots samples"]
    returns: dict[str, Float[Array, "*shots wavelengths samples"]]
    gap_probability: Float[Array, "*shots samples"]
    leaf_area_density: Float[Array, "*shots samples"]
    bark_area_density: Float[Array, "*shots samples"]
    plant_area_index: Float[Array, "*shots samples"]
    top_height: Float[Array, "*shots"]
    surface_height: dict[str, Float[Array, "*shots"]]
    surface_spread: dict[str, Float[Array, "*shots"]]

    def __getitem__(self, shot: int) -> "Truth":
        if self.top_height.ndim == 0:
            raise TypeError("this is the truth of one waveform: it has no axis of shots")
        i = check_index("shot", shot, len(self.top_height))
        rows = jax.tree.map(lambda a: jnp.asarray(a[i]), dataclasses.replace(self, time=None))
        return dataclasses.replace(rows, time=jnp.asarray(self.time))
