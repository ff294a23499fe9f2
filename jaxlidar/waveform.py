"""From response to waveform: optics, atmosphere, pulse, sampling and energy."""

import dataclasses
import os
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlidar._checks import briefly, check_range, is_traced
from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._registry import save_result, waveform_html
from jaxlidar._summary import summary
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.instrument.receiver import first_return_window, record
from jaxlidar.planning.setup import Setup
from jaxlidar.trace.colouring import Recording, balance, components, height_of, recording_of, total
from jaxlidar.trace.response import Response
from jaxlidar.truth import Truth


@final
@briefly
class Waveform(eqx.Module):
    """A simulated waveform: apparent reflectance and received energy by wavelength and sample.

    - `time`: (bins,) ns, centres of the samples. Zero is the two-way travel time of the reference plane.
    - `height`: (bins,) m, the height from which light of order one arrives at that time.
    - `reflectance`: (wavelengths, bins) apparent reflectance per sample, with the transmittance of the
      atmosphere; its sum over bins is that of the target.
    - `energy`: (wavelengths, bins) J that the detector registers per sample.
    - `stderr`: (wavelengths, bins) one standard error of `reflectance`; zero where nothing was random. The
      expected value lies within two of them in 95 % of cases. For more than 16 wavelengths they are computed
      at few that stand for all, to three digits of the wavelength's largest.
    - `components`: dict of arrays like `reflectance`: by material of the last scattering ("ground", "leaf",
      "bark", "plate", "air"), and by order ("first", "higher").
    - `neglected`: (wavelengths,) apparent reflectance that orders beyond the last could still add.
    - `ledger`: dict of (wavelengths,) shares of the emitted energy, before the atmosphere: "returned" into
      the aperture, "escaped", "absorbed by ...", "after the window", "unfollowed" beyond the last order.
    - `ledger_stderr`: dict like `ledger`, one standard error each; zero where nothing was random.
    - `lost`: (wavelengths,) apparent reflectance that arrives before or after all fine bins of the plan: late
      multiple scattering, or, where the geometry was traced by a JAX transformation, what a plan does not
      cover.
    - `recorded`: (wavelengths, bins) J that the receiver records of `energy`, without noise: background
      added, saturated, cut at the detection threshold, quantised. `jaxlidar.record` draws noise as well.
    - `wavelength`: (wavelengths,) nm, the lidar's.
    - `info`: dict: "photons", "batches", "seconds" spent, "error" reached, and why the simulation "stopped".
    - `truth`: a `Truth`, what the beam meets in the scene; None where it was not asked for.

    **Example:**

    >>> import jax
    >>> import jaxlidar as jl
    >>> scene = jl.Scene(ground=jl.Ground(reflectance=0.4))
    >>> wave = jl.simulate(jl.Lidar(), scene, key=jax.random.key(0))
    >>> print(sorted(wave.components), wave.info["stopped"])
    ['first', 'ground', 'higher'] nothing is random
    >>> print(f"{float(wave.ledger['absorbed by ground'][0]):.2f}")
    0.60
    """

    time: Float[Array, "bins"]
    height: Float[Array, "bins"]
    reflectance: Float[Array, "wavelengths bins"]
    energy: Float[Array, "wavelengths bins"]
    stderr: Float[Array, "wavelengths bins"]
    components: dict[str, Float[Array, "wavelengths bins"]]
    neglected: Float[Array, "wavelengths"]
    ledger: dict[str, Float[Array, "wavelengths"]]
    ledger_stderr: dict[str, Float[Array, "wavelengths"]]
    lost: Float[Array, "wavelengths"]
    recorded: Float[Array, "wavelengths bins"]
    wavelength: Float[Array, "wavelengths"]
    info: dict = eqx.field(static=True)
    truth: Truth | None = None

    @property
    def first_order_share(self) -> Float[Array, "wavelengths"]:
        """Share of `reflectance` that was scattered once, (wavelengths,); 1 where nothing returns."""
        first, whole = (jnp.sum(a, axis=1) for a in (self.components["first"], self.reflectance))
        return jnp.where(whole > 0, first / jnp.where(whole > 0, whole, 1.0), 1.0)

    def nan_where_lost(self, share: float = 0.01) -> "Waveform":
        """The same waveform, NaN at wavelengths that lost more than a share of their reflectance.

        For use within JAX transformations, where a plan that does not fit cannot be refused.

        **Arguments:** `share`: of `lost` in the sum of `reflectance` and `lost`, above 0. Default 0.01.
        """
        check_range("share", share, 0.0, low_open=True)
        whole = jnp.sum(self.reflectance, axis=1) + self.lost
        good = self.lost <= share * whole
        return dataclasses.replace(self, reflectance=jnp.where(good[:, None], self.reflectance, jnp.nan))

    def save(self, path: str | os.PathLike[str], case: Any = None) -> None:
        """Write the waveform as a netCDF file, which `jaxlidar.open` reads.

        **Arguments:**

        - `path`: the file to write.
        - `case`: the `jaxlidar.io.Case` that was simulated, so that `jaxlidar.rerun` can do it again.
          Default None: not kept.

        **Raises:** what `jaxlidar.io.save` raises.
        """
        save_result(self, path, case)

    def __str__(self) -> str:
        if any(is_traced(x) for x in (self.time, self.reflectance)):
            return repr(self)
        return summary(self)

    def _repr_html_(self) -> str | None:
        """What notebooks show: the summary and a small figure."""
        if any(is_traced(x) for x in (self.time, self.reflectance)):
            return None
        return waveform_html(self)


def total_of(response: Response, setup: Setup) -> Float[Array, "wavelengths samples"]:
    """Apparent reflectance per sample, all components together.

    This is `Waveform.reflectance` on the plan's samples, without the components, energy and ledger of
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
    >>> setup = jl.reduce(lidar, scene, jl.plan(lidar, scene))
    >>> response = eqx.filter_jit(jl.trace_scene)(setup, jax.random.key(0))
    >>> total = eqx.filter_jit(jl.total_of)(response, setup)
    >>> print(f"{float(total.sum()):.3f}")
    0.400
    """
    return total(response, recording_of(setup))


def waveform_of(
    response: Response,
    setup: Setup,
    *,
    stderr: Float[Array, "wavelengths bins"] | None = None,
    ledger_stderr: dict[str, Float[Array, "wavelengths"]] | None = None,
    info: dict | None = None,
) -> Waveform:
    """The waveform of a response: with the optics, atmosphere, pulse, sampling and energy of a setup.

    The optics may differ from those at tracing: one response serves all reflectances and transmittances.

    **Arguments:**

    - `response`: a `Response` of `jaxlidar.trace_scene`, or the mean of several.
    - `setup`: the `Setup` that it was traced with; its optics may differ.
    - `stderr`: (wavelengths, samples) standard error of the reflectance, from batches. Default None: zero.
    - `ledger_stderr`: standard errors of the ledger, from batches. Default None: zero.
    - `info`: dict for `Waveform.info`. Default None: empty.

    **Returns:** a `Waveform` on the plan's samples.

    **Example:**

    >>> import equinox as eqx
    >>> import jax
    >>> import jaxlidar as jl
    >>> lidar, scenes = jl.Lidar(), [jl.Scene(ground=jl.Ground(reflectance=r)) for r in (0.2, 0.8)]
    >>> dark, bright = (jl.reduce(lidar, scene, jl.plan(lidar, scenes[0])) for scene in scenes)
    >>> response = eqx.filter_jit(jl.trace_scene)(dark, jax.random.key(0))
    >>> wave = eqx.filter_jit(jl.waveform_of)(response, bright)
    >>> print(f"{float(wave.reflectance.sum()):.3f}")
    0.800
    """
    wave = recorded(response, recording_of(setup))
    given = {"stderr": stderr, "ledger_stderr": ledger_stderr, "info": info}
    return dataclasses.replace(wave, **{name: value for name, value in given.items() if value is not None})


def recorded(response: Response, recording: Recording) -> Waveform:
    """The waveform of a response, without standard errors."""
    lidar, time = recording.lidar, recording.time
    parts = components(response, recording)
    reflectance = parts["first"] + parts["higher"]
    ledger, neglected, lost = balance(response, recording)
    energy = reflectance * received(lidar, time)
    return Waveform(
        time=time,
        height=height_of(lidar, time),
        reflectance=reflectance,
        energy=energy,
        stderr=jnp.zeros_like(reflectance),
        components=parts,
        neglected=neglected,
        ledger=ledger,
        ledger_stderr=jax.tree.map(jnp.zeros_like, ledger),
        lost=lost,
        recorded=record(energy, lidar.wavelength, lidar.receiver),
        wavelength=lidar.wavelength,
        info={},
    )


def trimmed(wave: Waveform, wavelengths: int, samples: int) -> Waveform:
    """The first wavelengths and samples of a waveform."""
    if wave.reflectance.shape == (wavelengths, samples):
        return wave

    # Slices are not worth a compilation.
    known = jax.device_get(wave)
    cut = jax.tree.map(lambda a: a[tuple(slice(n) for n in (wavelengths, samples)[: a.ndim])], known)
    times = (known.time[:samples], known.height[:samples])
    return jax.device_put(eqx.tree_at(lambda w: (w.time, w.height), cut, times))


def received(lidar: Lidar, time: Float[Array, "bins"]) -> Float[Array, "wavelengths bins"]:
    """J per apparent reflectance, E_t eta A_r / (pi R^2): a Lambertian target that fills the footprint."""
    slant = lidar.range_to_reference + 0.5 * SPEED_OF_LIGHT * time
    share = lidar.aperture_area / (jnp.pi * jnp.maximum(slant, 1e-3) ** 2)
    return jnp.outer(lidar.energy_per_wavelength * lidar.efficiency_per_wavelength, share)


def open_at_first_return(wave: Waveform, lidar: Lidar) -> Waveform:
    """The finely sampled waveform on the bins of the digitiser, which start at the first return.

    See `jaxlidar.first_return_window` for the artefact that this makes. The first return is the first sample
    above the receiver's detection threshold and above a thousandth of the peak. Standard errors of the fine
    samples are added up as if fully correlated.
    """
    energy = wave.energy
    threshold = jnp.maximum(lidar.receiver.detection_threshold, 1e-3 * jnp.max(energy))
    opened = jnp.cumsum(jnp.any(energy > threshold, axis=0)) > 0
    arrays = [wave.reflectance, energy, wave.stderr, *wave.components.values()]
    kept = jnp.stack([jnp.where(opened[None, :], a, 0.0) for a in arrays])
    # Only the energy opens the window: the other channels are zero before it does.
    interval = float(lidar.sampling_interval)
    time, rows = first_return_window(wave.time, kept, interval, jnp.minimum(threshold, 0.0))
    return dataclasses.replace(
        wave,
        time=time,
        height=height_of(lidar, time),
        reflectance=rows[0],
        energy=rows[1],
        stderr=rows[2],
        components=dict(zip(wave.components, rows[3:])),
        recorded=record(rows[1], wave.wavelength, lidar.receiver),
    )
