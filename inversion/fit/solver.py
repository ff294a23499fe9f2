r"""Nonlinear least squares with a stochastic simulation.

**Objective.** With w(x) the simulated waveform as recorded, y the observed one, C the covariance of their
difference, and the priors as residuals q(x) (`inversion.fit.prior_residuals`),

    minimise over x within bounds   |C^-1/2 (w(x) - y)|^2 + |q(x)|^2.

The unknowns x are in natural units: their own, such as m. C holds the noise of the measurement, of the
simulation and of a recorded pulse. The simulation's and the pulse's depend on x; they are taken at the start,
renewed when all batches are first used, and again at the solution.

**Stochastic part.** With common random numbers (the same photons at all x), w is smooth in x except for small
jumps, and its Jacobian is an unbiased estimate of the derivative of its expectation (a sample average
approximation). Near the minimum the sampled waveform and the sampled Jacobian disagree by a fraction of a
standard error, and no step improves the fit: it ends there. The simulation's noise lowers the weight of the
samples that it affects and is part of the covariance (`inversion.fit.uncertainty`).

A simulation is the mean of batches of photons. Far from the solution the first few batches, a *pilot*
evaluation, are accurate enough. The fit descends with them until a step is below one standard error and goes
on with all batches. Estimates, covariances and chi-squared come from all batches (variable sample size:
Pasupathy 2010, Oper. Res. 58, 889).

**Steps.** Those of `inversion.fit.bounded_gauss_newton`, a solver of optimistix: damped Gauss-Newton steps
within the bounds and a trust region, until a step would be below 0.05 standard errors, or no step improves
the fit. `optimistix.least_squares` runs that solver as well, but as one compiled loop, in which fits that run
together all wait for the slowest, and none reports its steps or goes over to all batches. Here each step is
one call of the solver, and a fit simulates between them.

**Fits as generators.** A fit yields the values at which it needs a simulation and is sent the evaluation. The
same code serves a single fit and many fits whose simulations run in one compiled call.
"""

import dataclasses
import itertools
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from inversion.fit.bounded_gauss_newton import BoundedGaussNewton, advance, at_bounds
from inversion.fit.data import ObservedWaveform, SampleNoise
from inversion.fit.fit_summary import CompletedFit, FitSummary, Step
from inversion.fit.model import Evaluation, batch_stderr
from inversion.fit.prior_residuals import PriorResiduals
from inversion.fit.recorder_model import RecorderModel
from inversion.fit.uncertainty import (
    EstimateCovariance,
    SampleIndex,
    estimate_covariance,
    residual_covariance,
)
from inversion.fit.unknowns import (
    MARGIN,
    BoundUnknown,
    flat_bounds,
    flat_labels,
    flat_start,
    split_by_name,
)
from jaxlidar.progress import ProgressOption

# Pilot evaluations have noise that hides smaller steps; the fit then goes on with all batches.
_SOLVER = BoundedGaussNewton()
_PILOT_SOLVER = BoundedGaussNewton(atol=1.0, rtol=1.0, limits=(2.0, 2.0, 5.0))
# At the solution the weights are renewed if they differ from those of the start by more than this, in the
# mean.
_MAX_WEIGHT_CHANGE = 0.05
# An unknown closer to a bound than this fraction of the bounds' width is reported as at the bound.
_AT_BOUND = 1e-3
# Strengths of smoothness priors are final once none changes by more than this fraction; most updates of them.
_STRENGTH_TOLERANCE, _MAX_STRENGTH_UPDATES = 0.1, 12
# Values of a fit keep off their bounds by this fraction of the bounds' width: a log-normal prior has no
# logarithm of zero, and an extinction of zero has no score.
_BOUND_MARGIN = 1e-6


@dataclasses.dataclass(frozen=True)
class SolverSettings:
    """Most simulations from each start, and number of starts."""

    max_steps: int
    starts: int


class EvaluationRequest(NamedTuple):
    """Values of the scene's unknowns at which a fit needs a simulation.

    - `with_batches`: True if it needs the batches one by one.
    - `pilot`: True if the first few batches suffice.
    """

    values: np.ndarray
    with_batches: bool
    pilot: bool


# A fit yields requests, is sent evaluations, and returns its result.
FitGenerator = Generator[EvaluationRequest, Evaluation, CompletedFit]


def run_fits(
    fits: Iterator[tuple[int, FitGenerator]],
    simulate: Callable[[Mapping[int, EvaluationRequest]], Mapping[int, Evaluation]],
    n_together: int,
) -> Iterator[tuple[int, CompletedFit]]:
    """Run numbered fits in lockstep. Yield each with its number as it ends.

    **Arguments:**

    - `simulate`: evaluates the requests of all running fits, by their numbers.
    - `n_together`: most fits that run at a time.
    """
    # The fits that run at present, with the request that each waits for.
    running: dict[int, tuple[FitGenerator, EvaluationRequest]] = {}
    while True:
        # A fit that has ended makes room at once: in groups of fits that begin and end together, most members
        # would be idle until the slowest fit has ended.
        for number, fit in itertools.islice(fits, n_together - len(running)):
            running[number] = fit, next(fit)
        if not running:
            return
        for number, evaluation in simulate({n: request for n, (_, request) in running.items()}).items():
            fit, _ = running[number]
            try:
                # The fit goes on to its next request, or ends.
                running[number] = fit, fit.send(evaluation)
            except StopIteration as end:
                del running[number]
                yield number, end.value


def fit_range(
    low: Float[np.ndarray, " n"], high: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the range of the values of a fit within bounds."""
    margin = _BOUND_MARGIN * (high - low)
    return low + margin, high - margin


# -- a fit from one start


class Iterate:
    """A simulated point of a fit.

    - `values`: of the unknowns.
    - `recorder_values`: the last of the values, those of the recorder's unknowns.
    - `evaluation`: the simulation.
    - `difference`, `jacobian`: simulated minus observed, of the fitted samples, and its Jacobian in natural
      units.
    - `is_finite`: True if both are finite.
    """

    def __init__(self, fit: "LeastSquaresFit", values: np.ndarray, evaluation: Evaluation):
        self.values, self.evaluation = values, evaluation
        self.recorder_values = self.values[fit.n_scene :]
        record, jacobian = fit.recorder_model(
            evaluation.reflectance, evaluation.jacobian, self.recorder_values
        )
        self.difference = (record - fit.observed.reflectance)[fit.is_fitted]
        self.jacobian = jacobian[fit.is_fitted]
        self.is_finite = bool(np.all(np.isfinite(self.difference)) and np.all(np.isfinite(self.jacobian)))


class Descent(NamedTuple):
    """Best iterate of a descent, True if it converged, and a sentence on its end."""

    best: Iterate
    converged: bool
    status: str


class LeastSquaresFit:
    """A running fit. Vectors are the flattened unknowns, in natural units unless said otherwise.

    - `start`: starting values. Default None: those of the unknowns.

    Its state: `noise`, the present weights; `prior`, with the present strengths; `use_pilot`, True while few
    batches suffice; `n_simulations` and `history`, reduced chi-squared of every call of `progress`.
    """

    def __init__(
        self,
        observed: ObservedWaveform,
        scene_unknowns: list[BoundUnknown],
        recorder_model: RecorderModel,
        settings: SolverSettings,
        progress: ProgressOption = None,
        start: np.ndarray | None = None,
    ):
        self.observed, self.is_fitted, self.recorder_model = observed, observed.is_fitted, recorder_model
        self.unknowns = [*scene_unknowns, *recorder_model.unknowns]
        self.settings, self.progress = settings, progress
        self.low, self.high = flat_bounds(self.unknowns)
        self.width = self.high - self.low
        self.lowest, self.highest = fit_range(self.low, self.high)
        self.n_scene = self.low.size - recorder_model.count
        self.start = flat_start(self.unknowns) if start is None else start
        self.prior = PriorResiduals(self.unknowns)
        # That of simulation and pulse is added at the first iterate.
        self.noise = SampleNoise(observed.sigma[self.is_fitted])
        # A single simulation has to be one with all batches.
        self.use_pilot = settings.max_steps > 1
        self.n_simulations, self.history = 0, []

    # -- objective

    def simulate(
        self, values: np.ndarray, *, with_batches: bool = False
    ) -> Generator[EvaluationRequest, Evaluation, Iterate]:
        """Request a simulation at these values, or at the end of their range if they are beyond."""
        values = np.clip(values, self.lowest, self.highest)
        evaluation = yield EvaluationRequest(values[: self.n_scene], with_batches, self.use_pilot)
        return Iterate(self, values, evaluation)

    def residuals(self, iterate: Iterate) -> tuple[np.ndarray, np.ndarray]:
        """Return whitened residuals, of data and then priors, and their Jacobian in natural units."""
        prior_residual, prior_jacobian = self.prior(iterate.values)
        jacobian = np.concatenate([self.noise.whiten(iterate.jacobian), prior_jacobian])
        return np.concatenate([self.noise.whiten(iterate.difference), prior_residual]), jacobian

    def update_weights(self, iterate: Iterate) -> float:
        """Renew the noise of simulation and pulse at an iterate. **Returns:** the mean relative change."""
        previous_sigma = self.noise.sigma
        self.noise = self.recorder_model.sample_noise(
            self.observed, iterate.evaluation, iterate.recorder_values
        )
        return float(np.mean(np.abs(self.noise.sigma / previous_sigma - 1.0)))

    # -- algorithm

    def run(self) -> FitGenerator:
        """Run the fit.

        1. Simulate at the start, and choose the recorder's offset and scale there by linear least squares.
        2. Weight the samples by the noise of measurement, simulation and pulse at the start.
        3. If photons are traced at every step: minimise with pilot evaluations, then simulate at their
           minimum with all batches and renew the weights.
        4. Minimise with all batches.
        5. Renew the weights at the solution. If they changed by more than 5 % in the mean, minimise again.
        6. Compute covariances at the solution.
        """
        best = yield from self._first_iterate()
        self.n_simulations = 1
        if not best.is_finite:
            status = "failed: at the starting values the simulated waveform is not finite"
            return self._completed(best, False, status)
        self.update_weights(best)
        # The first evaluation shows whether the model has pilot evaluations at all.
        self.use_pilot = best.evaluation.is_pilot
        if self.use_pilot:
            best = yield from self._minimise_with_pilot(best)
            if not best.is_finite:
                status = self._status("failed: the simulated waveform is not finite")
                return self._completed(best, False, status)
        best, converged, status = yield from self._minimise(best)
        # If all unknowns are optical, steps apply optics to the mean response alone. Weights and covariances
        # need the batches: they are evaluated from the same photons, which does not count as a simulation.
        if converged and best.evaluation.batches is None:
            best = yield from self.simulate(best.values, with_batches=True)
        weights_changed = converged and self.update_weights(best) > _MAX_WEIGHT_CHANGE
        if weights_changed and self.n_simulations < self.settings.max_steps:
            best, converged, status = yield from self._minimise(best)
            if best.evaluation.batches is None:
                best = yield from self.simulate(best.values, with_batches=True)
        return self._completed(best, converged, status)

    def _first_iterate(self) -> Generator[EvaluationRequest, Evaluation, Iterate]:
        iterate = yield from self.simulate(self.start, with_batches=True)
        if self.recorder_model.count and iterate.is_finite:
            # The record is linear in offset and scale: a start far off would lead the other unknowns astray.
            recorder_values = self.recorder_model.fit_linear(
                iterate.recorder_values,
                iterate.evaluation.reflectance,
                self.observed.reflectance,
                self.observed.sigma,
            )
            start = np.append(iterate.values[: self.n_scene], recorder_values)
            iterate = Iterate(self, start, iterate.evaluation)
        return iterate

    def _minimise_with_pilot(self, best: Iterate) -> Generator[EvaluationRequest, Evaluation, Iterate]:
        """Minimise as far as pilot evaluations are accurate, and simulate there with all batches."""
        best, _, _ = yield from self._minimise(best)
        self.use_pilot = False
        best = yield from self.simulate(best.values, with_batches=True)
        self.n_simulations += 1
        if best.is_finite:
            self.update_weights(best)
        return best

    def _minimise(self, best: Iterate) -> Generator[EvaluationRequest, Evaluation, Descent]:
        """Minimise the objective, and choose the strengths of smoothness priors by the evidence.

        1. Minimise at the present strengths.
        2. Maximise the evidence over the strengths that are left to the data, linearised about the minimum.
        3. Repeat until no strength changes by more than 10 %.
        """
        for _ in range(_MAX_STRENGTH_UPDATES):
            best, converged, status = yield from self._descend(best)
            if not converged or not self.prior.has_free_strengths:
                return Descent(best, converged, status)
            residual, jacobian = self.noise.whiten(best.difference), self.noise.whiten(best.jacobian)
            strengths = self.prior.maximise_evidence(best.values, residual, jacobian)
            if np.all(np.abs(np.log(strengths / self.prior.strengths)) < _STRENGTH_TOLERANCE):
                return Descent(best, True, status)
            self.prior.set_strengths(strengths)
        status = "not converged: the strength of a smoothness prior did not settle"
        return Descent(best, False, self._status(status))

    def _descend(self, best: Iterate) -> Generator[EvaluationRequest, Evaluation, Descent]:
        """Descend from `best` with the steps of `BoundedGaussNewton`, one simulation each.

        1. Give the solver residual and Jacobian at its trial; it accepts the trial or goes back to `best`.
        2. Stop where the solver does, or at max_steps.
        3. Simulate at the solver's next trial.
        """
        solver = _PILOT_SOLVER if self.use_pilot else _SOLVER
        trial, state = best, None
        while True:
            residual, jacobian = self.residuals(trial)
            if not trial.is_finite:
                residual, jacobian = np.full_like(residual, np.inf), np.zeros_like(jacobian)
            bounds = self.lowest, self.highest
            descent = advance(solver, state, trial.values, residual, jacobian, bounds)
            state = descent.state
            if descent.accepted:
                best = trial
            self._report(trial, descent.accepted)
            if descent.terminated:
                end = "converged" if descent.successful else "failed: no step improves the fit"
                return Descent(best, descent.successful, self._status(end))
            if self._is_exhausted:
                return Descent(best, False, self._status("not converged: stopped at max_steps"))
            trial = yield from self.simulate(descent.trial)
            self.n_simulations += 1

    # -- end of a fit

    @property
    def _is_exhausted(self) -> bool:
        """True if no simulation is left; pilot evaluations get half of them."""
        max_steps = self.settings.max_steps
        return self.n_simulations >= (max_steps // 2 if self.use_pilot else max_steps)

    def _status(self, end: str) -> str:
        plural = "s" if self.n_simulations > 1 else ""
        return f"{end} after {self.n_simulations} simulation{plural}"

    def _report(self, iterate: Iterate, accepted: bool) -> None:
        degrees_of_freedom = max(iterate.difference.size - self.low.size, 1)
        chi2 = float(np.sum(self.noise.whiten(iterate.difference) ** 2)) / degrees_of_freedom
        self.history.append(chi2)
        if callable(self.progress):
            values = split_by_name(iterate.values, self.unknowns)
            self.progress(Step(len(self.history), chi2, accepted, values))

    # -- result

    def _completed(self, iterate: Iterate, converged: bool, status: str) -> CompletedFit:
        """Return the result at an iterate.

        1. Whiten Jacobian and deviations of the batches by the present weights.
        2. Find unknowns at a bound, and those from whose bound the cost falls inwards: steps that noise of
           the simulation rejects leave them there.
        3. Compute the covariance of the estimates, and the errors widened by misfit.
        4. Compute reduced chi-squared, and the cost by which fits from several starts are compared.
        """
        is_fitted, evaluation = self.is_fitted, iterate.evaluation
        deviations = self._deviations(iterate)
        jacobian = np.zeros_like(iterate.jacobian)
        if iterate.is_finite:
            jacobian = self.noise.whiten(iterate.jacobian)
        measured_sigma = self.observed.sigma[is_fitted]
        prior_residual, prior_jacobian = self.prior(iterate.values)
        precision = prior_jacobian.T @ prior_jacobian
        fraction = (iterate.values - self.low) / self.width
        at_low, at_high = fraction < _AT_BOUND, fraction > 1 - _AT_BOUND
        estimate = estimate_covariance(
            jacobian,
            precision,
            self.width,
            (measured_sigma / self.noise.sigma_unshared) ** 2,
            None if deviations is None else self.noise.whiten(deviations.T).T,
            self.prior.basis,
            at_low | at_high,
        )
        is_leaving = np.zeros(self.low.size, bool)
        if iterate.is_finite:
            is_leaving = at_bounds(
                iterate.values, *self.residuals(iterate), self.lowest, self.highest
            ).leaving
        stderr = np.sqrt(np.diag(estimate.covariance))
        robust_stderr, independent_samples = self._robust_stderr(
            iterate, stderr, estimate, jacobian, precision
        )
        residuals = np.zeros(is_fitted.shape)
        residuals[is_fitted] = -self.noise.whiten(iterate.difference)
        n_undetermined = int(np.sum(estimate.is_undetermined))
        degrees_of_freedom = max(iterate.difference.size - self.low.size + n_undetermined, 1)
        # Costs of fits from several starts are compared. Without the simulation's noise, they have nearly
        # equal weights: the noise of the pulse is that at each fit's own minimum, and ln det C is left out.
        measurement = self.noise._replace(sigma_unshared=measured_sigma)
        prior_cost = float(np.sum(prior_residual**2)) + self.prior.log_determinant
        cost = float(np.sum(measurement.whiten(iterate.difference) ** 2)) + prior_cost
        summary = FitSummary(
            values=iterate.values,
            stderr=stderr,
            robust_stderr=robust_stderr,
            prior_share=estimate.prior_share,
            at_bound=at_low | at_high,
            covariance=estimate.covariance,
            averaging=estimate.averaging,
            reduced_chi2=float(np.sum(residuals**2) / degrees_of_freedom),
            independent_samples=independent_samples,
            second_minimum=np.inf,
            strength=self.prior.strengths,
            converged=converged,
            status=status + self._notes(estimate.is_undetermined, at_low, at_high, is_leaving),
            steps=self.n_simulations,
            simulation_error=estimate.simulation_error,
            residuals=residuals,
            fitted=np.asarray(evaluation.reflectance),
        )
        return CompletedFit(
            summary,
            waveform_stderr=np.asarray(np.broadcast_to(batch_stderr(evaluation.batches), is_fitted.shape)),
            cost=cost if iterate.is_finite else np.inf,
            prior_cost=prior_cost,
            difference=iterate.difference,
            deviations=deviations,
            noise=self.noise,
            history=tuple(self.history),
            evaluation=evaluation,
        )

    def _deviations(self, iterate: Iterate) -> np.ndarray | None:
        """Return the deviations of the batches from their mean, (batches, samples), or None for one batch."""
        batches = iterate.evaluation.batches
        if batches is None or len(batches) < 2 or not iterate.is_finite:
            return None
        received = self.recorder_model.received(batches - np.mean(batches, axis=0), iterate.recorder_values)
        return received[:, self.is_fitted]

    def _notes(
        self, is_undetermined: np.ndarray, at_low: np.ndarray, at_high: np.ndarray, is_leaving: np.ndarray
    ) -> str:
        """Return the end of a status: unknowns that are undetermined or at a bound."""
        labels, notes = flat_labels(self.unknowns), ""
        for text, condition in (
            ("the data do not determine {} (infinite standard error)", is_undetermined),
            ("at the lower bound: {}", at_low),
            ("at the upper bound: {}", at_high),
            ("the misfit falls inwards from the bound of {}", is_leaving),
        ):
            if np.any(condition):
                notes += "; " + text.format(", ".join(m for m, c in zip(labels, condition) if c))
        return notes

    def _robust_stderr(
        self,
        iterate: Iterate,
        stderr: np.ndarray,
        estimate: EstimateCovariance,
        jacobian: np.ndarray,
        precision: np.ndarray,
    ) -> tuple[np.ndarray, float]:
        """Return standard errors widened by misfit, and the effective number of samples.

        They are the roots of the diagonal of H^-1 (J^T C J + P) H^-1, with C estimated from the residuals
        (`inversion.fit.uncertainty`), and never below `stderr`.
        """
        if not iterate.is_finite:
            return stderr, float(iterate.difference.size)
        difference, is_undetermined = iterate.difference, estimate.is_undetermined
        # Offsets of digitisers are no signal.
        received = self.recorder_model.received(iterate.evaluation.reflectance, iterate.recorder_values)
        signal = received[self.is_fitted] / self.noise.sigma
        # Effective number of parameters (degrees of freedom for signal): residuals lose less than one degree
        # of freedom to an unknown that its prior holds. Reduced chi-squared counts unknowns instead, as is
        # usual.
        n_determined = float(np.sum(1.0 - estimate.prior_share[~is_undetermined]))
        misfit = residual_covariance(
            self.noise.whiten(difference),
            jacobian,
            precision,
            n_determined,
            signal,
            SampleIndex(*np.nonzero(self.is_fitted)),
        )
        inverse = estimate.inverse_information
        variance = np.diag(inverse @ (misfit.meat + precision) @ inverse)
        # Never below the stated errors: that residuals happen to be small is no evidence of less noise.
        robust = np.where(is_undetermined, np.inf, np.maximum(stderr, np.sqrt(variance)))
        return robust, misfit.independent_samples


# -- several starts


def key_of_starts(key: PRNGKeyArray) -> PRNGKeyArray:
    """Return the key of the starting points of fits with this key."""
    # Batches of photons have the numbers from 0 on: starts and photons must be independent.
    return jax.random.fold_in(key, 2**31 - 1)


def fits_from_starts(
    observed: ObservedWaveform,
    scene_unknowns: list[BoundUnknown],
    recorder_model: RecorderModel,
    settings: SolverSettings,
    key: PRNGKeyArray,
    progress: ProgressOption = None,
) -> list[LeastSquaresFit]:
    """Return a fit from the unknowns' own start, and further ones from a Latin hypercube over the bounds.

    `key`: of the hypercube, made with `key_of_starts`.
    """
    starts: list[np.ndarray | None] = [None]
    if settings.starts > 1:
        unknowns = [*scene_unknowns, *recorder_model.unknowns]
        starts += list(latin_hypercube(unknowns, settings.starts - 1, key))
    return [LeastSquaresFit(observed, scene_unknowns, recorder_model, settings, progress, s) for s in starts]


def latin_hypercube(
    unknowns: Sequence[BoundUnknown], count: int, key: PRNGKeyArray
) -> Float[np.ndarray, "count unknowns"]:
    """Draw starting points spread over the bounds: each unknown has one in each of `count` equal intervals.

    **Source:** McKay, Beckman and Conover (1979), Technometrics 21, 239.
    """
    low, high = flat_bounds(unknowns)
    order_key, position_key = jax.random.split(key)
    order = jax.vmap(lambda k: jax.random.permutation(k, count))(jax.random.split(order_key, low.size))
    position = np.asarray(jax.random.uniform(position_key, (count, low.size)), float)
    fraction = (np.asarray(order).T + position) / count
    return low + (high - low) * np.clip(fraction, MARGIN, 1.0 - MARGIN)


def multistart(fits: Sequence[LeastSquaresFit]) -> FitGenerator:
    """Run fits from several starts, one after the other, and return the converged one of the lowest cost.

    Starts that ended at the same minimum are counted, and the others compared with it (`compare_minima`),
    even if they have not converged: a start that came as far with other values is reason to doubt. Its steps
    and history are those of all fits.
    """
    completed = []
    for fit in fits:
        completed.append((yield from fit.run()))

    def rank(fit: CompletedFit) -> tuple[bool, bool, float]:
        # Infinite and NaN costs come last.
        return not fit.summary.converged, not np.isfinite(fit.cost), fit.cost

    best = min(completed, key=rank)
    if len(fits) == 1:
        return best
    further_fits = [fit for fit in completed if np.isfinite(fit.cost) and fit is not best]
    second_minimum_rise, robust_stderr = compare_minima(best, further_fits)
    n_same = sum(f.summary.converged and not ended_elsewhere(f, best) for f in completed)
    summary = dataclasses.replace(
        best.summary,
        steps=sum(fit.summary.steps for fit in completed),
        status=f"{best.summary.status}; {n_same} of {len(fits)} starts ended there",
        second_minimum=second_minimum_rise,
        robust_stderr=robust_stderr,
    )
    history = tuple(chi2 for fit in completed for chi2 in fit.history)
    return dataclasses.replace(best, summary=summary, history=history)


def ended_elsewhere(fit: CompletedFit, best: CompletedFit) -> bool:
    """Return True if any unknown differs from that of the best fit by more than two standard errors."""
    distance = np.abs(fit.summary.values - best.summary.values)
    return bool(np.any(distance > 2.0 * best.summary.robust_stderr))


def compare_minima(best: CompletedFit, further_fits: Sequence[CompletedFit]) -> tuple[float, np.ndarray]:
    """Return the rise in chi-squared to the second minimum, and standard errors with the spread over minima.

    1. Chi-squared of all fits is that with the noise of the best one, that of its simulation included. Its
       rise to fit m is lessened by two of the standard errors that it has from the noise of both simulations
       (`_chi2_with_noise`).
    2. The rise counts correlated samples by their effective number, and is in units of the best fit's reduced
       chi-squared.
    3. Fit m is in another minimum if an unknown differs by more than two standard errors.
    4. With the relative likelihood p_m = exp(-rise_m / 2), one for the best fit itself,

           spread^2 = sum_m p_m (x_m - x_best)^2 / sum_m p_m

       over all fits is added to the square of the standard errors.
    """
    summary = best.summary
    # Residuals of samples that are left out are zero.
    n_samples = max(np.count_nonzero(best.summary.residuals), 1)
    scale = summary.independent_samples / n_samples / max(summary.reduced_chi2, 1.0)
    least_chi2, least_variance = _chi2_with_noise(best, best.noise)
    second_minimum_rise, weighted_squares, weight = np.inf, np.zeros_like(summary.values), 1.0
    for fit in further_fits:
        chi2, variance = _chi2_with_noise(fit, best.noise)
        rise = max(chi2 - least_chi2 - 2.0 * np.sqrt(variance + least_variance), 0.0) * scale
        if ended_elsewhere(fit, best):
            second_minimum_rise = min(second_minimum_rise, rise)
        weighted_squares += np.exp(-0.5 * rise) * (fit.summary.values - summary.values) ** 2
        weight += np.exp(-0.5 * rise)
    spread = np.sqrt(weighted_squares / weight)
    return float(second_minimum_rise), np.hypot(summary.robust_stderr, spread)


def _chi2_with_noise(fit: CompletedFit, noise: SampleNoise) -> tuple[float, float]:
    """Return chi-squared of a fit, priors included, and its variance from the simulation's noise.

    With whitened residuals r and deviations d_b of n batches from their mean, the noise of the simulation
    adds sum_b |d_b|^2 / n (n - 1) to |r|^2 in the mean, which is subtracted. The variance is, to first order,
    4 sum_b (r . d_b)^2 / n (n - 1).
    """
    residual = noise.whiten(fit.difference)
    chi2 = float(residual @ residual) + fit.prior_cost
    if fit.deviations is None:
        return chi2, 0.0
    # Columns are batches.
    deviations = noise.whiten(fit.deviations.T)
    pairs = deviations.shape[1] * (deviations.shape[1] - 1)
    mean_excess = float(np.sum(deviations**2)) / pairs
    return chi2 - mean_excess, 4.0 * float(np.sum((residual @ deviations) ** 2)) / pairs
