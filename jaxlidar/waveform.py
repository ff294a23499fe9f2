"""From response to waveform: optics, atmosphere, pulse, sampling and energy."""

import dataclasses
import importlib
import os
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlidar._checks import check_range, is_traced
from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._summary import summary
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.instrument.receiver import first_return_window, record
from jaxlidar.planning.plan import Plan
from jaxlidar.planning.sampling import sampling_of
from jaxlidar.planning.scatterers import letter_values
from jaxlidar.planning.setup import Setup
from jaxlidar.trace.histories import Histories, histories
from jaxlidar.trace.response import Response


@final
class Waveform(eqx.Module):
    """A simulated waveform: apparent reflectance and received energy by wavelength and sample.

    - `time`: (bins,) ns, centres of the samples. Zero is the two-way travel time of the reference plane.
    - `height`: (bins,) m, the height from which light of order one arrives at that time.
    - `reflectance`: (wavelengths, bins) apparent reflectance per sample, with the transmittance of the
      atmosphere; its sum over bins is that of the target.
    - `energy`: (wavelengths, bins) J that the detector registers per sample.
    - `stderr`: (wavelengths, bins) one standard error of `reflectance`; zero where nothing was random. The
      expected value lies within two of them in 95 % of cases.
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
    - `info`: dict: "photons", "batches", "seconds", "error" reached, and why the simulation "stopped".

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
        - `case`: the `jaxlidar.io.Case` that was simulated, so that `jaxlidar.repeat` can do it again.
          Default None: not kept.

        **Raises:** what `jaxlidar.io.save` raises.
        """
        # Files lie above the core, which asks for them by name.
        importlib.import_module("jaxlidar.io.netcdf").save(self, path, case)

    def __str__(self) -> str:
        if any(is_traced(x) for x in (self.time, self.reflectance)):
            return repr(self)
        return summary(self)

    def _repr_html_(self) -> str | None:
        """What notebooks show: the summary and a small figure."""
        if any(is_traced(x) for x in (self.time, self.reflectance)):
            return None
        return importlib.import_module("jaxlidar.plot.html").waveform_html(self)


def optics_of(setup: Setup) -> Float[Array, "letters wavelengths"]:
    """Reflectance or transmittance of every letter of the plan, by wavelength."""
    return letter_values(setup.lidar, setup.scene, setup.plan.trace.letters)


def colour(
    weights: Float[Array, "traces *rest histories columns"],
    table: Histories,
    optics: Float[Array, "letters wavelengths"],
) -> Float[Array, "*rest wavelengths columns"]:
    """The sum over histories of weight times the product of optics, by wavelength: a matrix product."""
    if len(weights) == 1:
        return jnp.einsum("hw,...hc->...wc", table.monomials(optics), weights[0])
    # Each trace has one wavelength.
    return jnp.einsum("hw,w...hc->...wc", table.monomials(optics), weights)


def _fine_heights(setup: Setup) -> Float[Array, "bins"]:
    bins = setup.plan.bins
    time = jnp.asarray(bins.start + bins.width * np.arange(bins.count))
    return jnp.minimum(height_of(setup.lidar, time), 0.999 * setup.lidar.altitude)


def _through_air(
    fine: Float[Array, "*s wavelengths bins"], setup: Setup
) -> Float[Array, "*s wavelengths bins"]:
    """Returns in fine bins after attenuation by the atmosphere on both ways."""
    lidar, air = setup.lidar, setup.scene.atmosphere
    assert air is not None
    heights = _fine_heights(setup)
    clear = air.two_way_transmittance(lidar.wavelength, heights, lidar.altitude, lidar.zenith)
    return fine * clear.reshape((1,) * (fine.ndim - 2) + clear.shape)


def returns_air(setup: Setup) -> bool:
    """Whether the atmosphere's own backscatter is simulated: it is where a lidar ratio is given."""
    air = setup.scene.atmosphere
    return air is not None and air.lidar_ratio is not None


def air(setup: Setup) -> Float[Array, "wavelengths samples"]:
    """Backscatter of the air, apparent reflectance per sample: single scattering, above all of the scene."""
    lidar, plan, atmosphere = setup.lidar, setup.plan, setup.scene.atmosphere
    assert atmosphere is not None
    heights = _fine_heights(setup)
    per_metre = atmosphere.backscatter(lidar.wavelength, heights, lidar.altitude, lidar.zenith)
    top = jnp.asarray(plan.trace.upstream) * jnp.cos(jnp.deg2rad(lidar.zenith))
    length = 0.5 * SPEED_OF_LIGHT * plan.bins.width
    fine = jnp.where((heights > top)[None, :], per_metre * length, 0.0)
    return sampling_of(lidar, plan)(fine)


def height_of(lidar: Lidar, time: Float[Array, "bins"]) -> Float[Array, "bins"]:
    """Height above the reference plane (m) from which order one arrives at `time` (ns)."""
    return -0.5 * SPEED_OF_LIGHT * time * jnp.cos(jnp.deg2rad(lidar.zenith))


def _tables(plan: Plan) -> tuple[Histories, Histories]:
    letters = len(plan.trace.letters)
    return histories(letters, plan.first_degree), histories(letters, plan.degree)


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
    # Sums over materials, and the pulse where no atmosphere lies between, come before the many wavelengths.
    values, clear = optics_of(setup), setup.scene.atmosphere is None
    sampling = sampling_of(setup.lidar, setup.plan)
    total = jnp.zeros(())
    for table, part in zip(_tables(setup.plan), (response.first, response.higher)):
        if part is not None:
            part = jnp.sum(part, axis=1)
            total = total + colour(sampling(part) if clear else part, table, values)
    total = total if clear else sampling(_through_air(total, setup))
    return setup.admissible * (total + air(setup) if returns_air(setup) else total)


class Balance(NamedTuple):
    """Where the emitted energy went, (wavelengths,) each: see `Waveform`."""

    ledger: dict[str, Float[Array, "wavelengths"]]
    neglected: Float[Array, "wavelengths"]
    lost: Float[Array, "wavelengths"]


def balance_of(response: Response, setup: Setup) -> Balance:
    """Shares of the emitted energy by fate. A material absorbs what arrived there less what left."""
    lidar, plan, values = setup.lidar, setup.plan, optics_of(setup)
    short, full = _tables(plan)
    table = short if response.higher is None else full

    def shares(weights: Array, table: Histories = table) -> Array:
        return colour(weights[..., None], table, values)[..., 0]

    whole = shares(jnp.sum(response.first, axis=(1, 3)), short)
    lost = shares(jnp.sum(response.first_outside, axis=1), short)
    if response.higher is not None and response.higher_outside is not None:
        whole = whole + shares(jnp.sum(response.higher, axis=(1, 3)))
        lost = lost + shares(jnp.sum(response.higher_outside, axis=1))
    absorbed = shares(response.arrived - response.left)
    ledger = {
        "escaped": shares(response.escaped),
        **{f"absorbed by {name}": absorbed[i] for i, name in enumerate(plan.trace.materials)},
        "after the window": shares(response.late),
        "unfollowed": shares(response.remaining),
    }
    returned = whole * lidar.aperture_area / (jnp.pi * lidar.range_to_reference**2)
    # What returns is part of what escaped, or, where only one order was followed, would have.
    source = "unfollowed" if plan.orders == 1 and len(plan.trace.materials) > 1 else "escaped"
    reach = jnp.minimum(returned, ledger[source])
    ledger = {"returned": reach, **ledger, source: ledger[source] - reach}
    per_energy = whole / jnp.maximum(ledger["escaped"], 1e-6)
    unfollowed = ledger["unfollowed"] if plan.orders > 1 else jnp.zeros_like(whole)
    return Balance(ledger, unfollowed * jnp.clip(per_energy, 1.0, 4.0), lost)


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
    lidar, plan, values = setup.lidar, setup.plan, optics_of(setup)
    sampling, clear = sampling_of(lidar, plan), setup.scene.atmosphere is None
    # The pulse comes before the many wavelengths if it can.
    first, higher = (
        None if part is None else colour(sampling(part) if clear else part, table, values)
        for table, part in zip(_tables(plan), (response.first, response.higher))
    )
    assert first is not None
    higher = jnp.zeros_like(first) if higher is None else higher
    lines = jnp.concatenate([first + higher, jnp.sum(first, 0)[None], jnp.sum(higher, 0)[None]])
    sampled = setup.admissible * (lines if clear else sampling(_through_air(lines, setup)))
    components = dict(zip([*plan.trace.materials, "first", "higher"], sampled))
    total = sampled[-2] + sampled[-1]
    if returns_air(setup):
        components["air"] = air(setup)
        components["first"] = components["first"] + components["air"]
        total = total + components["air"]
    time = jnp.asarray(plan.sample_start + plan.sample_interval * np.arange(plan.n_samples))
    ledger, neglected, lost = balance_of(response, setup)
    energy = total * _received(lidar, time)
    return Waveform(
        time=time,
        height=height_of(lidar, time),
        reflectance=total,
        energy=energy,
        stderr=jnp.zeros_like(total) if stderr is None else stderr,
        components=components,
        neglected=neglected,
        ledger=ledger,
        ledger_stderr=jax.tree.map(jnp.zeros_like, ledger) if ledger_stderr is None else ledger_stderr,
        lost=lost,
        recorded=record(energy, lidar.wavelength, lidar.receiver),
        wavelength=lidar.wavelength,
        info=info or {},
    )


def _received(lidar: Lidar, time: Float[Array, "bins"]) -> Float[Array, "wavelengths bins"]:
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
