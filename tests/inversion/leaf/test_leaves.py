"""Traits from leaf spectra: of leaves simulated by PROSPECT, and of measured leaves with their chemistry."""

import jax
import jax.numpy as jnp
import numpy as np
import prosail
import pytest
from scipy.optimize import least_squares

import inversion
import jaxlidar as jl
from inversion import invert_leaves
from inversion.leaf.leaves import STATUS
from tests.helpers import BY_PRECISION, slow_unless

BANDS = np.arange(400.0, 2501.0, 10.0)
RANGES = {
    "N": (1.3, 2.5),
    "Cab": (15.0, 70.0),
    "Car": (4.0, 16.0),
    "Cant": (1.0, 5.0),
    "Cbrown": (0.05, 0.4),
    "Cw": (0.006, 0.03),
    "Cm": (0.003, 0.015),
}
# Without the pigments of autumn leaves.
GREEN = ("N", "Cab", "Car", "Cw", "Cm")
NOISE = 0.005


def random_traits(count, seed=0):
    random = np.random.default_rng(seed)
    return {name: random.uniform(*limits, count) for name, limits in RANGES.items()}


def spectra(traits, bands=BANDS):
    """Arrays (leaves, wavelengths) of reflectance and transmittance."""
    leaves = jax.vmap(lambda t: jl.Prospect(**t))({name: jnp.asarray(v) for name, v in traits.items()})
    return (np.array(s) for s in leaves(bands))


@pytest.mark.slow
@BY_PRECISION
def test_traits_without_noise(precision):
    truth = random_traits(45)
    fit = invert_leaves(BANDS, *spectra(truth))
    assert bool(jnp.all(fit.converged))
    for name, value in truth.items():
        assert fit.traits[name].dtype == precision
        np.testing.assert_allclose(fit.traits[name], value, rtol=1e-3 if precision == "float32" else 1e-8)
    assert float(jnp.max(fit.rmse)) < (3e-6 if precision == "float32" else 1e-12)


@pytest.fixture(scope="module")
def noisy_leaves():
    """Truth, and reflectance and transmittance with noise, of 200 leaves."""
    truth, random = random_traits(200), np.random.default_rng(1)
    return truth, [s + NOISE * random.normal(size=s.shape) for s in spectra(truth)]


def errors_are_as_stated(fit, truth):
    """z-test of mean and variance over the leaves: True if both are within four standard errors."""
    z = np.stack([(fit.traits[n] - truth[n]) / fit.stderr[n] for n in fit.traits])
    n = z.shape[1]
    mean, variance = z.mean(axis=1), z.var(axis=1)
    return bool(np.all(np.abs(mean) < 4 / np.sqrt(n)) and np.all(np.abs(variance - 1) < 4 * np.sqrt(2 / n)))


@pytest.mark.parametrize("noise", [pytest.param(NOISE, marks=pytest.mark.slow), None])
def test_errors_are_as_stated(noisy_leaves, noise):
    truth, data = noisy_leaves
    fit = invert_leaves(BANDS, *data, noise=noise)
    assert errors_are_as_stated(fit, truth)
    # Negative control: a bias of half a standard error.
    wrong = truth | {"Cw": truth["Cw"] + 0.5 * np.asarray(fit.stderr["Cw"])}
    assert not errors_are_as_stated(fit, wrong)
    if noise is None:
        np.testing.assert_array_equal(fit.reduced_chi2, 1.0)
    else:
        # The mean of chi-squared over f degrees of freedom has a variance of 2/f for each leaf.
        degrees_of_freedom = 2 * BANDS.size - len(truth)
        assert abs(float(jnp.mean(fit.reduced_chi2)) - 1) < 4 * np.sqrt(2 / degrees_of_freedom / 200)
    np.testing.assert_allclose(jnp.mean(fit.rmse), NOISE, rtol=0.02)


@pytest.mark.slow
def test_errors_of_unequal_noise(noisy_leaves):
    truth, (R, T) = noisy_leaves
    added_noise = np.random.default_rng(2).normal(size=T.shape)
    fit = invert_leaves(
        BANDS, R, T + 0.02 * added_noise, noise=np.hypot(NOISE, [[0.0], [0.02]]) + np.zeros(BANDS.size)
    )
    assert errors_are_as_stated(fit, truth)
    assert not errors_are_as_stated(invert_leaves(BANDS, R, T + 0.02 * added_noise, noise=NOISE), truth)


@pytest.mark.slow
def test_fixed_traits_keep_their_values_leaf_by_leaf(noisy_leaves):
    truth, data = noisy_leaves
    fixed_traits = {name: jnp.asarray(truth[name]) for name in ("Cant", "Cbrown")}
    leaf = jax.vmap(lambda t: jl.Prospect(**t))(fixed_traits)
    fit = invert_leaves(BANDS, *data, unknowns=GREEN, leaf=leaf, noise=NOISE)
    assert tuple(fit.traits) == GREEN
    np.testing.assert_allclose(fit.leaves.Cant, truth["Cant"], rtol=1e-6)
    assert errors_are_as_stated(fit, truth)


@pytest.mark.slow
def test_a_missing_sample_is_left_out(noisy_leaves):
    """NaN, infinite noise and a record without the band are the same."""
    _, (R, T) = noisy_leaves
    with_nan = R[:30].copy()
    with_nan[:, 50] = np.nan
    is_recorded = np.arange(BANDS.size) != 50
    sigma = np.full((2, BANDS.size), NOISE)
    sigma[0, 50] = np.inf
    nan_in_R = invert_leaves(BANDS, with_nan, T[:30], noise=NOISE)
    infinite_noise = invert_leaves(BANDS, R[:30], T[:30], noise=sigma)
    without_band = invert_leaves(BANDS[is_recorded], R[:30, is_recorded], T[:30, is_recorded], noise=NOISE)
    nan_in_both = invert_leaves(BANDS, with_nan, np.where(is_recorded, T[:30], np.nan), noise=NOISE)
    for name, value in nan_in_R.traits.items():
        np.testing.assert_allclose(value, infinite_noise.traits[name], rtol=1e-5)
        np.testing.assert_allclose(nan_in_both.traits[name], without_band.traits[name], rtol=2e-3, atol=1e-6)
        # The model error is estimated from means of neighbouring bands, which are other bands without one.
        np.testing.assert_allclose(nan_in_both.stderr[name], without_band.stderr[name], rtol=0.1)


@pytest.mark.slow
def test_a_leaf_that_fails_does_not_affect_others(noisy_leaves):
    _, data = noisy_leaves
    R, T = (s[:30].copy() for s in data)
    before = invert_leaves(BANDS, R, T, noise=NOISE)
    R[7], T[7] = np.nan, np.nan
    # Leaf 7 has no samples, leaf 8 spectra that no leaf has.
    R[8], T[8] = 2.0, -1.0
    after = invert_leaves(BANDS, R, T, noise=NOISE)
    unchanged = np.setdiff1d(np.arange(30), [7, 8])
    assert int(after.status[7]) == STATUS.index("not fitted: no sample to fit, values are those of the start")
    assert "not determined: N, Cab" in after.sentence(7)
    assert float(after.traits["Cab"][7]) == 40.0
    assert "at a bound" in after.sentence(8)
    assert np.all(np.asarray(after.converged)[unchanged])
    for name, value in before.traits.items():
        np.testing.assert_allclose(after.traits[name][unchanged], value[unchanged], rtol=1e-5)
    assert not any(np.any(np.isnan(a)) for a in jax.tree.leaves(after))


@pytest.mark.slow
def test_traits_that_are_not_determined_have_infinite_errors(noisy_leaves):
    _, (R, _) = noisy_leaves
    # Water does not absorb in visible bands.
    visible = BANDS < 700
    fit = invert_leaves(BANDS[visible], R[:5, visible], noise=NOISE)
    assert np.all(np.isinf(fit.stderr["Cw"]))
    # Seven unknowns from two bands.
    of_two_bands = invert_leaves(BANDS[[20, 60]], R[:5, [20, 60]])
    assert np.all(np.isinf(of_two_bands.stderr["Cab"]))
    assert not any(np.any(np.isnan(a)) for a in jax.tree.leaves((fit, of_two_bands)))


@pytest.mark.slow
def test_steps_run_out(noisy_leaves):
    _, data = noisy_leaves
    fit = invert_leaves(BANDS, *(s[0] for s in data), max_steps=1)
    assert fit.sentence(0).startswith("not converged: stopped at max_steps after 1 step")
    assert "1 not converged" in str(fit)


@pytest.mark.parametrize("version", slow_unless([], ["4", "5", "PC"]))
def test_other_versions(version):
    leaf = jl.Prospect(N=1.8, Cab=30.0, Cw=0.015, version=version)
    fit = invert_leaves(BANDS, *map(np.asarray, leaf(BANDS)), leaf=jl.Prospect(version=version))
    R, T = fit.leaves(BANDS)
    np.testing.assert_allclose(jnp.stack([R[0], T[0]]), jnp.stack(leaf(BANDS)), atol=2e-5)
    np.testing.assert_allclose(fit.traits["Cab"], 30.0, rtol=1e-3)


@pytest.mark.slow
def test_domains(noisy_leaves):
    """Each trait is the one of a fit to its own bands alone, with the other traits fixed."""
    _, (R, T) = noisy_leaves
    R, T = R[:30], T[:30]
    fit = invert_leaves(BANDS, R, T, domain="recommended")
    assert {name: d.tolist() for name, d in fit.domain.items()} == {
        **{name: [[400.0, 2500.0]] for name in RANGES},
        "Cab": [[700.0, 720.0]],
        "Car": [[520.0, 560.0]],
        "Cw": [[1700.0, 2400.0]],
        "Cm": [[1700.0, 2400.0]],
    }
    all_bands = invert_leaves(BANDS, R, T)
    np.testing.assert_array_equal(fit.traits["N"], all_bands.traits["N"])
    bands = (BANDS >= 1700) & (BANDS <= 2400)
    alone = invert_leaves(
        BANDS[bands], R[:, bands], T[:, bands], unknowns=("N", "Cw", "Cm"), leaf=all_bands.leaves
    )
    for name in ("Cw", "Cm"):
        np.testing.assert_allclose(fit.traits[name], alone.traits[name], rtol=1e-3)
        assert not np.allclose(fit.traits[name], all_bands.traits[name], rtol=1e-3)
    # Bounds of several intervals are those of the bands within them.
    several = invert_leaves(BANDS, R, T, domain={"Cm": ((1700.0, 1800.0), (2205.0, 2400.0))})
    np.testing.assert_array_equal(several.domain["Cm"], [[1700.0, 1800.0], [2210.0, 2400.0]])


@pytest.mark.slow
def test_domains_that_lack_bands(noisy_leaves):
    _, (R, T) = noisy_leaves
    short = BANDS <= 1600
    with pytest.raises(ValueError, match=r"400 to 1600 nm do not span half of 1700 to 2400 nm, .* Cw, Cm"):
        invert_leaves(BANDS[short], R[:5, short], T[:5, short], domain="recommended")
    fit = invert_leaves(
        BANDS[short], R[:5, short], T[:5, short], unknowns=("N", "Cab", "Car"), domain="recommended"
    )
    assert fit.domain["Cab"].tolist() == [[700.0, 720.0]]
    with_nan = R[:5].copy(), T[:5].copy()
    for s in with_nan:
        s[2, BANDS > 1600] = np.nan
    fit = invert_leaves(BANDS, *with_nan, domain="recommended")
    assert np.isinf(fit.stderr["Cm"]).tolist() == [False, False, True, False, False]
    assert "not determined: Cw, Cm" in fit.sentence(2)
    assert not any(np.any(np.isnan(a)) for a in jax.tree.leaves(fit))


def with_model_error(truth, fraction=0.06, constant=0.003, length=250.0, seed=3):
    """Spectra with errors of absorption, by a fraction, and of scattering, by a constant.

    Both are Gaussian processes over wavelength, with exponential correlation of that length in nm.
    """
    R, T = spectra(truth)
    # All contents by the same factor: the derivative with respect to ln k.
    raised = {n: v * (1.001 if n != "N" else 1.0) for n, v in truth.items()}
    derivative = np.stack([m - s for m, s in zip(spectra(raised), (R, T))], axis=1) / 0.001
    root = np.linalg.cholesky(np.exp(-np.abs(BANDS[:, None] - BANDS) / length))
    process = np.random.default_rng(seed).normal(size=(4, *R.shape)) @ root.T
    return [
        s + fraction * derivative[:, i] * process[i] + constant * process[2 + i] for i, s in enumerate((R, T))
    ]


def coverage(fit, truth):
    """By trait, the fraction of leaves within two standard errors of the truth."""
    return {n: float(np.mean(np.abs(fit.traits[n] - truth[n]) < 2 * fit.stderr[n])) for n in fit.traits}


@pytest.mark.slow
@pytest.mark.parametrize("domain", slow_unless([None], [None, "recommended"]))
def test_errors_cover_model_errors(noisy_leaves, domain):
    """2 standard errors cover 95.4 %; of 200 leaves the mean within 92 to 98, no trait below 88."""
    truth, _ = noisy_leaves
    random = np.random.default_rng(4)
    data = [s + 0.002 * random.normal(size=s.shape) for s in with_model_error(truth)]
    fit = invert_leaves(BANDS, *data, domain=domain)

    def is_honest(fractions):
        return 0.92 <= np.mean(list(fractions.values())) <= 0.98 and min(fractions.values()) >= 0.88

    fractions = coverage(fit, truth)
    assert is_honest(fractions), fractions
    if domain is None:
        # Negative control, as if samples were independent: the curvature of the fit, scaled by the residuals.
        x = jnp.stack([jnp.asarray(truth[n]) for n in RANGES], axis=1)
        jacobian = jax.lax.map(
            jax.jacfwd(lambda x: jnp.stack(jl.Prospect(**dict(zip(RANGES, x)))(BANDS))), x, batch_size=20
        )
        jacobian = np.asarray(jacobian, float).reshape(200, -1, len(RANGES))
        normal = jacobian.transpose(0, 2, 1) @ jacobian
        covariance = np.linalg.inv(normal) * np.asarray(fit.rmse)[:, None, None] ** 2
        errors = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        fractions = {
            n: float(np.mean(np.abs(fit.traits[n] - truth[n]) < 2 * errors[:, i]))
            for i, n in enumerate(RANGES)
        }
        assert not is_honest(fractions), fractions


SPECTRA = np.full((2, BANDS.size), 0.4)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"wavelengths": BANDS[:5]}, r"reflectance has the shape \(2, 211\); .*\(2, 5\)"),
        ({"wavelengths": BANDS - 100.0}, r"wavelengths = 300 is outside .*\[400, 2500\]"),
        ({"wavelengths": 500.0}, r"wavelengths has the shape \(\)"),
        ({"reflectance": 100 * SPECTRA}, r"reflectance = 40 is outside .*\[-1, 2\]"),
        ({"reflectance": np.where(BANDS > 500, SPECTRA, np.inf)}, "reflectance = inf"),
        ({"transmittance": SPECTRA[:1]}, r"transmittance has the shape \(1, 211\)"),
        ({"reflectance": SPECTRA[:0], "transmittance": None}, r"reflectance has the shape \(0, 211\)"),
        ({"reflectance": None, "transmittance": None}, "reflectance = None and transmittance = None"),
        ({"unknowns": ("N", "Cp")}, "'Cp' .* N, Cab, Car, Cant, Cbrown, Cw, Cm"),
        ({"unknowns": ("N", "N")}, "'N' is given twice"),
        ({"unknowns": ()}, "unknowns is empty"),
        ({"bounds": {"Cp": (0.0, 1.0)}}, "bounds: 'Cp' is none of"),
        ({"bounds": {"N": (0.5, 2.0)}}, r"bounds: lower of N = 0.5 is outside .*\[1"),
        ({"bounds": {"Cab": (50.0, 20.0)}}, r"bounds: upper of Cab = 20 is outside .*\(50"),
        ({"bounds": {"Cab": (1.0, 2.0, 3.0)}}, r"Cab = \(1.0, 2.0, 3.0\) is not a pair"),
        ({"bounds": {"Cab": (50.0, 90.0)}}, r"start of Cab = 40 is outside .*\[50, 90\]"),
        ({"noise": 0.0}, r"noise = 0 is outside .*\(0, inf\]"),
        ({"noise": np.nan}, "noise = nan"),
        ({"noise": np.ones(3)}, r"noise has the shape \(3,\)"),
        ({"domain": "best"}, "domain = 'best' is none of None, 'recommended'"),
        ({"domain": {"Cp": (500.0, 600.0)}}, "domain: 'Cp' is none of the unknowns"),
        ({"domain": {"Cab": (600.0, 500.0)}}, r"domain: Cab = \(600.0, 500.0\) is neither a pair"),
        (
            {"domain": {"Cab": (700.0, 710.0, 720.0)}},
            r"domain: Cab = \(700.0, 710.0, 720.0\) is neither a pair",
        ),
        (
            {"domain": {"Cab": ((500.0, 600.0), (2600.0, 2700.0))}},
            "half of 2600 to 2700 nm, the domain of Cab",
        ),
        ({"needle": True}, "needle is given with domain = None; admissible is domain = 'recommended'"),
        ({"needle": 3 * [True], "domain": "recommended"}, r"needle has the shape \(3,\)"),
        ({"max_steps": 0}, "max_steps = 0"),
        ({"chunk": 0}, "chunk = 0"),
        ({"leaf": jax.vmap(lambda n: jl.Prospect(N=n))(jnp.ones(3))}, r"leaf: N has the shape \(3,\)"),
    ],
)
def test_bad_input(changes, message):
    arguments = {"wavelengths": BANDS, "reflectance": SPECTRA, "transmittance": SPECTRA} | changes
    with pytest.raises(ValueError, match=message):
        invert_leaves(**arguments)


# -- measured leaves -----------------------------------------------------------------------------------

# Columns of the databases, by trait.
CHEMISTRY = {
    "Cab": "leaf_chltot_per_area",
    "Car": "leaf_cartot_per_area",
    "Cw": "leaf_water_thickness",
    "Cm": "leaf_mass_per_area",
}


def measured(shared, name):
    with np.load(shared / "leaves" / name) as archive:
        return dict(archive)


def error_of(fit, record):
    """Root mean squared errors, ug/cm2, cm and g/cm2, over leaves with measured chemistry."""
    return {
        name: float(np.sqrt(np.nanmean((np.asarray(fit.traits[name]) - record[column]) ** 2)))
        for name, column in CHEMISTRY.items()
        if not np.all(np.isnan(record[column]))
    }


@pytest.mark.slow
def test_measured_leaves_of_angers(shared):
    """Errors are at most 5 % above those of PROSPECT-D with scipy on all ANGERS leaves; here every second."""
    record = measured(shared, "angers_half.npz")
    fit = invert_leaves(record["wavelength_nm"], record["R"], record["T"])
    assert bool(jnp.all(fit.converged))
    error = error_of(fit, record)
    for name, reference in {"Cab": 6.65, "Car": 2.67, "Cw": 0.00212, "Cm": 0.00261}.items():
        assert error[name] < 1.05 * reference, name
    green = error_of(invert_leaves(record["wavelength_nm"], record["R"], record["T"], unknowns=GREEN), record)
    # The figures of the docstring of `invert_leaves`.
    assert [round(e[n], 1) for n in ("Cab", "Car") for e in (green, error)] == [4.9, 6.6, 3.7, 2.7]


# Largest root mean squared error by trait.
RECOMMENDED = {
    "angers_half.npz": {"Cab": 5.0, "Car": 2.3, "Cw": 0.00145, "Cm": 0.00096},
    # On these leaves both pigments are overestimated by more than the spectra show.
    "lopex_half.npz": {"Cab": 11.0, "Car": 2.7, "Cw": 0.0008, "Cm": 0.00135},
}
# Fewest leaves whose chemistry lies within two standard errors.
LEAST_COVERAGE = 0.85


def coverage_of_chemistry(fit, record, trait):
    """Fraction of measured leaves within two standard errors."""
    chemistry = record[CHEMISTRY[trait]]
    is_measured = ~np.isnan(chemistry)
    error = np.abs(np.asarray(fit.traits[trait]) - chemistry)[is_measured]
    return float(np.mean(error < 2 * np.asarray(fit.stderr[trait])[is_measured]))


@pytest.mark.slow
@pytest.mark.parametrize("name", slow_unless(["angers_half.npz"], list(RECOMMENDED)))
def test_measured_leaves_in_recommended_domains(shared, name):
    record, largest_error = measured(shared, name), RECOMMENDED[name]
    fit = invert_leaves(record["wavelength_nm"], record["R"], record["T"], domain="recommended")
    assert bool(jnp.all(fit.converged))
    for trait in CHEMISTRY:
        assert error_of(fit, record)[trait] < largest_error[trait], trait
        assert coverage_of_chemistry(fit, record, trait) >= LEAST_COVERAGE, trait


@pytest.mark.slow
def test_needles_have_a_domain_of_their_own(shared):
    """Errors hold for needles and for broad leaves; needles that are not said to be so are noticed."""
    record = measured(shared, "nasa_fft_quarter.npz")
    # Every fifth nanometre: the same results, in less time.
    spectra_of = {name: record[name][:, ::5] for name in "RT"}
    wavelengths, is_needle = record["wavelength_nm"][::5], record["needle"]
    fit = invert_leaves(wavelengths, spectra_of["R"], spectra_of["T"], domain="recommended", needle=is_needle)
    assert bool(jnp.all(fit.converged))
    largest = {True: {"Cw": 0.0065, "Cm": 0.0040}, False: {"Cw": 0.0011, "Cm": 0.0009}}
    for kind, largest_error in largest.items():
        leaves = np.flatnonzero(is_needle == kind)
        of_kind = jax.tree.map(lambda a: a[leaves] if a.ndim == 1 else a, fit)  # noqa: B023
        chemistry = {column: record[column][leaves] for column in CHEMISTRY.values()}
        for trait, largest_value in largest_error.items():
            assert error_of(of_kind, chemistry)[trait] < largest_value, (kind, trait)
            assert coverage_of_chemistry(of_kind, chemistry, trait) >= LEAST_COVERAGE, (kind, trait)
    with pytest.warns(inversion.GapLightWarning, match="leaves .* let more light through") as warned:
        unflagged = invert_leaves(wavelengths, spectra_of["R"], spectra_of["T"], domain="recommended")
    count = int(str(warned[0].message).split()[0])
    assert 0.8 * is_needle.sum() < count <= is_needle.sum()
    # Negative control: the domain of leaves is wrong for needles, and right for the others.
    needles = {column: np.where(is_needle, record[column], np.nan) for column in CHEMISTRY.values()}
    assert error_of(unflagged, needles)["Cm"] > 1.9 * error_of(fit, needles)["Cm"]
    assert coverage_of_chemistry(unflagged, needles, "Cw") < 0.7
    np.testing.assert_allclose(
        np.asarray(unflagged.traits["Cm"])[~is_needle], np.asarray(fit.traits["Cm"])[~is_needle], rtol=1e-3
    )


@pytest.mark.slow
def test_light_through_gaps_is_noticed():
    truth = random_traits(20) | {"Cw": np.linspace(0.02, 0.04, 20)}
    R, T = spectra(truth)
    gap = 0.05
    needles = (1.0 - gap) * R, (1.0 - gap) * T + gap
    with pytest.warns(inversion.GapLightWarning, match=r"20 of 20 leaves \(0, 1, 2, 3, 4, \.\.\.\)"):
        unflagged = invert_leaves(BANDS, *needles, domain="recommended")
    fit = invert_leaves(BANDS, *needles, domain="recommended", needle=True)
    np.testing.assert_allclose(fit.domain["Cw"], [[1500.0, 1800.0], [2050.0, 2400.0]])

    def bias(fit, name):
        return abs(float(np.mean(np.asarray(fit.traits[name]) - truth[name])))

    assert bias(fit, "Cm") < 0.7 * bias(unflagged, "Cm")
    # Leaves without gaps give no warning.
    invert_leaves(BANDS, R, T, domain="recommended")


@pytest.mark.slow
def test_measured_leaves_of_lopex(shared):
    record = measured(shared, "lopex_half.npz")
    fit = invert_leaves(record["wavelength_nm"], record["R"], record["T"])
    assert bool(jnp.all(fit.converged))
    for name, largest in {"Cab": 9.0, "Car": 3.0, "Cw": 0.0011, "Cm": 0.0023}.items():
        assert error_of(fit, record)[name] < largest, name


@pytest.mark.slow
def test_against_scipy_with_prosail(shared):
    """The same minimum, to a few hundredths of a standard error, by another solver and another model."""
    record, leaves, step = measured(shared, "angers_half.npz"), [0, 40, 135], 10
    R, T = (record[s][leaves, ::step].astype(float) for s in "RT")
    fit = invert_leaves(record["wavelength_nm"][::step], R, T)
    names = tuple(RANGES)

    def residual(x, r, t):
        content = dict(zip(("n", "cab", "car", "ant", "cbrown", "cw", "cm"), x))
        _, model_r, model_t = prosail.run_prospect(**content)
        difference = np.concatenate([model_r[:2051:step] - r, model_t[:2051:step] - t])
        return np.where(np.isnan(difference), 0.0, difference)

    low, high = [1.0, *6 * [0.0]], [5.0, 150.0, 50.0, 50.0, 5.0, 0.1, 0.1]
    for i, data in enumerate(zip(R, T)):
        best = least_squares(
            residual, [1.5, 40, 8, 0.1, 0.1, 0.01, 0.009], args=data, bounds=(low, high), x_scale="jac"
        )
        for name, value in zip(names, best.x):
            assert abs(float(fit.traits[name][i]) - value) < 0.03 * float(fit.stderr[name][i]), name
