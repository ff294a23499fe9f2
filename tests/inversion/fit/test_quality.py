"""Verdicts on fits and records: every check fires on what it is for, and on nothing else; robust errors."""

import types

import jax
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from inversion import Verdict, judge_fit, judge_record
from inversion.fit.misfit import _chain, _whitened, _with_neighbours, misfit_of
from inversion.fit.uncertainty import errors_of

BIN = np.arange(600)
PULSE = np.exp(-0.5 * (np.arange(-40.0, 41.0) / 6.0) ** 2)


def record(rng):
    """An echo of 100 with noise of 1."""
    return 100.0 * np.exp(-0.5 * ((BIN - 380.0) / 6.5) ** 2) + rng.normal(size=BIN.size)


def judged(signal, **flags):
    return judge_record(signal, noise=1.0, pulse=PULSE, **flags)


def test_sound_records_are_good():
    rng = np.random.default_rng(0)
    verdicts = [judged(record(rng), degrade=0, stale_return=0) for _ in range(50)]
    assert verdicts == [Verdict("good", ())] * 50


@pytest.mark.parametrize(
    ("quality", "reason", "change"),
    [
        ("doubtful", "clipped", lambda y: np.minimum(y, 40.0)),
        ("bad", "cut off", lambda y: y[:386]),
        ("doubtful", "cut off", lambda y: y[:397]),
        ("bad", "cut off: the signal reaches the first", lambda y: y[377:]),
        ("bad", "weak", lambda y: np.random.default_rng(1).normal(size=y.size)),
        ("doubtful", "weak", lambda y: 0.08 * y),
        ("doubtful", "dead samples", lambda y: np.where(BIN == 372, 0.0, y)),
        ("doubtful", "dead samples", lambda y: np.where(BIN > 383, 2.0 * y, y)),
        ("doubtful", "uneven noise", lambda y: np.where(BIN > 300, 2.0 * y, y)),
    ],
)
def test_damaged_records_are_not_good(quality, reason, change):
    found = judged(change(record(np.random.default_rng(2))))
    assert found.quality == quality
    assert any(r.startswith(reason) for r in found.reasons)


def test_flags_count():
    signal = record(np.random.default_rng(3))
    assert judged(signal, degrade=70).quality == "doubtful"
    assert judged(signal, stale_return=1).quality == "bad"


def test_verdicts_join():
    good, doubtful, bad = (Verdict(q, (q,)) for q in ("good", "doubtful", "bad"))
    assert doubtful & bad == bad & doubtful == Verdict("bad", ("bad", "doubtful"))
    assert good & doubtful == Verdict("doubtful", ("doubtful", "good"))


SOUND = types.SimpleNamespace(
    values={"ground": np.array(0.1), "layers": np.zeros(3)},
    stderr={"ground": np.array(0.1), "layers": np.ones(3)},
    prior_share={"ground": np.array(0.01), "layers": np.full(3, 0.2)},
    at_bound={"ground": np.array(False), "layers": np.zeros(3, bool)},
    reduced_chi2=np.array(1.2),
    independent_samples=np.array(40.0),
    second_minimum=np.array(np.inf),
    strength={},
    converged=True,
)


@pytest.mark.parametrize(
    ("quality", "reason", "changes"),
    [
        ("good", None, {}),
        ("bad", "not converged", {"converged": False}),
        ("doubtful", "misfit", {"reduced_chi2": np.array(3.5)}),
        ("bad", "misfit", {"reduced_chi2": np.array(11.0)}),
        ("bad", "misfit", {"reduced_chi2": np.array(np.nan)}),
        # Few samples scatter so much.
        ("good", None, {"reduced_chi2": np.array(3.5), "independent_samples": np.array(5.0)}),
        ("doubtful", "second minimum", {"second_minimum": np.array(3.0)}),
        ("doubtful", "undetermined: layers", {"stderr": {"ground": 0.1, "layers": np.array([1, np.inf, 1])}}),
        (
            "doubtful",
            "at a bound: layers",
            {"at_bound": {"ground": False, "layers": np.array([True, False, False])}},
        ),
        ("doubtful", "from the prior: ground", {"prior_share": {"ground": 0.6, "layers": np.zeros(3)}}),
    ],
)
def test_checks_of_a_fit(quality, reason, changes):
    fit = types.SimpleNamespace(**{**vars(SOUND), **changes})
    found = judge_fit(fit)
    assert found.quality == quality
    assert [r for r in found.reasons if reason is None or not r.startswith(reason)] == []
    about_others = reason is not None and "layers" in reason
    assert (judge_fit(fit, about=["ground"]).quality == "good") == (about_others or quality == "good")
    with pytest.raises(ValueError, match="about has 'canopy'; admissible are 'ground', 'layers'"):
        judge_fit(fit, about=["canopy"])


def test_prior_share_is_that_of_the_information():
    jacobian = np.array([[2.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    share = errors_of(jacobian, np.diag([0.0, 3.0, 5.0]), np.full(3, 10.0), np.ones(2), None).prior_share
    np.testing.assert_allclose(share, [0.0, 0.75, 1.0])


def test_covariance_is_that_of_the_matrix():
    """The filter's innovations and sums, against the covariance in full, of two wavelengths with gaps."""
    rng = np.random.default_rng(6)
    place = np.repeat([0, 1], [25, 15]), np.append(np.cumsum(rng.integers(1, 4, 25)), np.arange(15))
    signal, columns = rng.uniform(size=(40, 1)), rng.normal(size=(40, 3))
    phi, excess = np.array([0.8, 0.5]), np.array([4.0, 9.0])
    chain = _chain(place)
    product, logdet = _whitened(columns, signal[:, 0], excess, phi, chain)
    weak = _with_neighbours(signal * columns, phi, chain)
    for i in range(2):
        apart = np.abs(np.subtract.outer(place[1], place[1]))
        alike = np.equal.outer(place[0], place[0]) * phi[i] ** apart * (signal * signal.T)
        covariance = np.eye(40) + excess[i] * alike
        expected = columns.T @ np.linalg.solve(covariance, columns)
        np.testing.assert_allclose(product[i], expected, atol=1e-12)
        np.testing.assert_allclose(logdet[i], np.linalg.slogdet(covariance)[1])
        np.testing.assert_allclose(weak[..., i], columns.T @ alike @ columns, atol=1e-12)


def draws(rng, phi, count=100):
    """Residuals of correlated noise, of one standard deviation."""
    noise = rng.normal(size=count)
    for i in range(1, count):
        noise[i] = phi * noise[i - 1] + np.sqrt(1.0 - phi**2) * noise[i]
    return noise


@pytest.mark.parametrize("phi", [0.0, 0.8])
def test_robust_errors_are_those_of_many_draws(phi):
    """Over 80 draws, robust errors of a line and a wave are their spread or up to 2.5 times it;
    plain ones are not too small at phi 0 alone.
    """
    rng, time = np.random.default_rng(4), np.linspace(-1.0, 1.0, 100)
    jacobian = np.stack([np.ones(100), time, np.cos(9.0 * time)], axis=1)
    inverse, place = np.linalg.inv(jacobian.T @ jacobian), (np.zeros(100, int), np.arange(100))
    found, stated = [], []
    for _ in range(80):
        noise = draws(rng, phi)
        values = inverse @ (jacobian.T @ noise)
        misfit = misfit_of(noise - jacobian @ values, jacobian, np.zeros((3, 3)), 3.0, np.ones(100), place)
        found.append(values)
        stated.append(np.diag(inverse @ misfit.middle @ inverse))
    spread = np.std(found, axis=0)
    ratio = np.sqrt(np.median(stated, axis=0)) / spread
    assert np.all((ratio > 0.85) & (ratio < 2.5))
    assert np.all(np.sqrt(np.diag(inverse)) > 0.85 * spread) == (phi == 0.0)


def test_gaps_and_wavelengths_count_as_such():
    """Samples far apart, or of two wavelengths, are independent."""
    rng, ones, bins, one = np.random.default_rng(5), np.ones((100, 1)), np.arange(100), np.zeros(100, int)
    residual = draws(rng, 0.9, 100)

    def misfit(*place):
        return misfit_of(residual, ones, np.zeros((1, 1)), 1.0, np.ones(100), place)

    dense = misfit(one, bins)
    assert dense.samples < 40
    for place in ((bins, bins), (one, 1000 * bins)):
        assert misfit(*place).samples == pytest.approx(100, rel=0.01)
        assert misfit(*place).middle < 0.3 * dense.middle


def test_unseen_and_collinear_unknowns_have_finite_middles():
    """Columns that are alike, zero, and zero with a strong prior."""
    rng, place = np.random.default_rng(7), (np.zeros(50, int), np.arange(50))
    wave, none = rng.normal(size=50), np.zeros(50)
    jacobian = np.stack([wave, 2.0 * wave, none, none], axis=1)
    found = misfit_of(rng.normal(size=50), jacobian, np.diag([0, 0, 0, 1e12]), 2.0, np.ones(50), place)
    assert np.all(np.isfinite(found.middle))
    assert 0 < found.samples <= 50


def test_fits_and_batches_say_the_same():
    """Evidence of one fit of two starts, alone and in a batch; robust errors are never narrower."""
    scene = jl.Scene(ground=jl.Ground(height=0.5, reflectance=0.3))
    wave = jl.simulate(jl.Lidar(), scene, key=jax.random.key(0))
    unknowns = [
        inversion.Unknown("ground.height", bounds=(-2.0, 2.0), name="height"),
        inversion.Unknown("ground.reflectance", bounds=(0.0, 1.0), name="brightness", prior=(0.3, 1e-6)),
    ]
    more = {"noise": 0.001, "starts": 2, "key": jax.random.key(1)}
    one = inversion.retrieve(wave, jl.Lidar(), jl.Scene(ground=jl.Ground()), unknowns, **more)
    many = inversion.retrieve_many(
        wave.reflectance[None], jl.Lidar(), jl.Scene(ground=jl.Ground()), unknowns, time=wave.time, **more
    )
    for name in one.values:
        assert one.robust_stderr[name] >= one.stderr[name]
        assert many.robust_stderr[name][0] >= many.stderr[name][0]
        np.testing.assert_allclose(many.prior_share[name][0], one.prior_share[name], atol=1e-3)
        assert many.at_bound[name][0] == one.at_bound[name] == False  # noqa: E712
    assert one.prior_share["height"] == 0.0
    assert one.prior_share["brightness"] > 0.9
    assert one.quality == many.quality[0] == Verdict("doubtful", ("from the prior: brightness",))
    assert judge_fit(one, about=["height"]).quality == "good"
    assert "height at bound" in many.to_xarray()
