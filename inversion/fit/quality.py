"""Whether a fit of a recorded waveform can be trusted: "good", "doubtful" or "bad", with reasons.

A verdict is the worst of a small set of named checks; each gives a reason where it finds something. Those
of a fit (`judge_fit`, `judge_fits`), with n the number of independent samples that the correlated ones
amount to:

| check | doubtful | bad |
| --- | --- | --- |
| end | | not converged |
| misfit | reduced chi-squared above 3, or 1 + 4 sqrt(2 / n) if more | above 10, or 1 + 12 sqrt(2 / n) |
| undetermined | an unknown has an infinite standard error | |
| bound | an unknown lies at a bound, unless its prior is one of smoothness | |
| prior | the prior has more than half of the information on an unknown, the same | |
| second minimum | another end within 4 in chi-squared, counted as independent samples | |

and those of a record before any fit (`judge_record`), with the noise's standard deviation s:

| check | doubtful | bad |
| --- | --- | --- |
| signal | largest sample below 10 s | below 6 s |
| clipped | three or more samples in a row at the largest value | |
| cut off | an end of the record above 4 s and a hundredth of the peak | above a tenth of the peak |
| dead samples | a sample departs by 6 s, and more than the pulse does, from the cubic by its neighbours | |
| uneven noise | that of the last quiet samples over that of the first is above 1.7 or below 1 / 1.7 | |
| flags | the product's flag `degrade` is set | its flag `stale_return` is set |

The thresholds are those that hold for any instrument; the checks of a record are for one that is sampled
several times within its pulse.
"""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float

from jaxlidar.extend import check_range

if TYPE_CHECKING:
    from inversion.fit.batch import Retrievals
    from inversion.fit.result import Retrieval

_ORDER = ("good", "doubtful", "bad")
_GOOD, _DOUBTFUL, _BAD = _ORDER
# See the table.
_CHI2, _CHI2_SIGMAS = (3.0, 10.0), (4.0, 12.0)
_PRIOR, _SECOND = 0.5, 4.0
_SIGNAL, _FLAT, _DEAD, _UNEVEN = (10.0, 6.0), 3, 6.0, 1.7
_CUT, _CUT_SHARES = 4.0, (0.01, 0.1)
# Samples at each end of a record; fewest and most of either end that show its noise.
_END, _QUIET = 3, (100, 200)
# What the pulse departs by from cubics is taken so many times, for echoes that are narrower.
_NARROWER = 1.5


class Verdict(NamedTuple):
    """How far a fit can be trusted.

    - `quality`: "good", "doubtful" or "bad".
    - `reasons`: a sentence for each check that found something, the gravest first; empty where it is good.

    **Example:**

    >>> import inversion
    >>> verdict = inversion.Verdict("bad", ("no signal",))
    >>> verdict & inversion.Verdict("good", ())
    Verdict(quality='bad', reasons=('no signal',))
    """

    quality: str
    reasons: tuple[str, ...]

    def __and__(self, other: "Verdict") -> "Verdict":
        """The worse of two, with the reasons of both."""
        first, second = sorted((self, other), key=lambda v: -_ORDER.index(v.quality))
        return Verdict(first.quality, (*first.reasons, *second.reasons))


def _worst(found: Iterable[tuple[str, str]]) -> Verdict:
    """The verdict of what checks found: pairs of a quality and a reason."""
    ordered = sorted(found, key=lambda pair: -_ORDER.index(pair[0]))
    return Verdict(ordered[0][0] if ordered else _GOOD, tuple(reason for _, reason in ordered))


def judge_fit(fit: "Retrieval", *, about: Sequence[str] | None = None) -> Verdict:
    """Whether a fit can be trusted: the first table of `inversion.quality`.

    **Arguments:**

    - `fit`: what `retrieve` gave.
    - `about`: names of the unknowns that the verdict is about: of others, bounds and priors do not matter.
      Default None: all.

    **Returns:** a `Verdict`.

    **Raises:** ValueError for a name that the fit has not.

    **Example:** a plate that is not there is fitted to an echo of the ground.

    >>> import jaxlidar as jl
    >>> import inversion, jax
    >>> wave = jl.simulate(jl.Lidar(), jl.Scene(ground=jl.Ground(height=0.5)), key=jax.random.key(0))
    >>> height = inversion.Unknown("ground.height", bounds=(-2.0, 0.2))
    >>> start = jl.Scene(ground=jl.Ground())
    >>> fit = inversion.retrieve(wave, jl.Lidar(), start, [height], noise=0.001, key=jax.random.key(1))
    >>> inversion.judge_fit(fit).quality
    'bad'
    """
    return _judge(fit, about, ())


def judge_fits(fits: "Retrievals", *, about: Sequence[str] | None = None) -> tuple[Verdict, ...]:
    """Whether each fit of many can be trusted: see `judge_fit`.

    **Arguments:** `fits`: what `retrieve_many` gave. `about`: as for `judge_fit`.

    **Returns:** a `Verdict` for each footprint.

    **Raises:** ValueError for a name that the fits have not.

    **Example:**

    >>> import jaxlidar as jl
    >>> import inversion, jax
    >>> scene = jl.Scene(ground=jl.Ground(height=0.5))
    >>> wave = jl.simulate(jl.Lidar(), scene, key=jax.random.key(0))
    >>> unknown = inversion.Unknown("ground.reflectance", bounds=(0.0, 1.0), name="brightness")
    >>> more = {"noise": 0.001, "time": wave.time, "key": jax.random.key(1)}
    >>> fits = inversion.retrieve_many(wave.reflectance[None], jl.Lidar(), scene, [unknown], **more)
    >>> inversion.judge_fits(fits, about=["brightness"])
    (Verdict(quality='good', reasons=()),)
    """
    return tuple(_judge(fits, about, i) for i in range(len(fits.status)))


def _judge(fit: Any, about: Sequence[str] | None, at: Any) -> Verdict:
    """The verdict of a fit, or of one of many at a place."""

    def of(name: str) -> Any:
        return np.asarray(getattr(fit, name))[at]

    names = list(fit.values) if about is None else list(about)
    for name in names:
        if name not in fit.values:
            raise ValueError(f"about has {name!r}; admissible are {', '.join(map(repr, fit.values))}")

    def those(field: str, wrong: Any, but: Iterable[str] = ()) -> str:
        found = getattr(fit, field)
        return ", ".join(n for n in names if n not in but and np.any(wrong(np.asarray(found[n])[at])))

    found = []
    if not of("converged"):
        found.append((_BAD, "not converged"))
    chi2, samples = float(of("reduced_chi2")), max(float(of("independent_samples")), 1.0)
    limits = [max(c, 1.0 + k * np.sqrt(2.0 / samples)) for c, k in zip(_CHI2, _CHI2_SIGMAS)]
    # What is not finite is bad.
    if not chi2 <= limits[0]:
        found.append((_DOUBTFUL if chi2 <= limits[1] else _BAD, f"misfit: reduced chi-squared {chi2:.3g}"))
    if open := those("stderr", np.isinf):
        found.append((_DOUBTFUL, f"undetermined: {open}"))
    if bound := those("at_bound", np.asarray, but=fit.strength):
        found.append((_DOUBTFUL, f"at a bound: {bound}"))
    if prior := those("prior_share", lambda share: share > _PRIOR, but=fit.strength):
        found.append((_DOUBTFUL, f"from the prior: {prior}"))
    if (rise := float(of("second_minimum"))) < _SECOND:
        found.append((_DOUBTFUL, f"second minimum: {rise:.2g} above in chi-squared"))
    return _worst(found)


def judge_record(
    signal: Float[ArrayLike, " bins"],
    *,
    noise: float,
    pulse: Float[ArrayLike, " lags"] | None = None,
    degrade: int | None = None,
    stale_return: int | None = None,
) -> Verdict:
    """Whether a record can be fitted: the second table of `inversion.quality`.

    **Arguments:**

    - `signal`: (bins,) record, background removed.
    - `noise`: standard deviation of a sample, above 0.
    - `pulse`: (lags,) the transmitted pulse at the record's sampling. Default None: dead samples are not
      looked for, as they cannot be told from narrow echoes.
    - `degrade`, `stale_return`: GEDI's flags, as `jaxlidar.io.GediShot` has them. Default None: not known.

    **Returns:** a `Verdict`.

    **Raises:** ValueError for `noise` that is not above 0, and for samples that are not finite or fewer than
    five.

    **Example:** a record that ends within its signal.

    >>> import inversion, numpy as np
    >>> echo = 100.0 * np.exp(-0.5 * ((np.arange(200) - 190) / 6.0) ** 2)
    >>> inversion.judge_record(echo, noise=1.0)
    Verdict(quality='bad', reasons=('cut off: the signal reaches the last samples',))
    """
    check_range("noise", noise, 0.0, low_open=True)
    y = np.asarray(signal, float)
    if y.ndim != 1 or y.size < 5:
        raise ValueError(f"signal has the shape {y.shape}; admissible is (bins,), five or more")
    check_range("signal", y)
    peak, found = float(y.max()), []
    if peak < _SIGNAL[0] * noise:
        quality = _DOUBTFUL if peak >= _SIGNAL[1] * noise else _BAD
        found.append((quality, f"weak: the largest sample is {peak / noise:.1f} times the noise"))
    if (flat := _longest(y == peak)) >= _FLAT:
        found.append((_DOUBTFUL, f"clipped: {flat} samples in a row at the largest value"))
    for which, end in (("first", y[:_END]), ("last", y[-_END:])):
        reached = float(end.mean())
        if reached > max(_CUT * noise, _CUT_SHARES[0] * peak):
            quality = _DOUBTFUL if reached <= _CUT_SHARES[1] * peak else _BAD
            found.append((quality, f"cut off: the signal reaches the {which} samples"))
    if pulse is not None:
        shape = np.asarray(pulse, float)
        own = np.max(np.abs(_off_cubic(shape)), initial=0.0) / np.max(shape)
        limit = _DEAD * noise + _NARROWER * own * peak
        if (dead := int(np.sum(np.abs(_off_cubic(y)) > limit))) > 0:
            found.append((_DOUBTFUL, f"dead samples: {dead} do not fit their neighbours"))
    lit = np.flatnonzero(y > _CUT * noise)
    if lit.size:
        before, after = y[: lit[0]], y[lit[-1] + 1 :]
        if min(before.size, after.size) >= _QUIET[0]:
            ratio = np.std(after[-_QUIET[1] :]) / max(np.std(before[: _QUIET[1]]), 1e-30)
            if max(ratio, 1.0 / max(ratio, 1e-30)) > _UNEVEN:
                found.append((_DOUBTFUL, f"uneven noise: {ratio:.2g} times as much at the end"))
    if degrade:
        found.append((_DOUBTFUL, f"flag: degrade = {degrade}"))
    if stale_return:
        found.append((_BAD, f"flag: stale_return = {stale_return}"))
    return _worst(found)


def _longest(which: np.ndarray) -> int:
    """Length of the longest run of what is true."""
    ends = np.flatnonzero(np.diff(np.r_[False, which, False]))
    return int(np.max(ends[1::2] - ends[::2], initial=0))


def _off_cubic(y: np.ndarray) -> np.ndarray:
    """Samples less the cubic through the two neighbours on each side; those at the ends have none."""
    return y[2:-2] - (4.0 * (y[1:-3] + y[3:-1]) - y[:-4] - y[4:]) / 6.0
