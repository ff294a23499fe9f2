"""`Waveform`: apparent reflectance and received energy by wavelength and sample.

A return of apparent reflectance r, from the range d, has the energy

    E = E_t eta A_r / (pi d^2) r,

with the emitted energy E_t, the efficiency eta and the area A_r of the aperture. The pulse and the digitiser
spread it over samples.
"""

import dataclasses
import os
from collections.abc import Callable, Iterator
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlidar._fields.checks import check_index, check_range, has_tracers
from jaxlidar._registry import detect_returns, save_result, true_returns, waveform_html
from jaxlidar.planning.setup import Setup
from jaxlidar.sensors.lidar import Lidar
from jaxlidar.sensors.receiver import Receiver, digitise, first_return_window
from jaxlidar.spectral.apply_optics import (
    WaveformModel,
    budget_terms,
    component_samples,
    height_of,
    make_waveform_model,
    relative_energy_samples,
    total_samples,
)
from jaxlidar.spectral.summary import summary
from jaxlidar.spectral.truth_class import Truth
from jaxlidar.trace.response import Response


@final
class Waveform(eqx.Module):
    """A simulated waveform: apparent reflectance and received energy by wavelength and sample.

    - `time`: (samples,) ns, centres of the samples. Zero is the two-way travel time of the reference plane;
      of a lidar that is placed by its sensor, the emission.
    - `height`: (samples,) m, the height from which light of order one arrives at that time.
    - `reflectance`: (wavelengths, samples) apparent reflectance per sample, with the transmittance of the
      atmosphere; its sum over samples is that of the target.
    - `energy`: (wavelengths, samples) J that the detector registers per sample. Each return has the energy of
      the range from which it comes, whatever the samples over which the pulse spreads it.
    - `stderr`: (wavelengths, samples) one standard error of `reflectance`; zero where nothing was random. The
      expected value lies within two of them in 95 % of cases, in samples above 1 % of the waveform's largest.
      In fainter ones, which few photons reached, the errors are underestimated: two of them hold some 92 %,
      and a sample that no photon reached has the error zero, which says nothing of its value. For more than
      16 wavelengths they are computed at pivot wavelengths and interpolated, to three digits of the
      wavelength's largest.
    - `components`: dict of arrays like `reflectance`: by material of the last scattering ("ground", "leaf",
      "bark", "plate", "air"), and by order ("first", "higher").
    - `neglected`: (wavelengths,) apparent reflectance that orders beyond the last, and light in flight at
      the end of the record, could still add, an estimate. The light itself is in
      `energy_budget["unfollowed"]` and `["after the window"]`. Zero where one order is followed, which says
      nothing of the others: order one tells nothing about how much of the light that is scattered again
      returns; `jaxlidar.plan` bounds what they add.
    - `energy_budget`: dict of (wavelengths,) fractions of the emitted energy, before the atmosphere:
      "returned" into the aperture, "escaped", "absorbed by ...",
      "after the window", "unfollowed" beyond the last order.
    - `energy_budget_stderr`: dict like `energy_budget`, one standard error each; zero where nothing was
      random.
    - `lost`: (wavelengths,) apparent reflectance, of light that reaches the sensor, that arrives before or
      after all fine bins of the plan, as light does that is scattered many times. Within a JAX
      transformation, where a plan that does not cover the lidar and the scene cannot be refused, it is 1 at
      least for these: the waveform is then wrong, as rays may start below a surface. Light that is still in
      the scene at the end of the record is "after the window" in `energy_budget` instead, and what returns
      of it in `neglected`.
    - `recorded`: (wavelengths, samples) J that the receiver records of `energy`, without noise: background
      added, saturated, cut at the detection threshold, quantised. `jaxlidar.record` draws noise as well.
    - `wavelength`: (wavelengths,) nm, the lidar's.
    - `info`: dict: "photons", "batches", "seconds" spent, "error" reached, and why the simulation "stopped":
      "nothing is random", "tolerance met", "batches spent" (with `n_photons`, or at the largest number of a
      survey), "time spent", "interrupted", "orders beyond ... may add ...", or, in a survey, "misses the
      scene"; and the "altitude" of the lidar in m, None for one that is placed by its sensor.
    - `truth`: a `Truth`, what the beam meets in the scene; None where it was not asked for.

    The waveform of many scenes, as `simulate_scenes` returns it, has arrays with one more axis, the first, of
    scenes; they share `time`, `height` and `wavelength`, which do not have it. `len(wave)` is their number,
    `wave[i]` the waveform of scene i. Both are refused (TypeError) for the waveform of one scene.

    **Example:**

    >>> import jax
    >>> import jaxlidar as jl
    >>> scene = jl.Scene(ground=jl.Ground(reflectance=0.4))
    >>> wave = jl.simulate(jl.Lidar(), scene, key=jax.random.key(0))
    >>> print(sorted(wave.components), wave.info["stopped"])
    ['first', 'ground', 'higher'] nothing is random
    >>> print(f"{float(wave.energy_budget['absorbed by ground'][0]):.2f}")
    0.60
    """

    time: Float[Array, "samples"]
    height: Float[Array, "samples"]
    reflectance: Float[Array, "*scenes wavelengths samples"]
    energy: Float[Array, "*scenes wavelengths samples"]
    stderr: Float[Array, "*scenes wavelengths samples"]
    components: dict[str, Float[Array, "*scenes wavelengths samples"]]
    neglected: Float[Array, "*scenes wavelengths"]
    energy_budget: dict[str, Float[Array, "*scenes wavelengths"]]
    energy_budget_stderr: dict[str, Float[Array, "*scenes wavelengths"]]
    lost: Float[Array, "*scenes wavelengths"]
    recorded: Float[Array, "*scenes wavelengths samples"]
    wavelength: Float[Array, "wavelengths"]
    info: dict = eqx.field(static=True)
    truth: Truth | None = None

    @property
    def first_order_share(self) -> Float[Array, "*scenes wavelengths"]:
        """Fraction of `reflectance` that was scattered once, (wavelengths,); 1 where nothing returns."""
        first, total = (jnp.sum(a, axis=-1) for a in (self.components["first"], self.reflectance))
        return jnp.where(total > 0, first / jnp.where(total > 0, total, 1.0), 1.0)

    def nan_where_lost(self, share: float = 0.01) -> "Waveform":
        """Return the same waveform, NaN at wavelengths that lost more than a fraction of their reflectance.

        For use within JAX transformations, where a plan that does not cover the scene cannot be refused: its
        waveforms have lost more than half, and are NaN by any fraction below.

        **Arguments:** `share`: fraction of `lost` in the sum of `reflectance` and `lost`, above 0. Default
        0.01.
        """
        check_range("share", share, 0.0, low_open=True)
        total = jnp.sum(self.reflectance, axis=-1) + self.lost
        is_covered = self.lost <= share * total
        return dataclasses.replace(
            self, reflectance=jnp.where(is_covered[..., None], self.reflectance, jnp.nan)
        )

    def save(self, path: str | os.PathLike[str], case: Any = None) -> None:
        """Write the waveform as a netCDF file, which `jaxlidar.open` reads.

        **Arguments:**

        - `path`: the file to write.
        - `case`: the `jaxlidar.io.Case` that was simulated, so that `jaxlidar.rerun` can do it again.
          Default None: not kept.

        **Raises:** what `jaxlidar.io.save` raises.
        """
        save_result(self, path, case)

    def returns(self, lidar: Lidar, detector: str | Callable[..., Any] = "peak", **options: Any) -> Any:
        """Detect the discrete returns of the waveform, as a laser scanner reports them.

        **Arguments:**

        - `lidar`: the `Lidar` that was simulated: its place, pulse and radiometry.
        - `detector`, `options`: those of `Waveforms.returns`; a `record` is (wavelengths, samples).

        **Returns:** a `DiscreteReturns` of one shot. Its ground height is that of the truth, NaN without one.

        **Raises:** as `Waveforms.returns`; TypeError for something else than a lidar, ValueError for a
        lidar of other wavelengths, and for one that is placed by its altitude where that of the waveform was
        placed by its sensor, or the other way round.

        **Example:**

        >>> import jax, jaxlidar as jl
        >>> lidar, scene = jl.Lidar(altitude=500.0), jl.Scene(ground=jl.Ground(height=2.0))
        >>> wave = jl.simulate(lidar, scene, key=jax.random.key(0))
        >>> print(wave.returns(lidar, detector="constant fraction").range.round(2))
        [498.]
        """
        return detect_returns(self, lidar, detector, **options)

    def true_returns(self, lidar: Lidar, **options: Any) -> Any:
        """List the true echoes of the waveform, which was simulated with `truth=True`.

        **Arguments:** `lidar`: the `Lidar` that was simulated. `options`: those of `Waveforms.true_returns`.

        **Returns:** a `DiscreteReturns` of one shot.

        **Raises:** as `returns`; ValueError where there is no truth.

        **Example:**

        >>> import jax, jaxlidar as jl
        >>> lidar, scene = jl.Lidar(altitude=500.0), jl.Scene(ground=jl.Ground(height=2.0))
        >>> wave = jl.simulate(lidar, scene, key=jax.random.key(0), truth=True)
        >>> print(wave.true_returns(lidar).position.round(2).tolist())
        [[0.0, 0.0, 2.0]]
        """
        return true_returns(self, lidar, **options)

    @property
    def has_scenes(self) -> bool:
        """True if arrays have a leading axis, of scenes."""
        return self.reflectance.ndim > 2

    def __len__(self) -> int:
        if not self.has_scenes:
            raise TypeError("this is the waveform of one scene: it has no axis of scenes")
        return len(self.reflectance)

    def __bool__(self) -> bool:
        # Not by the length, which the waveform of one scene does not have.
        return True

    def __getitem__(self, scene: int) -> "Waveform":
        i = check_index("scene", scene, len(self))
        # `jax.vmap` gives these, too, an axis of scenes.
        axes = {name: getattr(self, name) for name in ("time", "height", "wavelength")}
        shared = {name: a for name, a in axes.items() if a.ndim == 1}
        item = jax.tree.map(lambda a: a[i], dataclasses.replace(self, **dict.fromkeys(shared)))
        return dataclasses.replace(item, **shared)

    def __iter__(self) -> Iterator["Waveform"]:
        return (self[i] for i in range(len(self)))

    def __str__(self) -> str:
        if has_tracers((self.time, self.reflectance)):
            return repr(self)
        return summary(self)

    def _repr_html_(self) -> str | None:
        """Return HTML for notebooks: the summary and a small figure."""
        if self.has_scenes or has_tracers((self.time, self.reflectance)):
            return None
        return waveform_html(self)


def total_reflectance(response: Response, setup: Setup) -> Float[Array, "wavelengths samples"]:
    """Return the apparent reflectance per sample, all components together.

    This is `Waveform.reflectance` on the plan's samples, without the components, energy and energy budget of
    `waveform_of`.

    **Arguments:**

    - `response`: a `Response` of `jaxlidar.trace_scene`, or the mean of several.
    - `setup`: the `Setup` that it was traced with; its optics may differ.

    **Returns:** (wavelengths, samples) apparent reflectance.

    **Example:**

    >>> import equinox as eqx
    >>> import jax
    >>> import jaxlidar as jl
    >>> lidar, scene = jl.Lidar(), jl.Scene(ground=jl.Ground(reflectance=0.4))
    >>> setup = jl.make_setup(lidar, scene, jl.plan(lidar, scene))
    >>> response = eqx.filter_jit(jl.trace_scene)(setup, jax.random.key(0))
    >>> total = eqx.filter_jit(jl.total_reflectance)(response, setup)
    >>> print(f"{float(total.sum()):.3f}")
    0.400
    """
    return total_samples(response, make_waveform_model(setup))


def waveform_of(
    response: Response,
    setup: Setup,
    *,
    stderr: Float[Array, "wavelengths samples"] | None = None,
    energy_budget_stderr: dict[str, Float[Array, "wavelengths"]] | None = None,
    info: dict | None = None,
) -> Waveform:
    """Make the waveform of a response, with the optics, atmosphere, pulse, sampling and energy of a setup.

    The optics may differ from those at tracing: one response serves all reflectances and transmittances.

    **Arguments:**

    - `response`: a `Response` of `jaxlidar.trace_scene`, or the mean of several.
    - `setup`: the `Setup` that it was traced with; its optics may differ.
    - `stderr`: (wavelengths, samples) standard error of the reflectance, from batches. Default None: zero.
    - `energy_budget_stderr`: standard errors of the energy budget, from batches. Default None: zero.
    - `info`: dict for `Waveform.info`. Default None: empty.

    **Returns:** a `Waveform` on the plan's samples.

    **Example:**

    >>> import equinox as eqx
    >>> import jax
    >>> import jaxlidar as jl
    >>> lidar, scenes = jl.Lidar(), [jl.Scene(ground=jl.Ground(reflectance=r)) for r in (0.2, 0.8)]
    >>> dark, bright = (jl.make_setup(lidar, scene, jl.plan(lidar, scenes[0])) for scene in scenes)
    >>> response = eqx.filter_jit(jl.trace_scene)(dark, jax.random.key(0))
    >>> wave = eqx.filter_jit(jl.waveform_of)(response, bright)
    >>> print(f"{float(wave.reflectance.sum()):.3f}")
    0.800
    """
    wave = waveform_of_model(response, make_waveform_model(setup))
    fields = {"stderr": stderr, "energy_budget_stderr": energy_budget_stderr, "info": info}
    return dataclasses.replace(wave, **{name: value for name, value in fields.items() if value is not None})


def waveform_of_model(response: Response, model: WaveformModel) -> Waveform:
    """Make the waveform of a response, without standard errors."""
    lidar, time = model.lidar, model.time
    components = component_samples(response, model)
    reflectance = components["first"] + components["higher"]
    terms = budget_terms(response, model)
    energy = energy_at_reference(lidar)[:, None] * relative_energy_samples(response, model)
    return Waveform(
        time=time,
        height=height_of(lidar, time),
        reflectance=reflectance,
        energy=energy,
        stderr=jnp.zeros_like(reflectance),
        components=components,
        neglected=terms.neglected,
        energy_budget=terms.energy_budget,
        energy_budget_stderr=jax.tree.map(jnp.zeros_like, terms.energy_budget),
        lost=terms.lost,
        recorded=digitise(energy, lidar.wavelength, lidar.receiver),
        wavelength=lidar.wavelength,
        info={},
    )


def remove_padding(wave: Waveform, n_wavelengths: int, n_samples: int) -> Waveform:
    """Return the first wavelengths and samples of a waveform."""
    if wave.reflectance.shape == (n_wavelengths, n_samples):
        return wave
    # On the host: slices are not worth a compilation.
    padded = jax.device_get(wave)
    sizes = (n_wavelengths, n_samples)
    trimmed = jax.tree.map(lambda a: a[tuple(slice(n) for n in sizes[: a.ndim])], padded)
    axes = (padded.time[:n_samples], padded.height[:n_samples])
    return jax.device_put(eqx.tree_at(lambda w: (w.time, w.height), trimmed, axes))


def energy_at_reference(lidar: Lidar) -> Float[Array, "wavelengths"]:
    """Return the energy, J, per apparent reflectance at the range of the reference plane."""
    solid_angle_over_pi = lidar.aperture_area / (jnp.pi * lidar.range_to_reference**2)
    return lidar.energy_per_wavelength * lidar.efficiency_per_wavelength * solid_angle_over_pi


def open_at_first_return(wave: Waveform, lidar: Lidar) -> Waveform:
    """Resample a finely sampled waveform to the bins of the digitiser, which start at the first return.

    See `jaxlidar.first_return_window` for the artefact that this makes. The first return is the first sample
    above the receiver's detection threshold and above a thousandth of the peak. Standard errors of the fine
    samples are added up as if fully correlated.
    """
    energy = wave.energy
    assert isinstance(lidar.receiver, Receiver)
    threshold = jnp.maximum(lidar.receiver.detection_threshold, 1e-3 * jnp.max(energy))
    is_open = jnp.cumsum(jnp.any(energy > threshold, axis=0)) > 0
    arrays = [wave.reflectance, energy, wave.stderr, *wave.components.values()]
    # The energy alone opens the window: all arrays are zero before it does, and exceed zero from there on.
    opened = jnp.stack([jnp.where(is_open[None, :], a, 0.0) for a in arrays])
    time, rows = first_return_window(wave.time, opened, float(lidar.sampling_interval), threshold=0.0)
    return dataclasses.replace(
        wave,
        time=time,
        height=height_of(lidar, time),
        reflectance=rows[0],
        energy=rows[1],
        stderr=rows[2],
        components=dict(zip(wave.components, rows[3:])),
        recorded=digitise(rows[1], wave.wavelength, lidar.receiver),
    )
