"""Nonlinear least squares with a stochastic simulation.

The residuals are whitened, (simulated - observed) / sigma, where sigma holds the noise of the measurement and
of the simulation; a prior adds one residual per value. With fixed random numbers the simulation is smooth
except for small jumps, and its derivatives are unbiased estimates of the derivatives of its expectation. Near
the minimum the two disagree by a fraction of a standard error and no step improves the fit: it ends there.

Simulations come in batches of photons. Where photons are traced at every step, a fit descends with few of the
batches as far as they can tell, and goes on from there with all. What it ends with, and all that is said of
it, comes from all batches.

A fit is a generator: it yields the values at which it needs a simulation, and is sent the result. The same
code serves one fit and many at once.
"""

from collections.abc import Callable, Generator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array

from inversion.fit.data import Data
from inversion.fit.descent import descend_within
from inversion.fit.misfit import misfit_of
from inversion.fit.model import Evaluation, spread_of
from inversion.fit.noise import Noise, blocks, correlation_between
from inversion.fit.priors import Priors, inside, outside
from inversion.fit.result import Step
from inversion.fit.uncertainty import Errors, correlation_of, decrement, errors_of
from inversion.fit.unknowns import Settled
from inversion.receiver.recorder import RecorderModel

# A fit has converged when a Gauss-Newton step would move it by less than this many standard errors.
_SMALL_STEP = 0.05
# It has also converged after (so many rejected steps, if the step is below so many standard errors).
_STALLED = ((1, 0.3), (3, 0.6), (8, 1.0))
# The same with few batches, which tell no more: it goes on with all of them.
_SMALL_STEP_OF_FEW, _STALLED_OF_FEW = 1.0, ((1, 2.0), (3, 5.0))
# Largest change of a free parameter in one step: far out the bijection is flat, and a fit would be stuck.
_LONGEST_STEP = 2.0
# At the solution the weights are renewed if those of the start differ by more than this, in the mean.
_WRONG_WEIGHTS = 0.05
# An unknown closer to a bound than this share of the bounds' width is reported as at the bound.
_AT_BOUND = 1e-3
# Strengths of smoothness priors stay once none changes by more than this share; so many are tried.
_SAME_STRENGTH, _MOST_STRENGTHS = 0.1, 12


def _linear(y: Array, args: tuple[Array, Array, Array]) -> tuple[Array, None]:
    """Linear model of the residuals about `at`, which is all that a Gauss-Newton step needs."""
    at, residual, jacobian = args
    return residual + jacobian @ (y - at), None


@eqx.filter_jit
def _begin(solver: Any, y: Array, args: Any) -> Any:
    struct = eqx.filter_eval_shape(lambda: _linear(y, args)[0])
    return solver.init(_linear, y, args, {}, struct, None, frozenset())


@eqx.filter_jit
def _advance(solver: Any, y: Array, args: Any, state: Any) -> Any:
    y, state, _ = solver.step(_linear, y, args, {}, state, frozenset())
    done, result = solver.terminate(_linear, y, args, {}, state, frozenset())
    return y, state, done, result == optx.RESULTS.successful


class Request(NamedTuple):
    """Values at which a fit needs a simulation.

    - `spread`: whether it needs the batches one by one.
    - `few`: whether few of the batches will do.
    """

    values: np.ndarray
    spread: bool
    few: bool


class Outcome(NamedTuple):
    """Result of a fit. Vectors are the flattened unknowns in natural units; see `Retrieval`.

    - `cost`: chi-squared with the measurement's noise only, plus that of the priors (-2 ln of their density).
    - `strength`: of the smoothness priors.
    - `simulation`: (wavelengths, bins) one standard error of the simulated waveform.
    """

    values: np.ndarray
    stderr: np.ndarray
    simulation_error: np.ndarray
    covariance: np.ndarray
    correlation: np.ndarray
    residuals: np.ndarray
    reduced_chi2: float
    cost: float
    converged: bool
    status: str
    steps: int
    history: tuple[float, ...]
    evaluation: Evaluation
    simulation: np.ndarray
    robust_stderr: np.ndarray
    prior_share: np.ndarray
    at_bound: np.ndarray
    second_minimum: float
    independent_samples: float
    averaging: np.ndarray
    strength: np.ndarray


Fitting = Generator[Request, Evaluation, Outcome]


def drive(fitting: Fitting, simulate: Callable[[Request], Evaluation]) -> Outcome:
    """Run one fit to its end."""
    try:
        request = next(fitting)
        while True:
            request = fitting.send(simulate(request))
    except StopIteration as end:
        return end.value


class Point:
    """One simulation: the values, its result, and the residuals with their Jacobian in natural units."""

    def __init__(self, fit: "Fit", z: np.ndarray, evaluation: Evaluation):
        self.z, self.evaluation = z, evaluation
        self.values, self.slope = inside(z, fit.low, fit.high)
        self.own = fit.own(self.values)
        recorded = fit.terms(evaluation.total, evaluation.jacobian, self.own)
        self.difference = (recorded.total - fit.data.observed)[fit.data.used]
        self.jacobian = recorded.jacobian[fit.data.used]
        self.finite = bool(np.all(np.isfinite(self.difference)) and np.all(np.isfinite(self.jacobian)))


class Fit:
    """A running fit. Vectors are the flattened unknowns, in natural units unless named z."""

    def __init__(
        self,
        data: Data,
        settled: list[Settled],
        terms: RecorderModel,
        solver: Any,
        max_steps: int,
        progress: Callable[[Step], None] | None,
        start: np.ndarray | None = None,
    ):
        self.data, self.settled, self.terms = data, [*settled, *terms.unknowns], terms
        self.solver, self.max_steps, self.progress = solver, max_steps, progress
        flat = lambda pick: np.concatenate([np.ravel(pick(s)) for s in self.settled])  # noqa: E731
        self.low, self.high = flat(lambda s: s.low), flat(lambda s: s.high)
        self.start = flat(lambda s: np.asarray(s.start, float)) if start is None else start
        self.prior = Priors(self.settled)
        self.correlation = correlation_between(float(terms.recorder.correlation), data.used)
        self.noise = Noise(data.sigma[data.used], None, self.correlation)
        self.count, self.history = 0, []
        self.few = max_steps > 1

    # -- simulation ------------------------------------------------------------------------------------

    def at(self, z: np.ndarray, *, spread: bool = False) -> Generator[Request, Evaluation, Point]:
        values = inside(z, self.low, self.high)[0]
        evaluation = yield Request(values[: values.size - self.terms.count], spread, self.few)
        return Point(self, z, evaluation)

    def own(self, values: np.ndarray) -> np.ndarray:
        """Those of the recorder's terms."""
        return values[values.size - self.terms.count :]

    def natural(self, p: Point) -> tuple[np.ndarray, np.ndarray]:
        """Whitened residuals, then those of the priors, and their Jacobian in natural units."""
        off, slope = self.prior(p.values)
        jacobian = np.concatenate([self.noise.white(p.jacobian), slope])
        return np.concatenate([self.noise.white(p.difference), off]), jacobian

    def reweigh(self, p: Point) -> float:
        """Include the noise of simulation and pulse at `p`. **Returns:** the mean relative change."""
        used, batches = self.data.used, p.evaluation.batches
        received = None if batches is None else self.terms.received(batches, p.own)
        noise = np.broadcast_to(spread_of(received), used.shape)[used]
        pulse = self.terms.pulse_noise(p.evaluation.total, p.own)
        before = self.noise.sigma
        alone = np.hypot(self.data.sigma[used], noise)
        self.noise = Noise(alone, blocks(pulse, used), self.correlation)
        return float(np.mean(np.abs(self.noise.sigma / before - 1.0)))

    def first(self) -> Generator[Request, Evaluation, Point]:
        z = outside(self.start, self.low, self.high)
        p = yield from self.at(z, spread=True)
        if self.terms.count and p.finite:
            best = self.terms.fit_linear(p.own, p.evaluation.total, self.data.observed, self.data.sigma)
            start = np.append(self.start[: self.start.size - self.terms.count], best)
            p = Point(self, outside(start, self.low, self.high), p.evaluation)
        return p

    # -- iteration -------------------------------------------------------------------------------------

    def run(self) -> Fitting:
        best = yield from self.first()
        self.count = 1
        if not best.finite:
            return self.result(
                best, False, "failed: at the starting values the simulated waveform is not finite"
            )
        self.reweigh(best)
        # Where photons are traced once, or in one batch, all come at once.
        self.few = best.evaluation.few
        if self.few:
            best = yield from self.approach(best)
            if not best.finite:
                return self.result(best, False, self.ended("failed: the simulated waveform is not finite"))
        best, converged, status = yield from self.settle_down(best)
        if converged and best.evaluation.batches is None:
            best = yield from self.at(best.z, spread=True)
        if converged and self.reweigh(best) > _WRONG_WEIGHTS and self.count < self.max_steps:
            best, converged, status = yield from self.settle_down(best)
            if best.evaluation.batches is None:
                best = yield from self.at(best.z, spread=True)
        return self.result(best, converged, status)

    def approach(self, best: Point) -> Generator[Request, Evaluation, Point]:
        """Descend as far as few of the batches can tell, and simulate there with all of them."""
        best, _, _ = yield from self.settle_down(best)
        self.few = False
        best = yield from self.at(best.z, spread=True)
        self.count += 1
        if best.finite:
            self.reweigh(best)
        return best

    def settle_down(self, best: Point) -> Generator[Request, Evaluation, tuple[Point, bool, str]]:
        """Descend, with strengths of smoothness priors by the data: each is that of the fit with it."""
        for _ in range(_MOST_STRENGTHS):
            way = self.descend(best)
            if self.prior.blocks:
                way = descend_within(self, best, *self.small)
            best, converged, status = yield from way
            if not converged or not self.prior.by_the_data:
                return best, converged, status
            white = self.noise.white(best.difference), self.noise.white(best.jacobian)
            strengths = self.prior.likeliest(best.values, *white)
            if np.all(np.abs(np.log(strengths / self.prior.strengths)) < _SAME_STRENGTH):
                return best, True, status
            self.prior.put(strengths)
        return best, False, self.ended("not converged: the strength of a smoothness prior did not settle")

    def descend(self, best: Point) -> Generator[Request, Evaluation, tuple[Point, bool, str]]:
        """Run the solver until it ends or no step improves the fit."""
        trial, state, y = best, None, jnp.asarray(best.z)
        remaining, rejected = np.inf, 0
        while True:
            r, jacobian = self.natural(trial)
            jacobian = jacobian * trial.slope
            if not trial.finite:
                # So large that the solver rejects the step.
                r, jacobian = np.full_like(r, 1e8), np.zeros_like(jacobian)
            args = tuple(jnp.asarray(a, y.dtype) for a in (trial.z, r, jacobian))
            if state is None:
                state = _begin(self.solver, y, args)
            y, state, done, sound = _advance(self.solver, y, args, state)
            accepted = bool(jnp.all(y == args[0])) and trial.finite
            if accepted:
                best, remaining, rejected = trial, decrement(jacobian[:, self.free(trial, r, jacobian)], r), 0
            else:
                rejected += 1
            self.report(trial, accepted)
            small, limits = self.small
            stalled = any(rejected >= n and remaining < limit for n, limit in limits)
            if bool(done) or remaining < small or stalled:
                return best, True, self.ended("converged")
            if not bool(sound):
                return best, False, self.ended("failed: the equations for the next step could not be solved")
            if self.spent:
                return best, False, self.ended("not converged: stopped at max_steps")
            ahead = jnp.clip(state.y_eval - y, -_LONGEST_STEP, _LONGEST_STEP)
            state = eqx.tree_at(lambda s: s.y_eval, state, y + ahead)
            trial = yield from self.at(np.asarray(state.y_eval, float))
            self.count += 1

    @property
    def small(self) -> tuple[float, tuple[tuple[int, float], ...]]:
        """The length of a step at which a descent ends, and those at which it does after rejected steps."""
        return (_SMALL_STEP_OF_FEW, _STALLED_OF_FEW) if self.few else (_SMALL_STEP, _STALLED)

    @property
    def spent(self) -> bool:
        """Whether no simulation is left; half of them are for all batches."""
        return self.count >= (self.max_steps // 2 if self.few else self.max_steps)

    def free(self, p: Point, r: np.ndarray, jacobian: np.ndarray) -> np.ndarray:
        """Which unknowns are free: not at a bound beyond which the fit would be better."""
        share, downhill = (p.values - self.low) / (self.high - self.low), -(jacobian.T @ r)
        held = ((share < _AT_BOUND) & (downhill < 0)) | ((share > 1 - _AT_BOUND) & (downhill > 0))
        return ~held

    def ended(self, how: str) -> str:
        return f"{how} after {self.count} simulation{'s' if self.count > 1 else ''}"

    def report(self, p: Point, accepted: bool) -> None:
        freedom = max(p.difference.size - self.low.size, 1)
        chi2 = float(np.sum(self.noise.white(p.difference) ** 2)) / freedom
        self.history.append(chi2)
        if self.progress is not None:
            self.progress(Step(len(self.history), chi2, accepted, self.named(p.values)))

    # -- result ----------------------------------------------------------------------------------------

    def named(self, flat: np.ndarray) -> dict[str, np.ndarray]:
        return named(flat, self.settled)

    def result(self, p: Point, converged: bool, status: str) -> Outcome:
        n, used, batches = self.low.size, self.data.used, p.evaluation.batches
        simulation = np.broadcast_to(spread_of(batches), used.shape)
        deviations = None
        if batches is not None and p.finite:
            received = self.terms.received(batches - np.mean(batches, axis=0), p.own)
            deviations = self.noise.white(received[:, used].T).T
        jacobian = self.noise.white(p.jacobian) if p.finite else np.zeros_like(p.jacobian)
        measured = (self.data.sigma[used] / self.noise.alone) ** 2
        off, slope = self.prior(p.values)
        precision = slope.T @ slope
        width = self.high - self.low
        errors = errors_of(jacobian, precision, width, measured, deviations, self.prior.basis)
        stderr = np.sqrt(np.diag(errors.covariance))
        robust, samples = self.widened(p, stderr, errors, jacobian, precision)
        labels = labels_of(self.settled)
        share = (p.values - self.low) / (self.high - self.low)
        notes = [
            ("the data do not determine {} (infinite standard error)", errors.open),
            ("at the lower bound: {}", low := share < _AT_BOUND),
            ("at the upper bound: {}", high := share > 1 - _AT_BOUND),
        ]
        for text, which in notes:
            if np.any(which):
                status += "; " + text.format(", ".join(m for m, w in zip(labels, which) if w))
        residuals = np.zeros(used.shape)
        residuals[used] = -self.noise.white(p.difference)
        freedom = max(p.difference.size - n + int(np.sum(errors.open)), 1)
        chi2 = np.sum(residuals**2) / freedom

        plain = self.noise._replace(alone=self.data.sigma[used])
        cost = float(np.sum(plain.white(p.difference) ** 2) + np.sum(off**2)) + self.prior.volume
        return Outcome(
            values=p.values,
            stderr=stderr,
            simulation_error=errors.simulation,
            covariance=errors.covariance,
            correlation=correlation_of(errors.covariance),
            residuals=residuals,
            reduced_chi2=float(chi2),
            cost=cost if p.finite else np.inf,
            converged=converged,
            status=status,
            steps=self.count,
            history=tuple(self.history),
            evaluation=p.evaluation,
            simulation=np.asarray(simulation),
            robust_stderr=robust,
            prior_share=errors.prior_share,
            at_bound=low | high,
            second_minimum=np.inf,
            independent_samples=samples,
            averaging=errors.averaging,
            strength=self.prior.strengths,
        )

    def widened(
        self, p: Point, stderr: np.ndarray, errors: Errors, jacobian: np.ndarray, precision: np.ndarray
    ) -> tuple[np.ndarray, float]:
        """Standard errors widened by misfit, and how many independent samples tell as much as all."""
        if not p.finite:
            return stderr, float(p.difference.size)
        used = self.data.used
        signal = (p.difference + self.data.observed[used]) / self.noise.sigma
        open = errors.open
        told = float(np.sum(1.0 - errors.prior_share[~open]))
        difference = self.noise.white(p.difference)
        wavelength, sample = np.nonzero(used)
        misfit = misfit_of(difference, jacobian, precision, told, signal, (wavelength, sample))
        variance = np.diag(errors.inverse @ (misfit.middle + precision) @ errors.inverse)
        return np.where(open, np.inf, np.maximum(stderr, np.sqrt(variance))), misfit.samples


def named(flat: np.ndarray, settled: Sequence[Settled]) -> dict[str, np.ndarray]:
    """Values by name from vectors (..., unknowns)."""
    parts = np.split(flat, np.cumsum([s.start.size for s in settled])[:-1], axis=-1)
    return {s.name: p.reshape((*flat.shape[:-1], *s.start.shape)) for s, p in zip(settled, parts)}


def bounds_of(settled: Sequence[Settled]) -> dict[str, np.ndarray]:
    """Lower and upper bounds by name, (2, ...)."""
    return {s.name: np.stack([s.low, s.high]) for s in settled}


def smooth_names(settled: Sequence[Settled]) -> list[str]:
    """Names of the unknowns with smoothness priors."""
    return [s.name for s in settled if s.smooth is not None]


def labels_of(settled: Sequence[Settled]) -> tuple[str, ...]:
    """Names of the flattened unknowns."""
    return tuple(
        s.name + ("" if s.start.ndim == 0 else str(list(map(int, np.unravel_index(i, s.start.shape)))))
        for s in settled
        for i in range(s.start.size)
    )
