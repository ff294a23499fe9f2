"""From response to waveform: optics, atmosphere, pulse, sampling and energy."""

import dataclasses
from typing import final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.instrument.receiver import first_return_window
from jaxlidar.planning.plan import Plan
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
    wavelength: Float[Array, "wavelengths"]
    info: dict = eqx.field(static=True)


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


def pulse_kernel(lidar: Lidar, plan: Plan) -> Float[Array, "fine samples"]:
    """Share of a return in fine bin i that each sample receives: the pulse integrated over the sample.

    Where the pulse is smooth on the scale of a fine bin, the second moment of the deposit kernel (see
    `jaxlidar.trace.deposit`) is taken out, which leaves an error of fourth order in the bin's width.
    """
    k = plan.per_sample
    # Offsets between a sample's centre and a fine bin's, in fine bins, from the last bin to the first.
    first = (plan.sample_start - plan.bins.start) / plan.bins.width
    low = -(plan.bins.count - 1) - 1
    number = np.arange(low, (plan.n_samples - 1) * k + 2)
    offset = jnp.asarray((number + first) * plan.bins.width)
    half = 0.5 * plan.sample_interval
    share = lidar.pulse.cumulative(offset + half, lidar.jitter) - lidar.pulse.cumulative(
        offset - half, lidar.jitter
    )
    if plan.sharpen:
        bend = share[2:] - 2.0 * share[1:-1] + share[:-2]
        share = share.at[1:-1].add(-0.5 * plan.bins.kernel_variance * bend)
    index = np.arange(plan.n_samples)[None, :] * k - np.arange(plan.bins.count)[:, None] - low
    # Fused into the gather, the pulse would be computed again for every element.
    return lax.optimization_barrier(share)[index]


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
    return jnp.einsum("wb,bs->ws", fine, pulse_kernel(lidar, plan))


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
    kernel = pulse_kernel(setup.lidar, setup.plan)
    total = jnp.zeros(())
    for table, part in zip(_tables(setup.plan), (response.first, response.higher)):
        if part is None:
            continue
        part = jnp.sum(part, axis=1)
        total = total + colour(part @ kernel if clear else part, table, values)
    total = total if clear else jnp.einsum("wb,bs->ws", _through_air(total, setup), kernel)
    return total + air(setup) if returns_air(setup) else total


def ledger_of(response: Response, setup: Setup) -> dict[str, Float[Array, "wavelengths"]]:
    """Shares of the emitted energy by fate. A material absorbs what arrived there less what left."""
    short, full = _tables(setup.plan)
    table, values = short if response.higher is None else full, optics_of(setup)

    def shares(weights: Array) -> Array:
        return colour(weights[..., None], table, values)[..., 0]

    absorbed = shares(response.arrived - response.left)
    ledger = {f"absorbed by {name}": absorbed[i] for i, name in enumerate(setup.plan.trace.materials)}
    return {
        "escaped": shares(response.escaped),
        **ledger,
        "after the window": shares(response.late),
        "unfollowed": shares(response.remaining),
    }


def waveform_of(
    response: Response,
    setup: Setup,
    *,
    stderr: Float[Array, "wavelengths bins"] | None = None,
    info: dict | None = None,
) -> Waveform:
    """The waveform of a response: with the optics, atmosphere, pulse, sampling and energy of a setup.

    The optics may differ from those at tracing: one response serves all reflectances and transmittances.

    **Arguments:**

    - `response`: a `Response` of `jaxlidar.trace_scene`, or the mean of several.
    - `setup`: the `Setup` that it was traced with; its optics may differ.
    - `stderr`: (wavelengths, samples) standard error of the reflectance, from batches. Default None: zero.
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
    names, kernel = plan.trace.materials, pulse_kernel(lidar, plan)
    # The pulse, and the sum over all time as one more sample, come before the many wavelengths if they can.
    clear = setup.scene.atmosphere is None
    early = jnp.concatenate([kernel, jnp.ones((plan.bins.count, 1))], axis=1) if clear else None
    orders = [
        None if part is None else colour(part if early is None else part @ early, table, values)
        for table, part in zip(_tables(plan), (response.first, response.higher))
    ]
    first, higher = orders
    assert first is not None
    higher = jnp.zeros_like(first) if higher is None else higher
    lines = jnp.concatenate([first + higher, jnp.sum(first, 0)[None], jnp.sum(higher, 0)[None]])
    if early is None:
        sampled = jnp.einsum("...b,bs->...s", _through_air(lines, setup), kernel)
        whole = jnp.sum(lines[-2] + lines[-1], axis=-1)
    else:
        sampled, whole = lines[..., :-1], lines[-2, :, -1] + lines[-1, :, -1]
    components = dict(zip([*names, "first", "higher"], sampled))
    total = sampled[-2] + sampled[-1]
    if returns_air(setup):
        components["air"] = air(setup)
        components["first"] = components["first"] + components["air"]
        total = total + components["air"]
    time = jnp.asarray(plan.sample_start + plan.sample_interval * np.arange(plan.n_samples))
    ledger, neglected = _balance(ledger_of(response, setup), whole, setup)
    return Waveform(
        time=time,
        height=height_of(lidar, time),
        reflectance=total,
        energy=total * _received(lidar, time),
        stderr=jnp.zeros_like(total) if stderr is None else stderr,
        components=components,
        neglected=neglected,
        ledger=ledger,
        wavelength=lidar.wavelength,
        info=info or {},
    )


def _received(lidar: Lidar, time: Float[Array, "bins"]) -> Float[Array, "wavelengths bins"]:
    """J per apparent reflectance, E_t eta A_r / (pi R^2): a Lambertian target that fills the footprint."""
    slant = lidar.range_to_reference + 0.5 * SPEED_OF_LIGHT * time
    share = lidar.aperture_area / (jnp.pi * jnp.maximum(slant, 1e-3) ** 2)
    return jnp.outer(lidar.energy_per_wavelength * lidar.efficiency_per_wavelength, share)


def _balance(
    ledger: dict[str, Float[Array, "wavelengths"]], whole: Float[Array, "wavelengths"], setup: Setup
) -> tuple[dict[str, Float[Array, "wavelengths"]], Float[Array, "wavelengths"]]:
    """The ledger including what returns into the aperture, and what neglected orders could still return.

    `whole`: apparent reflectance summed over all time.
    """
    lidar, plan = setup.lidar, setup.plan
    returned = whole * lidar.aperture_area / (jnp.pi * lidar.range_to_reference**2)
    # What returns is part of what escaped, or, where only one order was followed, would have.
    source = "unfollowed" if plan.orders == 1 and len(plan.trace.materials) > 1 else "escaped"
    reach = jnp.minimum(returned, ledger[source])
    full = {"returned": reach, **ledger, source: ledger[source] - reach}
    per_energy = whole / jnp.maximum(full["escaped"], 1e-6)
    unfollowed = full["unfollowed"] if plan.orders > 1 else jnp.zeros_like(full["unfollowed"])
    return full, unfollowed * jnp.clip(per_energy, 1.0, 4.0)


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
    )
