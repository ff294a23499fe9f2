"""From response to samples: optics of every history, the atmosphere, the pulse, and where the energy went."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._programs import Program
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.planning.effects import can_light_itself
from jaxlidar.planning.ladder import rung
from jaxlidar.planning.sampling import Sampling, sampling_of
from jaxlidar.planning.scatterers import letter_values
from jaxlidar.planning.setup import Setup
from jaxlidar.sampling.waveform_moments import PivotMoments, WaveformMoments
from jaxlidar.scenes.atmosphere import Atmosphere
from jaxlidar.trace.few_wavelengths import FewWavelengths, few_of
from jaxlidar.trace.histories import Histories, histories
from jaxlidar.trace.response import Response

# Programs have room for at least so many wavelengths; more than `_MANY` are a spectrum.
_FEW, _MANY = 4, 16


class Recording(eqx.Module):
    """What turns a response into samples. Programs are compiled for its sizes alone. Made by `recording_of`.

    - `optics`: reflectance or transmittance of every letter. - `sampling`: pulse and digitiser.
    - `time`: of the samples, ns. - `clear`: two-way transmittance of the atmosphere in fine bins, and `air`:
      its own return in samples; None where there is none. - `admissible`: see `Setup`.
    - `materials`: their names. - `first_degree`, `degree`: of histories. - `one_order`: whether no more were
      followed. - `again`: whether light that is scattered can meet the scene again. - `few`: wavelengths that
      stand for all, if any do.
    """

    optics: Float[Array, "letters wavelengths"]
    sampling: Sampling
    time: Float[Array, "samples"]
    clear: Float[Array, "wavelengths fine"] | None
    air: Float[Array, "wavelengths samples"] | None
    admissible: Float[Array, ""]
    lidar: Lidar
    materials: tuple[str, ...] = eqx.field(static=True)
    first_degree: int = eqx.field(static=True)
    degree: int = eqx.field(static=True)
    one_order: bool = eqx.field(static=True)
    again: bool = eqx.field(static=True)
    few: FewWavelengths | None = None

    @property
    def short(self) -> Histories:
        """Histories of order one."""
        return histories(len(self.optics), self.first_degree)

    @property
    def table(self) -> Histories:
        """Histories of all orders."""
        return histories(len(self.optics), self.degree)

    def abridged(self) -> "Recording":
        """The same recording by few wavelengths, where they are many: for errors."""
        if self.lidar.wavelength.size <= _MANY:
            return self
        return dataclasses.replace(self, few=few_of(self.optics, max(self.first_degree, self.degree)))

    @property
    def unspread(self) -> FewWavelengths | None:
        """Few wavelengths from which samples follow. None without such, and where air makes them unlike."""
        return self.few if self.clear is None else None

    def moments(self, wavelengths: int, samples: int) -> WaveformMoments | PivotMoments:
        """Room for the moments of what `total_and_balance` returns, without what is there to spare."""
        if self.unspread is None:
            return WaveformMoments(wavelengths, samples)
        return PivotMoments(np.asarray(self.unspread.shares)[:, :wavelengths])

    @property
    def coloured(self) -> int:
        """Number of wavelengths at which histories are summed."""
        return self.optics.shape[1] if self.few is None else self.few.chosen.size

    def colour(
        self, weights: Float[Array, "traces *rest histories columns"], table: Histories
    ) -> Float[Array, "*rest coloured columns"]:
        """Sums over histories, at all wavelengths or the few that stand for them."""
        return colour(weights, table, self.optics if self.few is None else self.optics[:, self.few.chosen])

    def spread(
        self, found: Float[Array, "*rest coloured columns"]
    ) -> Float[Array, "*rest wavelengths columns"]:
        """What was coloured, at all wavelengths."""
        return found if self.few is None else self.few.spread(found)

    def with_room(self, wavelengths: int) -> "Recording":
        """The same recording with copies of the last wavelength, so that there are `wavelengths`."""
        more = wavelengths - self.lidar.wavelength.size
        if more <= 0:
            return self

        def grown(a: Array, axis: int = 0) -> Array:
            if a.ndim == 0 or a.shape[axis] == 1 < wavelengths - more:
                return a
            last = np.repeat(np.take(np.asarray(a), [-1], axis), more, axis)
            return jnp.asarray(np.concatenate([a, last], axis))

        lidar = self.lidar
        parts = (grown(lidar.wavelength), grown(lidar.energy), grown(lidar.efficiency))
        return dataclasses.replace(
            self,
            optics=grown(self.optics, 1),
            clear=None if self.clear is None else grown(self.clear),
            air=None if self.air is None else grown(self.air),
            lidar=eqx.tree_at(lambda v: (v.wavelength, v.energy, v.efficiency), lidar, parts),
        )


def optics_of(setup: Setup) -> Float[Array, "letters wavelengths"]:
    """Reflectance or transmittance of every letter of the plan, by wavelength."""
    return letter_values(setup.lidar, setup.scene, setup.plan.trace.letters)


def recording_of(setup: Setup) -> Recording:
    """The recording of a setup, for its sizes as they are."""
    return _recording(setup, setup.plan.n_samples, setup.plan.least_degree)


def recording_with_room(setup: Setup) -> Recording:
    """The recording of a setup, with sizes on the ladder, and wavelengths to spare.

    Where wavelengths are many, colouring takes longer than compiling it again: sizes then are as they are.
    """
    plan, many = setup.plan, setup.lidar.wavelength.size
    if many > _MANY:
        return recording_of(setup).with_room(rung(many, 16))
    return _recording(setup, rung(plan.n_samples, 1), plan.degree).with_room(max(rung(many), _FEW))


def _recording(setup: Setup, samples: int, degree: int) -> Recording:
    lidar, plan, air = setup.lidar, setup.plan, setup.scene.atmosphere
    sampling = sampling_of(lidar, plan, samples)
    clear = own = None
    if air is not None:
        bins = plan.bins
        fine = jnp.asarray(bins.start + bins.width * np.arange(bins.count))
        clear, own = _through(air, lidar, fine, jnp.asarray(plan.trace.upstream), jnp.asarray(bins.width))
        own = None if own is None else sampling(own)
    return Recording(
        optics=optics_of(setup),
        sampling=sampling,
        time=jnp.asarray(plan.sample_start + plan.sample_interval * np.arange(samples)),
        clear=clear,
        air=own,
        admissible=setup.admissible,
        lidar=lidar,
        materials=plan.trace.materials,
        first_degree=plan.first_degree if plan.trace.keeps_histories else 0,
        degree=degree,
        one_order=plan.orders == 1,
        again=can_light_itself(setup.scene),
    )


def _atmosphere(
    air: Atmosphere,
    lidar: Lidar,
    time: Float[Array, "fine"],
    upstream: Float[Array, ""],
    width: Float[Array, ""],
) -> tuple[Float[Array, "wavelengths fine"], Float[Array, "wavelengths fine"] | None]:
    """Two-way transmittance in fine bins; and what the air itself returns, where a lidar ratio is given.

    The latter is single scattering, above all of the scene.
    """
    heights = jnp.minimum(height_of(lidar, time), 0.999 * lidar.altitude)
    clear = air.two_way_transmittance(lidar.wavelength, heights, lidar.altitude, lidar.zenith)
    if air.lidar_ratio is None:
        return clear, None
    per_metre = air.backscatter(lidar.wavelength, heights, lidar.altitude, lidar.zenith)
    top = upstream * jnp.cos(jnp.deg2rad(lidar.zenith))
    length = 0.5 * SPEED_OF_LIGHT * width
    return clear, jnp.where((heights > top)[None, :], per_metre * length, 0.0)


_through = Program(_atmosphere)


def height_of(lidar: Lidar, time: Float[Array, "bins"]) -> Float[Array, "bins"]:
    """Height above the reference plane (m) from which order one arrives at `time` (ns)."""
    return -0.5 * SPEED_OF_LIGHT * time * jnp.cos(jnp.deg2rad(lidar.zenith))


def colour(
    weights: Float[Array, "traces *rest histories columns"],
    table: Histories,
    optics: Float[Array, "letters wavelengths"],
) -> Float[Array, "*rest wavelengths columns"]:
    """The sum over histories of weight times the product of optics, by wavelength: a matrix product.

    Histories beyond the table have no weight.
    """
    weights = weights[..., : table.count, :]
    if len(weights) == 1:
        return jnp.einsum("hw,...hc->...wc", table.monomials(optics), weights[0])
    # Each trace has one wavelength.
    return jnp.einsum("hw,w...hc->...wc", table.monomials(optics), weights)


def samples_of(
    weights: Float[Array, "traces *rest histories bins"], table: Histories, recording: Recording
) -> Float[Array, "*rest wavelengths samples"]:
    """Samples by wavelength of weights by history and fine bin: optics, atmosphere, pulse."""
    clear = recording.clear
    if clear is None:
        return recording.spread(_without_air(weights, table, recording))
    fine = recording.spread(recording.colour(weights, table))
    return recording.sampling(fine * clear.reshape((1,) * (fine.ndim - 2) + clear.shape))


def _without_air(
    weights: Float[Array, "traces *rest histories bins"], table: Histories, recording: Recording
) -> Float[Array, "*rest coloured samples"]:
    """Samples without atmosphere, at all wavelengths or the few that stand for them."""
    sampling, weights = recording.sampling, weights[..., : table.count, :]
    count, wavelengths = table.count, recording.coloured
    pulse_last = (wavelengths * (count + sampling.samples)) * sampling.bins
    pulse_first = (count * (sampling.bins + wavelengths)) * sampling.samples
    if len(weights) == 1 and pulse_first < pulse_last:
        return recording.colour(sampling(weights), table)
    return sampling(recording.colour(weights, table))


def total(response: Response, recording: Recording) -> Float[Array, "wavelengths samples"]:
    """Apparent reflectance per sample, all components together."""
    return _total(response, recording, samples_of)


def _total(response: Response, recording: Recording, samples: Callable[..., Array]) -> Array:
    found = jnp.zeros(())
    for table, part in zip((recording.short, recording.table), (response.first, response.higher)):
        if part is not None:
            found = found + samples(jnp.sum(part, axis=1), table, recording)
    return recording.admissible * (found if recording.air is None else found + recording.air)


def columns_in_samples(
    fine: Float[Array, "columns wavelengths bins"], recording: Recording
) -> Float[Array, "columns wavelengths samples"]:
    """Derivatives of `total` from those of what returns in fine bins, as the trace scores them."""
    if recording.clear is not None:
        fine = fine * recording.clear[None]
    return recording.admissible * recording.sampling(fine)


def components(response: Response, recording: Recording) -> dict[str, Float[Array, "wavelengths samples"]]:
    """Apparent reflectance per sample, by material of the last scattering and by order."""
    nothing = jnp.zeros((recording.lidar.wavelength.size, recording.sampling.samples), response.first.dtype)
    # Material by material: together, spectra would be put in another order in memory.
    numbers = range(len(recording.materials))
    first = [samples_of(response.first[:, m], recording.short, recording) for m in numbers]
    higher = [nothing for _ in numbers]
    if response.higher is not None:
        higher = [samples_of(response.higher[:, m], recording.table, recording) for m in numbers]
    found = {name: recording.admissible * (f + h) for name, f, h in zip(recording.materials, first, higher)}
    for name, lines in (("first", first), ("higher", higher)):
        found[name] = recording.admissible * sum(lines, start=nothing)
    if recording.air is not None:
        found["air"] = recording.air
        found["first"] = found["first"] + recording.air
    return found


class Balance(NamedTuple):
    """Where the emitted energy went, (wavelengths,) each: see `Waveform`."""

    ledger: dict[str, Float[Array, "wavelengths"]]
    neglected: Float[Array, "wavelengths"]
    lost: Float[Array, "wavelengths"]


class Shares(NamedTuple):
    """Sums of a response, (wavelengths,) each: of apparent reflectance, and of energy by fate.

    - `whole`, `lost`: apparent reflectance within all fine bins, and before and after them.
    - `absorbed`: by each material; (materials, wavelengths). - `escaped`, `late`, `remaining`: energy.
    """

    whole: Float[Array, "wavelengths"]
    lost: Float[Array, "wavelengths"]
    absorbed: Float[Array, "materials wavelengths"]
    escaped: Float[Array, "wavelengths"]
    late: Float[Array, "wavelengths"]
    remaining: Float[Array, "wavelengths"]


def shares_of(response: Response, recording: Recording) -> Shares:
    """The sums of a response. A material absorbs what arrived there less what left."""
    short = recording.short
    table = short if response.higher is None else recording.table

    def shares(rows: list[Array], table: Histories) -> Array:
        """What rows of (traces, histories) sum up to, all in one product."""
        found = recording.spread(recording.colour(jnp.stack(rows, axis=-1), table))
        return jnp.moveaxis(found, -1, 0)

    whole, lost = shares(
        [jnp.sum(response.first, axis=(1, 3)), jnp.sum(response.first_outside, axis=1)], short
    )
    of_all = [response.escaped, response.late, response.remaining]
    if response.higher is not None and response.higher_outside is not None:
        of_all += [jnp.sum(response.higher, axis=(1, 3)), jnp.sum(response.higher_outside, axis=1)]
    fates = len(of_all)
    absorbed = response.arrived - response.left
    materials = [absorbed[:, m] for m in range(absorbed.shape[1])]
    found = shares([*of_all, *materials], table)
    if fates > 3:
        whole, lost = whole + found[3], lost + found[4]
    return Shares(whole, lost, found[fates:], found[0], found[1], found[2])


def balance(response: Response, recording: Recording) -> Balance:
    """Shares of the emitted energy by fate."""
    return balance_of(shares_of(response, recording), recording)


def balance_of(sums: Shares, recording: Recording) -> Balance:
    """Shares of the emitted energy by fate, from the sums of a response."""
    lidar, whole = recording.lidar, sums.whole
    ledger = {
        "escaped": sums.escaped,
        **{f"absorbed by {name}": sums.absorbed[i] for i, name in enumerate(recording.materials)},
        "after the window": sums.late,
        "unfollowed": sums.remaining,
    }
    returned = whole * lidar.aperture_area / (jnp.pi * lidar.range_to_reference**2)
    # What returns is part of what escaped, or, where only one order was followed, would have.
    source = "unfollowed" if recording.one_order and recording.again else "escaped"
    reach = jnp.minimum(returned, ledger[source])
    ledger = {"returned": reach, **ledger, source: ledger[source] - reach}
    per_energy = whole / jnp.maximum(ledger["escaped"], 1e-6)
    unfollowed = jnp.zeros_like(whole) if recording.one_order else ledger["unfollowed"]
    return Balance(ledger, unfollowed * jnp.clip(per_energy, 1.0, 4.0), sums.lost)


def total_and_balance(
    response: Response, recording: Recording
) -> tuple[Float[Array, "kept samples"], Balance]:
    """What standard errors are known of: see `total` and `balance`.

    Samples are at the few wavelengths of `Recording.unspread` where there are such.
    """
    samples = samples_of if recording.unspread is None else _without_air
    return _total(response, recording, samples), balance(response, recording)
