r"""From response to samples: optics of every history, the atmosphere, the pulse, and the energy budget.

    samples[w, s] = sum over fine bins b of  pulse[b, s] * transmittance[w, b] *
                    sum over histories h of  response[b, h] * prod_c optics[c, w] ** exponent[h, c]

with the two-way transmittance of the atmosphere. Both sums are matrix products. The energy budget applies the
same optics to the weights that arrived at each material, went on from it, escaped, came after the record, or
remained unfollowed.

The received energy falls with the square of the range R from which light was scattered. A pulse spreads what
returns from R over all samples that it covers, so that (R_0 / R)^2, with the range R_0 of the reference
plane, is a factor of fine bins: of response[b, h] above. In samples it would be that of other ranges; by the
mean over a pulse that is long beside the range, energies would be too large.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._fields.checks import array_namespace, as_array
from jaxlidar._jax.products import einsum
from jaxlidar._jax.programs import Program
from jaxlidar.planning.channels import channel_optics
from jaxlidar.planning.config import KERNEL_VARIANCE
from jaxlidar.planning.effects import allows_interreflection
from jaxlidar.planning.record_times import pulse_band
from jaxlidar.planning.setup import Setup
from jaxlidar.planning.size_buckets import size_bucket
from jaxlidar.scenes.atmosphere import Atmosphere
from jaxlidar.sensors.lidar import Lidar
from jaxlidar.spectral.pivot_wavelengths import PivotWavelengths, find_pivots
from jaxlidar.spectral.pulse_convolution import (
    FreeSamplingConvolution,
    PulseConvolution,
    free_sampling_convolution,
    pulse_convolution,
)
from jaxlidar.trace.photons.histories import Histories, histories
from jaxlidar.trace.response import Response

# Programs have room for at least this many wavelengths and samples.
MIN_WAVELENGTHS, MIN_SAMPLES = 4, 512
# Size buckets of samples from one power of two to the next: surveys pay for each sample.
SAMPLE_BUCKETS = 4
# More wavelengths than this are a spectrum: standard errors are computed at pivot wavelengths.
MAX_EXACT_WAVELENGTHS = 16

# By how much an energy budget may sum to more than 1 and its errors. Rounding makes up to 1e-6 of it.
# Footprints that share light leave out the faintest coefficients of their splines, some of them negative: up
# to 1.5e-3 at a tolerance of 0.3, and less in proportion to the tolerance.
MAX_EXCESS = 2e-3


class WaveformModel(eqx.Module):
    """The map from a response to samples, made by `make_waveform_model`.

    Programs are compiled for its sizes alone.

    - `optics`: reflectance or transmittance of every channel.
    - `convolution`: pulse and digitiser. `time`: of the samples, ns.
    - `bin_start`: centre of the first fine bin, ns. `bin_width`: width of fine bins, ns.
    - `transmittance`: two-way, of the atmosphere, in fine bins. `air_return`: its own return, in samples;
      `air_relative_energy`: the relative energy of that (see `relative_energy_samples`). None where there is
      no atmosphere, or no return from it.
    - `admissible`: a factor, 1 or NaN; `is_covered`: True if the plan covers the scene; see `Setup`.
    - `lidar`: the lidar, with its spectrum.
    - `materials`: their names. `first_degree`, `degree`: of histories.
    - `one_order`: True if one order is followed. `can_scatter_again`: True if scattered light can meet the
      scene.
    - `pivots`: wavelengths at which histories are summed, and interpolated to all; None: at all.
    - `batches`: number of batches whose responses are summed; samples are those of their mean. None: one.
    """

    optics: Float[Array, "channels wavelengths"]
    convolution: PulseConvolution | FreeSamplingConvolution
    time: Float[Array, "samples"]
    bin_start: Float[Array, ""]
    bin_width: Float[Array, ""]
    transmittance: Float[Array, "wavelengths fine"] | None
    air_return: Float[Array, "wavelengths samples"] | None
    air_relative_energy: Float[Array, "wavelengths samples"] | None
    admissible: Float[Array, ""]
    is_covered: Bool[Array, ""]
    lidar: Lidar
    materials: tuple[str, ...] = eqx.field(static=True)
    first_degree: int = eqx.field(static=True)
    degree: int = eqx.field(static=True)
    one_order: bool = eqx.field(static=True)
    can_scatter_again: bool = eqx.field(static=True)
    pivots: PivotWavelengths | None = None
    batches: Float[Array, ""] | None = None

    @property
    def first_histories(self) -> Histories:
        """Histories of order one."""
        return histories(len(self.optics), self.first_degree)

    @property
    def histories(self) -> Histories:
        """Histories of all orders."""
        return histories(len(self.optics), self.degree)

    @property
    def range_factor(self) -> Float[Array, "fine"]:
        """(R_0 / R)^2 in fine bins: energy of light from the range R, over that from the reference plane."""
        return _range_factor(self.lidar, self.bin_start, self.bin_width, self.convolution.n_bins)

    def aimed(
        self, lidar: Lidar, atmosphere: Atmosphere | None, start_distance: float | Float[Array, ""]
    ) -> "WaveformModel":
        """Return the model for a lidar of another place or direction, through an atmosphere.

        `start_distance`: of the rays before the reference plane, m.
        """
        if atmosphere is None:
            return dataclasses.replace(self, lidar=lidar)
        n_bins = self.convolution.n_bins
        fine_time = self.bin_start + self.bin_width * jnp.arange(n_bins, dtype=self.bin_width.dtype)
        transmittance, fine_air_return = _compiled_atmosphere(
            atmosphere, lidar, fine_time, as_array(start_distance), self.bin_width
        )
        air_return = air_relative_energy = None
        if fine_air_return is not None:
            range_factor = _range_factor(lidar, self.bin_start, self.bin_width, n_bins)
            air_return = self.convolution(fine_air_return)
            air_relative_energy = self.convolution(fine_air_return * range_factor[None, :])
        return dataclasses.replace(
            self,
            lidar=lidar,
            transmittance=transmittance,
            air_return=air_return,
            air_relative_energy=air_relative_energy,
        )

    def without_air_return(self) -> "WaveformModel":
        """Return the model without what the air returns."""
        return dataclasses.replace(self, air_return=None, air_relative_energy=None)

    def at_pivots(self) -> "WaveformModel":
        """Return the model at pivot wavelengths, where wavelengths are many: for standard errors."""
        if self.lidar.wavelength.size <= MAX_EXACT_WAVELENGTHS:
            return self
        return dataclasses.replace(self, pivots=find_pivots(self.optics, max(self.first_degree, self.degree)))

    def for_applied_optics(self) -> "WaveformModel":
        """Return the model of responses to which optics have been applied while light was traced."""
        return dataclasses.replace(self, first_degree=0, degree=0)

    def for_sum_of(self, batches: Float[Array, ""]) -> "WaveformModel":
        """Return the model of the sum of the responses of a number of batches."""
        return dataclasses.replace(self, batches=batches)

    @property
    def sample_pivots(self) -> PivotWavelengths | None:
        """Pivots from which samples follow; None under an atmosphere, which is no such polynomial."""
        return self.pivots if self.transmittance is None else None

    @property
    def n_summed_wavelengths(self) -> int:
        """Number of wavelengths at which histories are summed."""
        return self.optics.shape[1] if self.pivots is None else self.pivots.indices.size

    def sum_histories(
        self, weights: Float[Array, "traces *rest histories columns"], table: Histories
    ) -> Float[Array, "*rest rows columns"]:
        """Sum weights with their optics over histories, in rows of wavelengths or of pivots."""
        optics = self.optics if self.pivots is None else self.optics[:, self.pivots.indices]
        sums = apply_optics(weights, table, optics)
        # Divided here and not before: a mean response would be a second array of the size of the sum.
        return sums if self.batches is None else sums / self.batches

    def interpolate(
        self, sums: Float[Array, "*rest rows columns"]
    ) -> Float[Array, "*rest wavelengths columns"]:
        """Return the results of `sum_histories` at all wavelengths."""
        return sums if self.pivots is None else self.pivots.interpolate(sums)

    def padded_to(self, n_wavelengths: int) -> "WaveformModel":
        """Return the model with copies of the last wavelength, so that there are `n_wavelengths`."""
        n_original = self.lidar.wavelength.size
        missing = n_wavelengths - n_original
        if missing <= 0:
            return self

        def pad(a: Array, axis: int = 0) -> Array:
            # One number that serves all wavelengths stays one.
            is_shared = a.ndim == 0 or (a.shape[axis] == 1 and n_original > 1)
            return a if is_shared else _repeat_last(a, axis, missing)

        def pad_or_none(a: Array | None) -> Array | None:
            return None if a is None else pad(a)

        lidar = self.lidar
        spectrum = (pad(lidar.wavelength), pad(lidar.energy), pad(lidar.efficiency))
        return dataclasses.replace(
            self,
            optics=pad(self.optics, 1),
            transmittance=pad_or_none(self.transmittance),
            air_return=pad_or_none(self.air_return),
            air_relative_energy=pad_or_none(self.air_relative_energy),
            lidar=eqx.tree_at(lambda v: (v.wavelength, v.energy, v.efficiency), lidar, spectrum),
        )


def setup_optics(setup: Setup) -> Float[Array, "channels wavelengths"]:
    """Return the reflectance or transmittance of every channel of the plan, by wavelength."""
    return channel_optics(setup.lidar, setup.scene, setup.plan.config.channels)


def make_waveform_model(setup: Setup) -> WaveformModel:
    """Make the waveform model of a setup, with its sizes as they are."""
    convolution = pulse_convolution(setup.lidar, setup.plan)
    return _make_model(setup, convolution, setup.plan.sample_interval, setup.plan.degree)


def make_survey_model(setup: Setup) -> WaveformModel:
    """Make the waveform model of all shots of a survey, to be aimed at each, with room for more samples.

    The pulse is applied as a band (see `pulse_convolution`).
    """
    plan = setup.plan
    n_samples = size_bucket(plan.n_samples, SAMPLE_BUCKETS)
    band = pulse_band(plan.pulse_support, plan.sample_interval, plan.first_sample, plan.bins.width)
    convolution = pulse_convolution(setup.lidar, plan, n_samples, band)
    return _make_model(setup, convolution, plan.sample_interval, plan.config.degree)


def make_free_sampling_model(setup: Setup, n_samples: int) -> WaveformModel:
    """Make the waveform model of a setup with the interval of its lidar's samples in place of the plan's.

    It is differentiable with respect to the interval. The first sample is centred where that of the plan is.
    """
    convolution = free_sampling_convolution(setup.lidar, setup.plan, n_samples)
    return _make_model(setup, convolution, setup.lidar.sampling_interval, setup.plan.degree)


def make_padded_waveform_model(setup: Setup) -> WaveformModel:
    """Make the waveform model of a setup, with sizes and wavelengths rounded up to size buckets.

    Only the wavelengths of a spectrum are: applying optics takes longer there than compiling it again.
    """
    plan, n_wavelengths = setup.plan, setup.lidar.wavelength.size
    if n_wavelengths > MAX_EXACT_WAVELENGTHS:
        return make_waveform_model(setup).padded_to(size_bucket(n_wavelengths, 16))
    convolution = pulse_convolution(setup.lidar, plan, size_bucket(max(plan.n_samples, MIN_SAMPLES), 1))
    model = _make_model(setup, convolution, plan.sample_interval, plan.config.degree)
    return model.padded_to(_room_for_wavelengths(n_wavelengths))


def pad_wavelengths(optics: Float[Array, "channels wavelengths"]) -> Float[Array, "channels room"]:
    """Return optics with copies of the last wavelength, as many as `make_padded_waveform_model` has."""
    return _repeat_last(optics, 1, _room_for_wavelengths(optics.shape[1]) - optics.shape[1])


def _repeat_last(a: Array, axis: int, times: int) -> Array:
    """Return an array with copies of its last element along an axis, made without compilation."""
    last = np.repeat(np.take(np.asarray(a), [-1], axis), times, axis)
    return jax.device_put(np.concatenate([a, last], axis))


def _room_for_wavelengths(n_wavelengths: int) -> int:
    """Return the number of wavelengths for which programs have room."""
    return max(size_bucket(n_wavelengths), MIN_WAVELENGTHS)


def _make_model(
    setup: Setup,
    convolution: PulseConvolution | FreeSamplingConvolution,
    sample_interval: float | Float[Array, ""],
    degree: int,
) -> WaveformModel:
    """Make the waveform model of a setup, for samples of a convolution.

    1. The optics of all channels, and the degrees of histories: 0 where optics are applied by the tracer.
    2. Where there is an atmosphere: its transmittance in fine bins, and its own return in samples.
    """
    plan, bins = setup.plan, setup.plan.bins
    model = WaveformModel(
        optics=setup_optics(setup),
        convolution=convolution,
        time=as_array(plan.sample_start + sample_interval * np.arange(convolution.n_samples, dtype=float)),
        bin_start=as_array(bins.start),
        bin_width=as_array(bins.width),
        transmittance=None,
        air_return=None,
        air_relative_energy=None,
        admissible=setup.admissible,
        is_covered=setup.is_covered,
        lidar=setup.lidar,
        materials=plan.config.materials,
        first_degree=plan.config.first_degree if plan.config.keeps_histories else 0,
        degree=degree,
        one_order=not plan.config.follows_higher_orders,
        can_scatter_again=allows_interreflection(setup.scene),
    )
    return model.aimed(setup.lidar, setup.scene.atmosphere, plan.limits.start_distance)


def _atmosphere_in_bins(
    atmosphere: Atmosphere,
    lidar: Lidar,
    time: Float[Array, "fine"],
    start_distance: Float[Array, ""],
    bin_width: Float[Array, ""],
) -> tuple[Float[Array, "wavelengths fine"], Float[Array, "wavelengths fine"] | None]:
    """Return the two-way transmittance in fine bins, and the air's own return where a lidar ratio is given.

    The latter is single scattering, from above all of the scene.
    """
    if lidar.altitude is None:
        distance = jnp.maximum(_range_at(lidar, time), 0.0)
        sensor_height = lidar.position[2]
        return atmosphere.two_way_transmittance_along(
            lidar.wavelength, distance, sensor_height, lidar.zenith
        ), None
    # Not quite up to the sensor, where the range is zero.
    heights = jnp.minimum(height_of(lidar, time), 0.999 * lidar.altitude)
    transmittance = atmosphere.two_way_transmittance(lidar.wavelength, heights, lidar.altitude, lidar.zenith)
    if atmosphere.lidar_ratio is None:
        return transmittance, None
    per_metre = atmosphere.backscatter(lidar.wavelength, heights, lidar.altitude, lidar.zenith)
    top = start_distance * jnp.cos(jnp.deg2rad(lidar.zenith))
    bin_length = 0.5 * SPEED_OF_LIGHT * bin_width
    # Nothing returns before the pulse is sent.
    is_in_air = (heights > top) & (_range_at(lidar, time) > 0.0)
    return transmittance, jnp.where(is_in_air[None, :], per_metre * bin_length, 0.0)


_compiled_atmosphere = Program(_atmosphere_in_bins)


def _range_at(lidar: Lidar, time: Float[Array, "bins"]) -> Float[Array, "bins"]:
    """Range (m) from which order one arrives at `time` (ns)."""
    if lidar.has_sensor_position:
        return 0.5 * SPEED_OF_LIGHT * time
    return lidar.range_to_reference + 0.5 * SPEED_OF_LIGHT * time


def _range_factor(
    lidar: Lidar, bin_start: Float[Array, ""], bin_width: Float[Array, ""], n_bins: int
) -> Float[Array, "fine"]:
    """Return (R_0 / R)^2 in fine bins of centres from `bin_start`, ns, on.

    1. The range of each bin's centre.
    2. A return from the range R is spread over bins by a kernel of the variance v. The mean of 1 / R^2 over
       it is (1 + 3 v / R^2) / R^2, to second order: 1 / (R^2 + 3 v) has the mean 1 / R^2.
    3. No more light enters the aperture than all of it: A / (pi R^2) is at most 1.
    """
    distance = _range_at(lidar, bin_start + bin_width * jnp.arange(n_bins, dtype=bin_width.dtype))
    variance = KERNEL_VARIANCE * (0.5 * SPEED_OF_LIGHT * bin_width) ** 2
    aperture_radius = 0.5 * lidar.aperture
    return lidar.range_to_reference**2 / jnp.maximum(distance**2 + 3.0 * variance, aperture_radius**2)


def height_of(lidar: Lidar, time: Float[Array, "bins"]) -> Float[Array, "bins"]:
    """Height above the reference plane (m) from which order one arrives at `time` (ns)."""
    height = -0.5 * SPEED_OF_LIGHT * time * jnp.cos(jnp.deg2rad(lidar.zenith))
    return height + lidar.position[2] if lidar.has_sensor_position else height


def apply_optics(
    weights: Float[Array, "traces *rest histories columns"],
    table: Histories,
    optics: Float[Array, "channels wavelengths"],
) -> Float[Array, "*rest wavelengths columns"]:
    """Sum weights times the product of optics over histories, by wavelength: a matrix product.

    Histories beyond the table have no weight.
    """
    weights = weights[..., : table.count, :]
    if len(weights) == 1:
        return einsum("hw,...hc->...wc", table.monomials(optics), weights[0])
    # Each trace has one wavelength.
    return einsum("hw,w...hc->...wc", table.monomials(optics), weights)


def response_samples(
    weights: Float[Array, "traces *rest histories bins"], table: Histories, model: WaveformModel
) -> Float[Array, "*rest wavelengths samples"]:
    """Return samples by wavelength of weights by history and fine bin: optics, atmosphere, pulse."""
    transmittance = model.transmittance
    if transmittance is None:
        return model.interpolate(_samples_without_air(weights, table, model))
    fine = model.interpolate(model.sum_histories(weights, table))
    return model.convolution(fine * transmittance.reshape((1,) * (fine.ndim - 2) + transmittance.shape))


def _samples_without_air(
    weights: Float[Array, "traces *rest histories bins"], table: Histories, model: WaveformModel
) -> Float[Array, "*rest rows samples"]:
    """Return samples without atmosphere, in rows of wavelengths or of pivots.

    Pulse and optics commute: the order with fewer operations is taken.
    """
    convolution, weights = model.convolution, weights[..., : table.count, :]
    n_histories, n_wavelengths = table.count, model.n_summed_wavelengths
    cost_optics_first = n_wavelengths * (n_histories + convolution.n_samples) * convolution.n_bins
    cost_pulse_first = n_histories * (convolution.n_bins + n_wavelengths) * convolution.n_samples
    if len(weights) == 1 and cost_pulse_first < cost_optics_first:
        return model.sum_histories(convolution(weights), table)
    return convolution(model.sum_histories(weights, table))


def total_samples(response: Response, model: WaveformModel) -> Float[Array, "wavelengths samples"]:
    """Return the apparent reflectance per sample, all components together."""
    return _sum_orders(response, model, response_samples)


def relative_energy_samples(response: Response, model: WaveformModel) -> Float[Array, "wavelengths samples"]:
    """Return the relative energy per sample, all components together.

    It is the received energy, over that of an apparent reflectance of 1 at the range of the reference plane.
    """

    def to_samples(weights: Array, table: Histories, model: WaveformModel) -> Array:
        range_factor = model.range_factor.reshape((1,) * (weights.ndim - 1) + (-1,))
        return response_samples(weights * range_factor, table, model)

    air = model.air_relative_energy
    return _sum_orders(response, dataclasses.replace(model, air_return=air), to_samples)


def _sum_orders(
    response: Response, model: WaveformModel, to_samples: Callable[[Array, Histories, WaveformModel], Array]
) -> Array:
    total = jnp.zeros(())
    tables = (model.first_histories, model.histories)
    for table, weights in zip(tables, (response.first, response.higher)):
        if weights is not None:
            total = total + to_samples(jnp.sum(weights, axis=1), table, model)
    return model.admissible * (total if model.air_return is None else total + model.air_return)


def derivatives_to_samples(
    fine: Float[Array, "columns wavelengths bins"], model: WaveformModel
) -> Float[Array, "columns wavelengths samples"]:
    """Return derivatives of `total_samples` from those in fine bins (see `trace.response`)."""
    if model.transmittance is not None:
        fine = fine * model.transmittance[None]
    return model.admissible * model.convolution(fine)


def component_samples(
    response: Response, model: WaveformModel
) -> dict[str, Float[Array, "wavelengths samples"]]:
    """Return the apparent reflectance per sample, by material of the last scattering and by order."""
    shape = (model.lidar.wavelength.size, model.convolution.n_samples)
    zero = jnp.zeros(shape, response.first.dtype)
    # Material by material: together, spectra would be transposed in memory.
    numbers = range(len(model.materials))
    first = [response_samples(response.first[:, m], model.first_histories, model) for m in numbers]
    higher = [zero for _ in numbers]
    if response.higher is not None:
        higher = [response_samples(response.higher[:, m], model.histories, model) for m in numbers]
    components = {name: model.admissible * (f + h) for name, f, h in zip(model.materials, first, higher)}
    for name, samples in (("first", first), ("higher", higher)):
        components[name] = model.admissible * sum(samples, start=zero)
    if model.air_return is not None:
        components["air"] = model.air_return
        components["first"] = components["first"] + model.air_return
    return components


class BudgetTerms(NamedTuple):
    """Fractions of the emitted energy by fate, and light that is not in the record, (wavelengths,) each.

    See `Waveform`. Its `neglected` is the apparent reflectance `unfollowed`, of orders beyond the last, and
    `outside`, of light that is in flight at the end of the record.
    """

    energy_budget: dict[str, Float[Array, "wavelengths"]]
    unfollowed: Float[Array, "wavelengths"]
    outside: Float[Array, "wavelengths"]
    lost: Float[Array, "wavelengths"]

    @property
    def neglected(self) -> Float[Array, "wavelengths"]:
        """Apparent reflectance of all light that was left out, an estimate."""
        return self.unfollowed + self.outside


def budget_excess(
    energy_budget: Mapping[str, Float[Any, "wavelengths"]],
    stderr: Mapping[str, Float[Any, "wavelengths"]],
) -> Float[Any, ""]:
    """Return by how much the fractions of an energy budget sum to more than 1 and five standard errors.

    It is the largest of all wavelengths. The error of a sum is at most the sum of the errors.
    """
    total = sum(energy_budget.values())
    excess = total - 1.0 - 5.0 * sum(stderr.values())
    return array_namespace(excess).max(excess)


def refuse_excess(excess: Float[Any, "*shots"]) -> None:
    """Refuse results whose energy budget has more light than was emitted.

    **Arguments:** `excess`: see `budget_excess`; of several shots.

    **Raises:** RuntimeError with the largest excess.
    """
    largest = float(np.max(excess, initial=0.0))
    if largest > MAX_EXCESS:
        raise RuntimeError(
            f"the energy budget sums to {100.0 * largest:.3g} % more than the emitted light, beyond five "
            "standard errors: light was counted twice, as where surfaces of your own coincide"
        )


class ResponseSums(NamedTuple):
    """Sums of a response with optics applied, (wavelengths,) each.

    - `returned`, `returned_outside`: apparent reflectance within all fine bins, and before and after them.
    - `relative_energy`: of what returned (see `relative_energy_samples`).
    - `absorbed`: by each material; (materials, wavelengths). - `escaped`, `flown_outside`, `unfollowed`:
      energy that the budget lists as "escaped", "after the window" and "unfollowed".
    """

    returned: Float[Array, "wavelengths"]
    returned_outside: Float[Array, "wavelengths"]
    relative_energy: Float[Array, "wavelengths"]
    absorbed: Float[Array, "materials wavelengths"]
    escaped: Float[Array, "wavelengths"]
    flown_outside: Float[Array, "wavelengths"]
    unfollowed: Float[Array, "wavelengths"]


def sum_response(response: Response, model: WaveformModel) -> ResponseSums:
    """Sum a response over bins, with optics applied.

    1. Order one has a table of histories of its own: what it returns, within all fine bins and outside.
    2. All else in one product: energy that escaped, flew on outside of the record or was not followed, and
       what each material absorbs, which is the energy that arrived there less that which departed.
    3. What higher orders return, if they are followed, is added to order one.
    """
    first_table = model.first_histories
    table = first_table if response.higher is None else model.histories

    def sums(rows: list[Array], table: Histories) -> Array:
        """Sum rows of (traces, histories) with their optics, all in one product."""
        products = model.interpolate(model.sum_histories(jnp.stack(rows, axis=-1), table))
        return jnp.moveaxis(products, -1, 0)

    factors = jnp.stack([jnp.ones_like(model.range_factor), model.range_factor], axis=-1)

    def rows_of_returns(weights: Array, outside: Array) -> list[Array]:
        # One product reads the response, which is large, once for both sums.
        by_material = einsum("tmhb,bk->tmhk", weights, factors)
        returned, relative_energy = jnp.moveaxis(jnp.sum(by_material, axis=1), -1, 0)
        return [returned, jnp.sum(outside, axis=1), relative_energy]

    returned, returned_outside, relative_energy = sums(
        rows_of_returns(response.first, response.first_outside), first_table
    )
    rows = [response.escaped, response.flown_outside, response.unfollowed]
    if response.higher is not None and response.higher_outside is not None:
        rows += rows_of_returns(response.higher, response.higher_outside)
    absorbed_weights = response.arrived - response.departed
    materials = [absorbed_weights[:, m] for m in range(absorbed_weights.shape[1])]
    totals, n_rows = sums([*rows, *materials], table), len(rows)
    (escaped, flown_outside, unfollowed), higher, absorbed = totals[:3], totals[3:n_rows], totals[n_rows:]
    if len(higher):
        higher_returned, higher_outside, higher_relative_energy = higher
        returned, returned_outside = returned + higher_returned, returned_outside + higher_outside
        relative_energy = relative_energy + higher_relative_energy
    return ResponseSums(
        returned, returned_outside, relative_energy, absorbed, escaped, flown_outside, unfollowed
    )


def budget_terms(response: Response, model: WaveformModel) -> BudgetTerms:
    """Return the energy budget of a response."""
    return budget_of_sums(sum_response(response, model), model)


def _energy_fractions(sums: ResponseSums, model: WaveformModel) -> dict[str, Float[Array, "wavelengths"]]:
    """Return energies by name from the sums of a response, or from those of its standard errors.

    What returned is still part of what escaped, or was not followed.
    """
    lidar = model.lidar
    return {
        # The energy into the aperture is the apparent reflectance times the aperture's solid angle over pi;
        # that of the reference plane, as the relative energy has the factor of other ranges.
        "returned": sums.relative_energy * lidar.aperture_area / (jnp.pi * lidar.range_to_reference**2),
        "escaped": sums.escaped,
        **{f"absorbed by {name}": sums.absorbed[i] for i, name in enumerate(model.materials)},
        "after the window": sums.flown_outside,
        "unfollowed": sums.unfollowed,
    }


def budget_stderr_of_sums(
    stderr: ResponseSums, model: WaveformModel
) -> dict[str, Float[Array, "wavelengths"]]:
    """Return the standard errors of the energy budget from those of the sums of a response.

    `budget_of_sums` takes what returned off its source, and returns no more than the source has. These are no
    rules for standard errors: that of each sum stays its own.
    """
    return _energy_fractions(stderr, model)


def unfollowed_return(unfollowed: Any, escaped: Any, returned: Any) -> Any:
    """Return the apparent reflectance that light beyond the last order may add.

    It is taken to return as much per energy as the light that escaped, but an apparent reflectance of 1 per
    unit of energy at least, and 4 at most. `unfollowed`, `escaped`: energies. `returned`: reflectance.
    """
    return unfollowed * (returned / escaped.clip(1e-6)).clip(1.0, 4.0)


def budget_of_sums(sums: ResponseSums, model: WaveformModel) -> BudgetTerms:
    """Return the energy budget from the sums of a response."""
    budget = _energy_fractions(sums, model)
    # Light that returns is part of that which escaped or, where only one order was followed, would have.
    source = "unfollowed" if model.one_order and model.can_scatter_again else "escaped"
    returned = jnp.minimum(budget["returned"], budget[source])
    budget = {**budget, "returned": returned, source: budget[source] - returned}
    # Where one order is followed no scattered light has escaped to compare with, and the user left higher
    # orders out: the estimate is zero.
    unfollowed = jnp.zeros_like(sums.returned)
    if not model.one_order:
        unfollowed = unfollowed_return(budget["unfollowed"], budget["escaped"], sums.returned)
    # Light in flight has yet to meet the scene. It is taken to return as much per energy as all light that
    # was followed and, as it may meet the ground where the beam met dark leaves, no less than a panel of the
    # largest reflectance or transmittance.
    in_flight, followed_return = budget["after the window"], sums.returned + sums.returned_outside
    followed = jnp.maximum(1.0 - in_flight - budget["unfollowed"], 1e-6)
    brightest = jnp.max(model.optics, axis=0, initial=0.0)
    outside = in_flight * jnp.maximum(followed_return / followed, brightest)
    # What a plan that does not cover the scene leaves out is not known: all light of a white surface, and no
    # less than what was found, as mirrors return more.
    lost = jnp.where(model.is_covered, sums.returned_outside, jnp.maximum(followed_return, 1.0))
    return BudgetTerms(budget, unfollowed, outside, lost)


def samples_and_budget(
    response: Response, model: WaveformModel
) -> tuple[Float[Array, "rows samples"], BudgetTerms]:
    """Return the quantities of a batch whose standard errors are estimated.

    Samples are in rows of wavelengths, or of the pivots `WaveformModel.sample_pivots` where there are any.
    """
    to_samples = response_samples if model.sample_pivots is None else _samples_without_air
    return _sum_orders(response, model, to_samples), budget_terms(response, model)
