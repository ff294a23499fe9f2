"""Verdicts on fits of recorded waveforms: "good", "doubtful" or "bad", with reasons.

A verdict is the worst of a small set of named checks; each check that fails gives a reason. The checks of a
fit (`judge_fit`), with n the effective number of independent samples:

| check | doubtful | bad |
| --- | --- | --- |
| convergence | | not converged |
| misfit | reduced chi-squared above 3, or 1 + 4 sqrt(2 / n) if more | above 10, or 1 + 12 sqrt(2 / n) |
| undetermined | the standard error of an unknown is above 0.29 widths of its bounds (uniform in them) | |
| bound | an unknown without a smoothness prior lies at a bound | |
| prior | the share of the prior in an unknown without a smoothness prior is above a half | |
| second minimum | a start ended elsewhere within 4 in chi-squared, counted as independent samples | |

Misfit below these limits is named if another check has failed and reduced chi-squared is above 1 + 4 sqrt(2 /
n): it may be the cause.

The checks of a record before any fit (`judge_record`), with s the standard deviation of the noise:

| check | doubtful | bad |
| --- | --- | --- |
| signal | largest sample below 10 s | below 6 s |
| clipped | three or more samples in a row at the largest value | |
| cut off | the mean of the first or last three samples is above 4 s and a hundredth of the peak | and above a
tenth of it |
| dead samples (outliers) | a sample departs from the cubic by its neighbours by more than 6 s + 1.5 d | |
| uneven noise | that of the last quiet samples over that of the first is above 1.7 or below 1 / 1.7 | |
| flags | the product's flag `degrade` is set | its flag `stale_return` is set |

Here d is the largest departure of the pulse from such cubics, scaled to the peak of the record.

The thresholds hold for any instrument; the checks of a record need several samples within the pulse. A record
without noise, s = 0, is neither weak nor of uneven noise.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float

from jaxlidar.extend import as_numpy, check_integer, check_number, check_range

_QUALITIES = ("good", "doubtful", "bad")
_GOOD, _DOUBTFUL, _BAD = _QUALITIES
# Thresholds of a fit: see the table. Reduced chi-squared, doubtful and bad, and its standard deviations for
# few samples.
_CHI2_LIMITS, _CHI2_SIGMAS = (3.0, 10.0), (4.0, 12.0)
_MAX_PRIOR_FRACTION, _MIN_SECOND_MINIMUM = 0.5, 4.0
# Standard deviation of a uniform distribution, in widths: data that leave more say less than the bounds.
_UNIFORM_SIGMA = 12.0**-0.5
# Thresholds of a record: see the table.
_SIGNAL_TO_NOISE, _CLIPPED_SAMPLES, _DEAD_SIGMAS, _UNEVEN_RATIO = (10.0, 6.0), 3, 6.0, 1.7
_CUT_OFF_SIGMAS, _CUT_OFF_FRACTIONS = 4.0, (0.01, 0.1)
# Samples at each end of a record; fewest and most quiet samples of either end that show its noise.
_END_SAMPLES, _QUIET_SAMPLES = 3, (100, 200)
# Echoes may be narrower than the transmitted pulse, and depart from cubics by so much more.
_NARROWER_ECHO_FACTOR = 1.5


class Verdict(NamedTuple):
    """Trustworthiness of a fit.

    - `quality`: "good", "doubtful" or "bad".
    - `reasons`: a sentence for each check that failed, the gravest first; empty for a good fit.

    **Example:**

    >>> import inversion
    >>> verdict = inversion.Verdict("bad", ("no signal",))
    >>> verdict & inversion.Verdict("good", ())
    Verdict(quality='bad', reasons=('no signal',))
    """

    quality: str
    reasons: tuple[str, ...]

    def __and__(self, verdict: "Verdict") -> "Verdict":
        """Return the worse of two, with the reasons of both."""
        worse, better = sorted((self, verdict), key=lambda v: -_QUALITIES.index(v.quality))
        return Verdict(worse.quality, (*worse.reasons, *better.reasons))


def _worst_of(failures: Iterable[tuple[str, str]]) -> Verdict:
    """Return the verdict of failed checks: pairs of a quality and a reason."""
    ordered = sorted(failures, key=lambda failure: -_QUALITIES.index(failure[0]))
    return Verdict(ordered[0][0] if ordered else _GOOD, tuple(reason for _, reason in ordered))


def judge_fit(fit: Any, *, about: Sequence[str] | None = None) -> Verdict:
    """Judge whether a fit can be trusted, by the first table of `inversion.fit.quality`.

    **Arguments:**

    - `fit`: a `Retrieval` of one record. One of many has the verdicts in its `quality`.
    - `about`: names of the unknowns that the verdict is about; bounds and priors of others are ignored.
      Default None: all.

    **Returns:** a `Verdict`.

    **Raises:** ValueError for a name that the fit does not have, and for a fit of many records.

    **Example:** the ground lies above the bounds of its height.

    >>> import jaxlidar as jl
    >>> import inversion, jax
    >>> wave = jl.simulate(jl.Lidar(), jl.Scene(ground=jl.Ground(height=0.5)), key=jax.random.key(0))
    >>> height = inversion.Unknown("ground.height", bounds=(-2.0, 0.2))
    >>> start = jl.Scene(ground=jl.Ground())
    >>> problem = inversion.Problem(wave, jl.Lidar(), start, [height], noise=0.001)
    >>> fit = inversion.retrieve(problem, key=jax.random.key(1))
    >>> inversion.judge_fit(fit).quality
    'bad'
    """
    if np.ndim(fit.converged) > 0:
        raise ValueError(f"fit has {np.size(fit.converged)} records; admissible is one: judge each, fit[i]")
    names = list(fit.values) if about is None else list(about)
    for name in names:
        if name not in fit.values:
            raise ValueError(f"about has {name!r}; admissible are {', '.join(map(repr, fit.values))}")

    def failing(quantity: Mapping[str, Any], fails: Callable[[Any], Any], exempt: Iterable[str] = ()) -> str:
        """Return the names of the unknowns with any failing value."""
        return ", ".join(n for n in names if n not in exempt and np.any(fails(np.asarray(quantity[n]))))

    failures = []
    if not float(fit.converged):
        failures.append((_BAD, "not converged"))
    chi2, n_samples = float(fit.reduced_chi2), max(float(fit.independent_samples), 1.0)
    # The standard deviation of reduced chi-squared is sqrt(2 / n).
    scatter = [1.0 + k * np.sqrt(2.0 / n_samples) for k in _CHI2_SIGMAS]
    limits = np.maximum(_CHI2_LIMITS, scatter)
    misfit = f"misfit: reduced chi-squared {chi2:.3g}"
    # Written so that NaN fails.
    if not chi2 <= limits[0]:
        failures.append((_DOUBTFUL if chi2 <= limits[1] else _BAD, misfit))
    relative_stderr = {n: fit.stderr[n] / np.diff(np.asarray(fit.bounds[n], float), axis=0)[0] for n in names}
    if undetermined := failing(relative_stderr, lambda s: s > _UNIFORM_SIGMA):
        failures.append((_DOUBTFUL, f"undetermined: {undetermined}"))
    # Layers without plants lie at their bound, and smoothness priors fill in layers: both are as intended.
    has_smooth_prior = set(fit.strength)
    if at_bound := failing(fit.at_bound, np.asarray, exempt=has_smooth_prior):
        failures.append((_DOUBTFUL, f"at a bound: {at_bound}"))
    from_prior = failing(fit.prior_share, lambda f: f > _MAX_PRIOR_FRACTION, exempt=has_smooth_prior)
    if from_prior:
        failures.append((_DOUBTFUL, f"from the prior: {from_prior}"))
    if (rise := float(fit.second_minimum)) < _MIN_SECOND_MINIMUM:
        failures.append((_DOUBTFUL, f"second minimum: {rise:.2g} above in chi-squared"))
    is_named = any(reason == misfit for _, reason in failures)
    if failures and not is_named and chi2 > scatter[0]:
        failures.append((_DOUBTFUL, misfit))
    return _worst_of(failures)


def judge_record(
    signal: Float[ArrayLike, " bins"],
    *,
    noise: float,
    pulse: Float[ArrayLike, " lags"] | None = None,
    degrade: int | None = None,
    stale_return: int | None = None,
) -> Verdict:
    """Judge whether a record can be fitted, by the second table of `inversion.fit.quality`.

    **Arguments:**

    - `signal`: (bins,) record, background removed.
    - `noise`: standard deviation of a sample, 0 or more; 0 for a simulated record without noise, which is not
      judged by it.
    - `pulse`: (lags,) the transmitted pulse at the record's sampling. Default None: dead samples are not
      checked, as they cannot be distinguished from narrow echoes.
    - `degrade`, `stale_return`: GEDI's flags, as `jaxlidar.io.GediShot` has them. Default None: unknown.

    **Returns:** a `Verdict`.

    **Raises:** ValueError for `noise` below 0, and for samples that are not finite or fewer than
    five.

    **Example:** a record that ends within its signal.

    >>> import inversion, numpy as np
    >>> echo = 100.0 * np.exp(-0.5 * ((np.arange(200) - 190) / 6.0) ** 2)
    >>> inversion.judge_record(echo, noise=1.0)
    Verdict(quality='bad', reasons=('cut off: the signal reaches the last samples',))
    """
    check_number("noise", noise, 0.0)
    for name, flag in (("degrade", degrade), ("stale_return", stale_return)):
        if flag is not None:
            check_integer(name, flag, 0)
    y = as_numpy(signal, "signal")
    if y.ndim != 1 or y.size < 5:
        raise ValueError(f"signal has the shape {y.shape}; admissible is (bins,), five or more")
    check_range("signal", y)
    peak, failures = float(y.max()), []
    if noise == 0 and not peak > 0:
        failures.append((_BAD, "no signal: no sample is above zero"))
    if peak < _SIGNAL_TO_NOISE[0] * noise:
        quality = _DOUBTFUL if peak >= _SIGNAL_TO_NOISE[1] * noise else _BAD
        failures.append((quality, f"weak: the largest sample is {peak / noise:.1f} times the noise"))
    if (flat := _longest_run(y == peak)) >= _CLIPPED_SAMPLES:
        failures.append((_DOUBTFUL, f"clipped: {flat} samples in a row at the largest value"))
    for end, samples in (("first", y[:_END_SAMPLES]), ("last", y[-_END_SAMPLES:])):
        mean = float(samples.mean())
        if mean > max(_CUT_OFF_SIGMAS * noise, _CUT_OFF_FRACTIONS[0] * peak):
            quality = _DOUBTFUL if mean <= _CUT_OFF_FRACTIONS[1] * peak else _BAD
            failures.append((quality, f"cut off: the signal reaches the {end} samples"))
    if pulse is not None:
        shape = as_numpy(pulse, "pulse")
        check_range("pulse", shape)
        departure = np.max(np.abs(_departure_from_cubic(shape)), initial=0.0) / np.max(shape)
        limit = _DEAD_SIGMAS * noise + _NARROWER_ECHO_FACTOR * departure * peak
        if (dead := int(np.sum(np.abs(_departure_from_cubic(y)) > limit))) > 0:
            failures.append((_DOUBTFUL, f"dead samples: {dead} do not fit their neighbours"))
    lit = np.flatnonzero(y > _CUT_OFF_SIGMAS * noise)
    if lit.size and noise > 0:
        before, after = y[: lit[0]], y[lit[-1] + 1 :]
        if min(before.size, after.size) >= _QUIET_SAMPLES[0]:
            ratio = np.std(after[-_QUIET_SAMPLES[1] :]) / max(np.std(before[: _QUIET_SAMPLES[1]]), 1e-30)
            if max(ratio, 1.0 / max(ratio, 1e-30)) > _UNEVEN_RATIO:
                failures.append((_DOUBTFUL, f"uneven noise: {ratio:.2g} times as much at the end"))
    if degrade:
        failures.append((_DOUBTFUL, f"flag: degrade = {degrade}"))
    if stale_return:
        failures.append((_BAD, f"flag: stale_return = {stale_return}"))
    return _worst_of(failures)


def _longest_run(condition: np.ndarray) -> int:
    """Return the length of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.r_[False, condition, False]))
    return int(np.max(edges[1::2] - edges[::2], initial=0))


def _departure_from_cubic(y: np.ndarray) -> np.ndarray:
    """Return samples less the cubic through two neighbours on each side, for all but two at each end."""
    return y[2:-2] - (4.0 * (y[1:-3] + y[3:-1]) - y[:-4] - y[4:]) / 6.0
