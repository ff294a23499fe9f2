r"""Log-posterior density of the unknowns of one waveform, in unconstrained coordinates, for samplers.

**Coordinates.** An unknown x with the bounds (a, b) is x = a + (b - a) s(u), s(u) = 1 / (1 + exp(-u)), with u
any real number. The density of u is that of x times

    |dx / du| = (b - a) s(u) s(-u).

**Density.** With w(x) the record of the simulated waveform, y the observed one, C the covariance of their
difference (`inversion.fit.data`) and q(x) the residuals of the priors (`inversion.fit.prior_residuals`),

    ln p(u) = -1/2 |C^-1/2 (w - y)|^2 - 1/2 ln det C - 1/2 |q|^2 - sum_log ln x + ln |dx / du| + constant.

Unknowns without prior are uniform within their bounds. The sum is over unknowns with a log-normal prior,
whose density in x itself has the factor 1 / x. A fit leaves out that factor and ln |dx / du|: its estimate
is the mode in x, or in ln x.

**Noise.** C holds the noise of the measurement, and those of the simulation and of a recorded pulse, both
times the unknown "scale" where there is one. So ln det C changes with the scale alone. Noise of simulation
and pulse is that at the initial values: estimated anew at each value from few batches, it would add noise of
its own to the density.

**Simulation.** All evaluations use the same random numbers, as those of a fit do (`inversion.fit.model`,
whose functions these are), so that the density is smooth but for small jumps, and each gradient is that of
the waveform's expectation.

**Source:** transforms and their Jacobians: Carpenter et al. (2017), J. Stat. Softw. 76(1), section on
constrained variables; Gelman et al. (2013), Bayesian Data Analysis, chapter 12.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, PRNGKeyArray, UInt32

from inversion.fit.data import ObservedWaveform
from inversion.fit.model import Evaluation, ForwardModel, SimulationInputs, evaluate_scene
from inversion.fit.prior_residuals import fixed_priors
from inversion.fit.problem import Problem, check_problem
from inversion.fit.recorder_model import RecorderModel
from inversion.fit.unknowns import flat_bounds, flat_labels, flat_start, split_values
from jaxlidar import total_reflectance
from jaxlidar.extend import as_numpy, check_key, check_range, matmul, tensordot
from jaxlidar.trace.response import Response

Shapes = tuple[tuple[int, ...], ...]


class _Simulation(eqx.Module):
    """Arguments of a simulation that traces photons.

    - `key_data`, `key_impl`: of the batches' random keys: typed keys cannot be pickled.
    - `order`: sorts the columns of a Jacobian, which are computed by dependence, as the flattened unknowns.
    """

    inputs: SimulationInputs
    key_data: UInt32[Array, "batches words"]
    key_impl: str = eqx.field(static=True)
    order: Int[Array, " n"]
    shapes: Shapes = eqx.field(static=True)

    @property
    def keys(self) -> Array:
        return jax.random.wrap_key_data(self.key_data, impl=self.key_impl)

    @property
    def n_batches(self) -> Array:
        return jnp.asarray(len(self.key_data))

    @property
    def inputs_without_columns(self) -> SimulationInputs:
        """Inputs by which the trace computes no column of a Jacobian."""
        setters = tuple(setter._replace(dependence="optical") for setter in self.inputs.setters)
        return dataclasses.replace(self.inputs, setters=setters, columns_per_voxel=0)


@eqx.filter_custom_jvp
def _traced_reflectance(simulation: _Simulation, flat: Array) -> Float[Array, "wavelengths bins"]:
    values = split_values(flat, simulation.shapes)
    inputs = simulation.inputs_without_columns
    return evaluate_scene(inputs, values, simulation.keys, simulation.n_batches)[0]


@_traced_reflectance.def_jvp
def _(primals: Any, tangents: Any) -> tuple[Array, Array]:
    # One pass gives waveform and Jacobian, each column by its cheapest method. The tangent is linear in that
    # of the values, so that JAX transposes it: a gradient costs this pass as well.
    (simulation, flat), (_, flat_tangent) = primals, tangents
    values = split_values(flat, simulation.shapes)
    reflectance, columns, _ = evaluate_scene(simulation.inputs, values, simulation.keys, simulation.n_batches)
    if flat_tangent is None:
        return reflectance, jnp.zeros_like(reflectance)
    return reflectance, tensordot(flat_tangent, columns[simulation.order], 1)


class _RecordNoise(eqx.Module):
    """Observed samples and the parts of their noise.

    - `samples`: (samples,) indices of the samples that have weight, in the flattened record.
    - `observed`, `sigma`: their values, and the standard deviation of the measurement.
    - `simulation_sigma`: standard deviation of the simulation, for a scale of 1.
    - `shared_errors`, `correlation`: as of `inversion.fit.data.SampleNoise`; the first for a scale of 1.
    """

    samples: Int[Array, " samples"]
    observed: Float[Array, " samples"]
    sigma: Float[Array, " samples"]
    simulation_sigma: Float[Array, " samples"]
    shared_errors: Float[Array, "samples errors"] | None
    correlation: Float[Array, "samples samples"] | None

    def log_likelihood(self, record: Float[Array, "wavelengths bins"], scale: Any) -> Float[Array, ""]:
        """Return the logarithm of the normal density of the observed samples, up to a constant."""
        sigma = jnp.hypot(self.sigma, scale * self.simulation_sigma)
        residual = (record.reshape(-1)[self.samples] - self.observed) / sigma
        # Relative to the noise of the measurement: logarithms near zero lose least to rounding.
        log_determinant = jnp.sum(jnp.log(sigma / self.sigma))
        if self.shared_errors is not None or self.correlation is not None:
            covariance = jnp.eye(sigma.size) if self.correlation is None else self.correlation
            if self.shared_errors is not None:
                shared = scale * self.shared_errors / sigma[:, None]
                covariance = covariance + matmul(shared, shared.T)
            cholesky = jnp.linalg.cholesky(covariance)
            residual = jax.scipy.linalg.solve_triangular(cholesky, residual, lower=True)
            log_determinant += jnp.sum(jnp.log(jnp.diag(cholesky)))
        return -0.5 * jnp.sum(residual**2) - log_determinant


@final
class LogDensity(eqx.Module):
    """The result of `log_density`: a log-posterior as a function of unconstrained coordinates.

    `density(x)` is its logarithm up to a constant, compiled, for x of shape (n,);
    `jax.value_and_grad(density)` its gradient. It serves `jax.vmap` and samplers written in JAX, and can be
    pickled under the conditions of `Unknown`. Gradients of a density that traces photons are not
    differentiated again.

    - `initial`: (n,) coordinates of the starting values, with offsets and scale of a recorder fitted to them.
    - `names`: labels of the n coordinates, with an index for elements of arrays.

    **Example:**

    >>> import jaxlidar as jl
    >>> import inversion, jax
    >>> scene = jl.Scene(ground=jl.Ground(height=0.5))
    >>> wave = jl.simulate(jl.Lidar(), scene, key=jax.random.key(0))
    >>> height = inversion.Unknown("ground.height", bounds=(-2.0, 2.0), name="height")
    >>> problem = inversion.Problem(wave, jl.Lidar(), scene, [height], noise=0.01)
    >>> density = inversion.log_density(problem, key=jax.random.key(1))
    >>> gradient = jax.grad(density)(density.initial)
    >>> print(density.names, f"{float(density.to_natural(density.initial)['height']):.2f} m")
    ('height',) 0.50 m
    """

    initial: Float[Array, " n"]
    names: tuple[str, ...] = eqx.field(static=True)
    _unknown_names: tuple[str, ...] = eqx.field(static=True)
    _shapes: Shapes = eqx.field(static=True)
    _low: Float[Array, " n"]
    _width: Float[Array, " n"]
    _prior_centre: Float[Array, " n_scene"]
    _prior_whitening: Float[Array, "n_scene n_scene"]
    _has_log_prior: tuple[bool, ...] = eqx.field(static=True)
    _simulation: _Simulation
    # The mean response where no unknown changes it: photons have been traced once.
    _response: Response | None
    # None for a recorder that changes nothing, so that densities of many waveforms share one program.
    _recorder: RecorderModel | None = eqx.field(static=True)
    _noise: _RecordNoise

    # Compiled as a method: arrays of the density are arguments, and many densities share one program.
    @eqx.filter_jit
    def __call__(self, x: Float[Array, "..."]) -> Float[Array, ""]:
        """Return the log-density at unconstrained coordinates, -inf where the scene cannot be simulated.

        That is where a value is inadmissible, such as a leaf that reflects more light than reaches it, where
        the scene is larger than the plan is for, and where the simulation is not finite. Gradients are zero
        in the first two cases.

        **Arguments:** `x`: (n,) coordinates, in the order of `names`.

        **Returns:** a scalar, up to a constant.

        **Raises:** ValueError for coordinates of another shape.
        """
        x = self._checked(x)
        if x.ndim != 1:
            raise ValueError(f"x has the shape {x.shape}; admissible is ({len(self.names)},): use jax.vmap")
        n_scene = self._prior_centre.size
        scene_values = self._natural(x)[:n_scene]
        simulation = self._simulation
        can_simulate = simulation.inputs.can_simulate(split_values(scene_values, simulation.shapes))
        # Simulate the start instead: derivatives of what is not finite would be NaN although it is not used.
        x = jnp.where(can_simulate, x, self.initial)
        natural = self._natural(x)
        # d x / d u, over the width of the bounds, which is a constant.
        log_jacobian = jnp.sum(jax.nn.log_sigmoid(x) + jax.nn.log_sigmoid(-x))
        scene_values, recorder_values = natural[:n_scene], natural[n_scene:]
        record, scale = self._reflectance(scene_values), 1.0
        if self._recorder is not None:
            record = self._recorder.record(record, recorder_values)
            scale = self._recorder.scale_of(recorder_values)
        total = self._noise.log_likelihood(record, scale) + self._log_prior(scene_values) + log_jacobian
        # Samplers reject a point of density zero; NaN would stop them.
        return jnp.where(can_simulate & jnp.isfinite(total), total, -jnp.inf)

    def to_natural(self, x: Float[ArrayLike, "... n"]) -> dict[str, Float[Array, "..."]]:
        """Return values of the unknowns, in their own units and by name, from unconstrained coordinates.

        **Arguments:** `x`: (..., n), such as the draws of a sampler.

        **Returns:** by name, (..., *shape of the unknown).

        **Raises:** ValueError for coordinates of another shape.
        """
        natural = self._natural(self._checked(x))
        return dict(zip(self._unknown_names, split_values(natural, self._shapes)))

    def to_unconstrained(self, values: Mapping[str, ArrayLike]) -> Float[Array, "... n"]:
        """Return unconstrained coordinates from values of all unknowns, such as those of a fit.

        **Arguments:** `values`: by name, (..., *shape of the unknown), between their bounds.

        **Returns:** (..., n).

        **Raises:** ValueError for a missing value, and for one outside its bounds or on them.
        """
        if missing := [name for name in self._unknown_names if name not in values]:
            raise ValueError(f"values lacks {', '.join(map(repr, missing))}; admissible are all unknowns")
        rows, low, width = [], np.asarray(self._low), np.asarray(self._width)
        column = 0
        for name, shape in zip(self._unknown_names, self._shapes):
            value = as_numpy(values[name], name)
            size, leading = int(np.prod(shape)), value.shape[: value.ndim - len(shape)]
            if value.shape[len(leading) :] != shape:
                raise ValueError(f"{name} has the shape {value.shape}; admissible is (..., *{shape})")
            columns = slice(column, column + size)
            fraction = (value.reshape(*leading, size) - low[columns]) / width[columns]
            check_range(
                f"{name}, in widths of its bounds,", fraction, 0.0, 1.0, low_open=True, high_open=True
            )
            rows.append(np.log(fraction) - np.log1p(-fraction))
            column += size
        return jnp.asarray(np.concatenate(rows, axis=-1), self.initial.dtype)

    def to_unconstrained_covariance(
        self, covariance: Float[ArrayLike, "n n"], values: Mapping[str, ArrayLike]
    ) -> Float[Array, "n n"]:
        """Return the covariance of unconstrained coordinates from that of a fit, linearised at its values.

        Samplers take it as their metric (blackjax: `inverse_mass_matrix`): steps are then long along
        directions that the record leaves open, and no long adaptation has to find them.

        **Arguments:**

        - `covariance`: (n, n) of natural values, symmetric, in the order of `names`, such as
          `Retrieval.covariance`. Unknowns of scale and recorder are among them.
        - `values`: by name, as for `to_unconstrained`.

        **Returns:** (n, n).

        **Raises:** ValueError for a covariance of another shape, or with numbers that are not finite, as of
        unknowns that nothing constrains, or that is not positive definite; and as `to_unconstrained`.
        """
        x = self.to_unconstrained(values)
        if x.ndim != 1:
            raise ValueError(
                f"values has leading axes {x.shape[:-1]}; admissible is one value of each unknown"
            )
        natural, n = as_numpy(covariance, "covariance"), len(self.names)
        if natural.shape != (n, n):
            raise ValueError(f"covariance has the shape {natural.shape}; admissible is ({n}, {n})")
        check_range("covariance", natural)
        variances = np.diag(natural)
        check_range("the diagonal of covariance", variances, 0.0, low_open=True)
        correlation = natural / np.sqrt(variances[:, None] * variances[None])
        smallest = np.min(np.linalg.eigvalsh(0.5 * (correlation + correlation.T)))
        if smallest <= 0.0 or not np.allclose(correlation, correlation.T, atol=1e-4):
            raise ValueError(
                "covariance is not that of any values (smallest eigenvalue of its correlations "
                f"{smallest:.2g}); admissible is a symmetric, positive definite one"
            )
        x, width = np.asarray(x, float), np.asarray(self._width, float)
        # dx / du of natural values x; both factors keep their digits near the bounds.
        slope = width / ((1.0 + np.exp(-x)) * (1.0 + np.exp(x)))
        return jnp.asarray(natural / (slope[:, None] * slope[None]), self.initial.dtype)

    def _checked(self, x: Any) -> Array:
        x = jnp.asarray(x, self.initial.dtype)
        if x.ndim == 0 or x.shape[-1] != len(self.names):
            raise ValueError(f"x has the shape {x.shape}; admissible is (..., {len(self.names)})")
        return x

    def _natural(self, x: Float[Array, "... n"]) -> Float[Array, "... n"]:
        # JAX refuses arrays of unlike rank where a user has told it to.
        low, width = (jnp.broadcast_to(bound, x.shape) for bound in (self._low, self._width))
        return low + width * jax.nn.sigmoid(x)

    def _reflectance(self, scene_values: Array) -> Float[Array, "wavelengths bins"]:
        # Optics act on a response after it has been traced: one response serves all values of such unknowns.
        if self._response is None:
            return _traced_reflectance(self._simulation, scene_values)
        values = split_values(scene_values, self._simulation.shapes)
        return total_reflectance(self._response, self._simulation.inputs.setup(values))

    def _log_prior(self, scene_values: Array) -> Float[Array, ""]:
        is_log = np.array(self._has_log_prior)
        # Elements without a log-normal prior get an argument of 1, which has no logarithm to speak of.
        tiny = jnp.finfo(scene_values.dtype).tiny
        logarithm = jnp.log(jnp.where(is_log, jnp.maximum(scene_values, tiny), 1.0))
        transformed = jnp.where(is_log, logarithm, scene_values)
        residual = matmul(self._prior_whitening, transformed - self._prior_centre)
        return -0.5 * jnp.sum(residual**2) - jnp.sum(logarithm)


def log_density(problem: Problem, *, key: PRNGKeyArray) -> LogDensity:
    """Log-posterior density of the unknowns of a problem of one record, for samplers of your choice.

    The prior of an unknown is its `Unknown.prior` within its bounds, or uniform within them; the likelihood
    is normal, with the noise of the record, of the simulation and of a recorded pulse, the latter two as
    they are at the starting values. Start from a fit (`scene=fit.scene`) where these matter. The unknowns of
    scale and recorder are uniform within their bounds. The strength of a `Smooth` prior must be given.

    Photons are traced once where all unknowns act through optics alone (leaf traits, reflectances, the
    atmosphere), and with the same random numbers at each evaluation otherwise. A gradient costs a simulation
    with its derivatives in the unknowns that need the trace, as a step of `retrieve` does.

    **Arguments:** `problem`: a `Problem` of one record. `key`: a JAX random key.

    **Returns:** a `LogDensity`.

    **Raises:** ValueError for a problem of many records or none, and for a `Smooth` prior without strength.
    TypeError for arguments of another kind.

    **Example:** the posterior of a reflectance by quadrature.

    >>> import jaxlidar as jl
    >>> import inversion, jax
    >>> import jax.numpy as jnp
    >>> scene = jl.Scene(ground=jl.Ground(reflectance=0.3))
    >>> wave = jl.simulate(jl.Lidar(), scene, key=jax.random.key(0))
    >>> unknown = inversion.Unknown("ground.reflectance", bounds=(0.0, 1.0), name="R")
    >>> problem = inversion.Problem(wave, jl.Lidar(), scene, [unknown], noise=0.01)
    >>> density = inversion.log_density(problem, key=jax.random.key(1))
    >>> x = jnp.linspace(-2.0, 0.0, 201)[:, None]
    >>> weight = jax.nn.softmax(jax.vmap(density)(x))
    >>> print(f"{float(weight @ density.to_natural(x)['R']):.2f}")
    0.30
    """
    check_problem(problem)
    check_key(key)
    bound = problem.bound
    observed, scene_unknowns, recorder_model = bound.observed[0], bound.unknowns[0], bound.recorder_model(0)
    priors = fixed_priors(scene_unknowns)
    model = ForwardModel(bound.lidars[0], bound.scenes[0], bound.plan, scene_unknowns, key)
    start = flat_start(scene_unknowns)
    evaluation = model(start, with_batches=True)
    recorder_start = recorder_model.start(evaluation.reflectance, observed)
    all_unknowns = bound.all_unknowns
    low, high = flat_bounds(all_unknowns)
    fraction = (np.concatenate([start, recorder_start]) - low) / (high - low)
    simulation = _Simulation(
        inputs=model.inputs,
        key_data=jnp.stack([jax.random.key_data(batch_key) for batch_key in model.keys]),
        key_impl=str(jax.random.key_impl(key)),
        order=jnp.asarray(model.order),
        shapes=tuple(model.shapes),
    )
    records_plainly = recorder_model.receiver.is_identity and not recorder_model.count
    return LogDensity(
        initial=jnp.asarray(np.log(fraction) - np.log1p(-fraction)),
        names=flat_labels(all_unknowns),
        _unknown_names=tuple(unknown.name for unknown in all_unknowns),
        _shapes=tuple(unknown.start.shape for unknown in all_unknowns),
        _low=jnp.asarray(low),
        _width=jnp.asarray(high - low),
        _prior_centre=jnp.asarray(priors.centre),
        _prior_whitening=jnp.asarray(priors.whitening),
        _has_log_prior=tuple(map(bool, priors.is_log)),
        _simulation=simulation,
        _response=None if model.retraces else evaluation.response,
        _recorder=None if records_plainly else recorder_model,
        _noise=_record_noise(observed, recorder_model, evaluation, recorder_start),
    )


def _record_noise(
    observed: ObservedWaveform,
    recorder_model: RecorderModel,
    evaluation: Evaluation,
    recorder_values: np.ndarray,
) -> _RecordNoise:
    """Return the samples with weight and their noise, that of simulation and pulse at an evaluation."""
    is_fitted, scale = observed.is_fitted, recorder_model.scale_of(recorder_values)
    without_measurement = observed._replace(sigma=np.where(is_fitted, 0.0, np.inf))
    noise = recorder_model.sample_noise(without_measurement, evaluation, recorder_values)
    shared_errors, correlation = noise.shared_errors, noise.correlation
    return _RecordNoise(
        samples=jnp.asarray(np.flatnonzero(is_fitted)),
        observed=jnp.asarray(observed.reflectance[is_fitted]),
        sigma=jnp.asarray(observed.sigma[is_fitted]),
        simulation_sigma=jnp.asarray(noise.sigma_unshared / scale),
        shared_errors=None if shared_errors is None else jnp.asarray(shared_errors / scale),
        correlation=None if correlation is None else jnp.asarray(correlation),
    )
