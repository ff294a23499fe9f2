"""From response to waveform: optics, atmosphere, pulse, sampling, energy."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.instrument.receiver import first_return_window
from jaxlidar.planning.effects import without
from jaxlidar.planning.plan import Plan
from jaxlidar.planning.scatterers import scene_optics
from jaxlidar.scenes.scene import Scene
from jaxlidar.trace.histories import histories
from jaxlidar.trace.response import Response


class Waveform(eqx.Module):
    """A simulated waveform.

    - `time`: (bins,) ns, centres of the samples, from the two-way travel time of the reference plane.
    - `height`: (bins,) m, the height at which light of order one arrives at that time.
    - `reflectance`: (wavelengths, bins) apparent reflectance per sample, with the transmittance of the
      atmosphere; sums over bins to that of the target.
    - `energy`: (wavelengths, bins) J that the detector registers per sample.
    - `stderr`: (wavelengths, bins) one standard error of `reflectance`; zero where nothing was random. Two of
      them hold the expected value in 95 % of cases.
    - `components`: dict of arrays like `reflectance`: by material of the last scattering ("ground",
      "leaf", "bark", "plate", "air"), and by order ("first", "higher").
    - `neglected`: (wavelengths,) apparent reflectance that orders beyond the last could still add.
    - `ledger`: dict of (wavelengths,) shares of the emitted energy, before the atmosphere: "returned" into
      the aperture, "escaped", "absorbed by ...", "after the window", "unfollowed" beyond the last order.
    - `info`: dict: photons, batches, seconds, error reached and why the simulation stopped.
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


def optics(lidar: Lidar, scene: Scene, plan: Plan) -> Float[Array, "letters wavelengths"]:
    """Reflectance or transmittance of every letter of the plan."""
    values: dict[str, Array] = {}
    for o in scene_optics(lidar, scene):
        values[f"{o.name}.R"] = o.reflectance
        if o.transmittance is not None:
            values[f"{o.name}.T"] = o.transmittance
    rows = [values[letter] for letter in plan.trace.letters]
    return jnp.stack(rows) if rows else jnp.zeros((0, lidar.wavelength.size))


def is_straight(scene: Scene) -> bool:
    """Whether leaves transmit straight on, so that every wavelength needs its own trace."""
    return (
        scene.canopy is not None and scene.canopy.leaf is not None and scene.canopy.transmission == "straight"
    )


def colour(
    response: Response, optics: Float[Array, "letters wavelengths"], plan: Plan
) -> tuple[Float[Array, "materials wavelengths bins"], Float[Array, "materials wavelengths bins"]]:
    """Orders one, and two and above, by material of the last scattering: a matrix product each."""
    letters = len(plan.trace.letters)
    short = histories(letters, plan.first_degree).monomials(optics)
    first = jnp.einsum("hw,mhb->mwb", short, response.first)
    if response.higher is None:
        return first, jnp.zeros_like(first)
    full = histories(letters, plan.degree).monomials(optics)
    return first, jnp.einsum("hw,mhb->mwb", full, response.higher)


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
    # Fused into the gather, the pulse would be computed anew for every element.
    return lax.optimization_barrier(share)[index]


def sample(
    fine: Float[Array, "*s wavelengths bins"], lidar: Lidar, scene: Scene, plan: Plan
) -> Float[Array, "*s wavelengths samples"]:
    """Atmosphere, pulse and sampling: from fine bins to what the digitiser integrates."""
    if scene.atmosphere is not None:
        clear = _clear(lidar, scene, plan)
        fine = fine * clear.reshape((1,) * (fine.ndim - 2) + clear.shape)
    return jnp.einsum("...b,bs->...s", fine, pulse_kernel(lidar, plan))


def _fine_heights(lidar: Lidar, plan: Plan) -> Float[Array, "bins"]:
    time = jnp.asarray(plan.bins.start + plan.bins.width * np.arange(plan.bins.count))
    return jnp.minimum(height_of(lidar, time), 0.999 * lidar.altitude)


def _clear(lidar: Lidar, scene: Scene, plan: Plan) -> Float[Array, "wavelengths bins"]:
    assert scene.atmosphere is not None
    heights = _fine_heights(lidar, plan)
    return scene.atmosphere.two_way_transmittance(lidar.wavelength, heights, lidar.altitude, lidar.zenith)


def returns_air(scene: Scene) -> bool:
    """Whether the air's own return is simulated: where a lidar ratio is given."""
    return scene.atmosphere is not None and scene.atmosphere.lidar_ratio is not None


def air(lidar: Lidar, scene: Scene, plan: Plan) -> Float[Array, "wavelengths samples"]:
    """The air's own return, apparent reflectance per sample: single scattering above all of the scene."""
    assert scene.atmosphere is not None
    heights = _fine_heights(lidar, plan)
    per_metre = scene.atmosphere.backscatter(lidar.wavelength, heights, lidar.altitude, lidar.zenith)
    top = jnp.asarray(plan.trace.upstream) * jnp.cos(jnp.deg2rad(lidar.zenith))
    length = 0.5 * SPEED_OF_LIGHT * plan.bins.width
    fine = jnp.where((heights > top)[None, :], per_metre * length, 0.0)
    return jnp.einsum("wb,bs->ws", fine, pulse_kernel(lidar, plan))


def height_of(lidar: Lidar, time: Float[Array, "bins"]) -> Float[Array, "bins"]:
    """Height above the reference plane (m) from which order one arrives at `time` (ns)."""
    return -0.5 * SPEED_OF_LIGHT * time * jnp.cos(jnp.deg2rad(lidar.zenith))


def total_of(
    response: Response, lidar: Lidar, scene: Scene, plan: Plan
) -> Float[Array, "wavelengths samples"]:
    """Apparent reflectance per sample, all components together."""
    lidar, scene = without(lidar, scene, plan.off)
    # Sums over materials, and the pulse where no atmosphere lies between, come before the many wavelengths.
    letters, values = len(plan.trace.letters), optics(lidar, scene, plan)
    clear = scene.atmosphere is None
    total = jnp.zeros(())
    for degree, part in ((plan.first_degree, response.first), (plan.degree, response.higher)):
        if part is None:
            continue
        part = jnp.sum(part, axis=0)
        part = part @ pulse_kernel(lidar, plan) if clear else part
        total = total + jnp.einsum("hw,hb->wb", histories(letters, degree).monomials(values), part)
    total = total if clear else sample(total, lidar, scene, plan)
    return total + air(lidar, scene, plan) if returns_air(scene) else total


def ledger_of(
    response: Response, optics: Float[Array, "letters wavelengths"], plan: Plan
) -> dict[str, Float[Array, "wavelengths"]]:
    """Shares of the emitted energy. What a material absorbs is what arrived there less what left."""
    letters = len(plan.trace.letters)
    degree = plan.degree if response.higher is not None else plan.first_degree
    monomials = histories(letters, degree).monomials(optics)
    absorbed = (response.arrived - response.left) @ monomials
    ledger = {f"absorbed by {name}": absorbed[i] for i, name in enumerate(plan.trace.materials)}
    return {
        "escaped": response.escaped @ monomials,
        **ledger,
        "after the window": response.late @ monomials,
        "unfollowed": response.remaining @ monomials,
    }


def waveform_of(
    response: Response | list[Response],
    lidar: Lidar,
    scene: Scene,
    plan: Plan,
    *,
    stderr: Float[Array, "wavelengths bins"] | None = None,
    info: dict | None = None,
) -> Waveform:
    """Colour a response and record it.

    **Arguments:**

    - `response`: as traced; a list with one for each wavelength where the canopy's transmission is straight.
    - `stderr`: standard error of the reflectance, from batches. Default zero.
    """
    lidar, scene = without(lidar, scene, plan.off)
    letters = optics(lidar, scene, plan)
    # The pulse, and the sum over all time as one more sample, come before the many wavelengths if they can.
    early = None if scene.atmosphere is not None else _pulse_and_sum(lidar, plan)
    if isinstance(response, list):
        response = [_seen_through(r, early) for r in response]
        parts = [_coloured(r, letters[:, i : i + 1], plan) for i, r in enumerate(response)]
        first = jnp.concatenate([f for f, _, _ in parts], axis=1)
        higher = jnp.concatenate([h for _, h, _ in parts], axis=1)
        ledger = {name: jnp.concatenate([part[name] for _, _, part in parts]) for name in parts[0][2]}
    else:
        first, higher, ledger = _coloured(_seen_through(response, early), letters, plan)
    names = plan.trace.materials
    lines = jnp.concatenate([first + higher, jnp.sum(first, 0)[None], jnp.sum(higher, 0)[None]])
    if early is None:
        sampled, whole = sample(lines, lidar, scene, plan), jnp.sum(lines[-2] + lines[-1], axis=-1)
    else:
        sampled, whole = lines[..., :-1], lines[-2, :, -1] + lines[-1, :, -1]
    components = dict(zip([*names, "first", "higher"], sampled))
    total = sampled[-2] + sampled[-1]
    if returns_air(scene):
        components["air"] = air(lidar, scene, plan)
        components["first"] = components["first"] + components["air"]
        total = total + components["air"]
    time = jnp.asarray(plan.sample_start + plan.sample_interval * np.arange(plan.n_samples))
    slant = lidar.range_to_reference + 0.5 * SPEED_OF_LIGHT * time
    # E_t * eta * A_r / (pi R^2): the lidar equation of a Lambertian target that fills the footprint.
    received = lidar.aperture_area / (jnp.pi * jnp.maximum(slant, 1e-3) ** 2)
    gain = jnp.outer(lidar.energy_per_wavelength * lidar.efficiency_per_wavelength, received)
    returned = whole * lidar.aperture_area / (jnp.pi * lidar.range_to_reference**2)
    # What returns is part of what escaped, or, where only one order was followed, would have.
    source = "unfollowed" if plan.orders == 1 and len(plan.trace.materials) > 1 else "escaped"
    reach = jnp.minimum(returned, ledger[source])
    full = {"returned": reach, **ledger, source: ledger[source] - reach}
    per_energy = whole / jnp.maximum(full["escaped"], 1e-6)
    unfollowed = full["unfollowed"] if plan.orders > 1 else jnp.zeros_like(full["unfollowed"])
    return Waveform(
        time=time,
        height=height_of(lidar, time),
        reflectance=total,
        energy=total * gain,
        stderr=jnp.zeros_like(total) if stderr is None else stderr,
        components=components,
        neglected=unfollowed * jnp.clip(per_energy, 1.0, 4.0),
        ledger=full,
        wavelength=lidar.wavelength,
        info=info or {},
    )


def open_at_first_return(wave: Waveform, lidar: Lidar) -> Waveform:
    """The finely sampled waveform on the digitiser's bins, the first of which opens at the first return.

    See `jaxlidar.first_return_window` for the artefact that this makes. The first return is the first
    sample above the receiver's detection threshold, and above a thousandth of the peak. Standard
    errors of the fine samples are added up as if fully correlated.
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


def _pulse_and_sum(lidar: Lidar, plan: Plan) -> Float[Array, "fine columns"]:
    return jnp.concatenate([pulse_kernel(lidar, plan), jnp.ones((plan.bins.count, 1))], axis=1)


def _seen_through(response: Response, matrix: Float[Array, "fine columns"] | None) -> Response:
    """The response with its fine bins turned into columns of `matrix`; as it is with None."""
    if matrix is None:
        return response
    higher = None if response.higher is None else response.higher @ matrix
    return dataclasses.replace(response, first=response.first @ matrix, higher=higher)


def _coloured(
    response: Response, letters: Float[Array, "letters wavelengths"], plan: Plan
) -> tuple[Array, Array, dict[str, Array]]:
    return (*colour(response, letters, plan), ledger_of(response, letters, plan))
