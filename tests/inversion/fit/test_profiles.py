"""Profiles: smoothness priors against dense Gaussian formulas, averaging kernels against refits, coverage of
bands, layers on slopes, and the closed-form gap inversion of what it is exact for.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy import optimize

import inversion
import jaxlidar as jl
from inversion import Smooth, Unknown
from inversion.fit.data import Data
from inversion.fit.model import Evaluation
from inversion.fit.priors import Priors
from inversion.fit.profiles import averaging_kernel_of, band_of
from inversion.fit.retrieval import SOLVER
from inversion.fit.solver import Fit, drive
from inversion.fit.unknowns import Place, Settled
from inversion.receiver.recorder import RecorderModel
from tests.helpers import NARROW

LAYERS, SAMPLES, STRENGTH = 12, 40, 0.3
SMOOTH = Smooth(3.0, strength=STRENGTH)
CENTRE = 1.0


def settled_of(smooth, low=-9.0, high=11.0):
    """A profile, and a number beside it."""
    start = jnp.full(LAYERS, CENTRE)
    place = Place(None, None, "geometric")
    wide = Settled("x", place, start, np.full(LAYERS, low), np.full(LAYERS, high), None)
    number = Settled("b", place, jnp.asarray(0.0), np.asarray(-50.0), np.asarray(50.0), None)
    return [wide._replace(smooth=smooth), number]


def instrument():
    """A linear instrument that blurs the layers, and an offset: (samples, values)."""
    place = np.linspace(0.0, LAYERS - 1.0, SAMPLES)
    blur = np.exp(-0.5 * ((place[:, None] - np.arange(LAYERS)) / 1.2) ** 2)
    return np.column_stack([blur, np.ones(SAMPLES)])


def fitted(observed, smooth, **bounds):
    """The fit of a record with noise of one, with the fields that bands and kernels need."""
    matrix, settled = instrument(), settled_of(smooth, **bounds)
    data = Data(np.arange(SAMPLES, dtype=float), observed[None], np.ones((1, SAMPLES)))
    fit = Fit(data, settled, RecorderModel(None, [], jl.Lidar(), SAMPLES), SOLVER, 50, None)
    out = drive(fit.run(), lambda q: Evaluation((matrix @ q.values)[None], matrix[None], None, None))
    split = lambda a: {"x": a[..., :LAYERS], "b": a[..., LAYERS]}  # noqa: E731
    own = {f: split(getattr(out, f)) for f in ("values", "stderr", "robust_stderr", "prior_share")}
    bounds = {s.name: np.stack([s.low, s.high]) for s in settled}
    keep = ("averaging", "covariance", "strength", "converged", "status", "steps")
    return type("Found", (), {**own, "bounds": bounds, **{k: getattr(out, k) for k in keep}})


def covariance_of(strength, smooth=SMOOTH):
    """Of the layers, written out."""
    apart = np.sqrt(3.0) * np.abs(np.subtract.outer(np.arange(LAYERS), np.arange(LAYERS))) / smooth.scale
    return strength**2 * ((1.0 + apart) * np.exp(-apart) + 9.0)


def record(rng, strength=STRENGTH, scale=1.0):
    """A profile of the prior, and a record of it."""
    root = np.linalg.cholesky(covariance_of(strength) + 1e-9 * np.eye(LAYERS))
    truth = CENTRE + root @ rng.normal(size=LAYERS)
    return truth, instrument() @ np.append(truth, 2.0) + scale * rng.normal(size=SAMPLES)


def test_the_fit_is_the_posterior_mean_with_its_covariance():
    """Against the formulas for jointly normal profile and data, with the offset of a wide prior."""
    _, y = record(np.random.default_rng(0))
    matrix, prior = instrument(), np.zeros((LAYERS + 1, LAYERS + 1))
    prior[:-1, :-1], prior[-1, -1] = covariance_of(STRENGTH), 1e5
    gain = prior @ matrix.T @ np.linalg.inv(matrix @ prior @ matrix.T + np.eye(SAMPLES))
    centre = np.append(np.full(LAYERS, CENTRE), 0.0)
    mean, covariance = centre + gain @ (y - matrix @ centre), prior - gain @ matrix @ prior
    fit = fitted(y, SMOOTH)
    assert fit.converged, fit.status
    np.testing.assert_allclose(fit.values["x"], mean[:-1], atol=2e-3)
    np.testing.assert_allclose(fit.covariance, covariance, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(fit.averaging, gain @ matrix, atol=1e-4)
    share = np.clip(1.0 - np.diag(gain @ matrix)[:-1], 0.0, 1.0)
    np.testing.assert_allclose(fit.prior_share["x"], share, atol=1e-4)


def test_the_strength_is_that_of_the_largest_evidence():
    """Against the density of the data, by dense matrices, on a fine grid."""
    _, y = record(np.random.default_rng(3))
    matrix = instrument()
    off = y - matrix @ np.append(np.full(LAYERS, CENTRE), 0.0)

    def deviance(strength):
        prior = np.zeros((LAYERS + 1, LAYERS + 1))
        prior[:-1, :-1], prior[-1, -1] = covariance_of(strength), 100.0**2
        total = matrix @ prior @ matrix.T + np.eye(SAMPLES)
        return off @ np.linalg.solve(total, off) + np.linalg.slogdet(total)[1]

    grid = np.geomspace(0.02, 5.0, 400)
    best = grid[np.argmin([deviance(s) for s in grid])]
    priors = Priors(settled_of(Smooth(3.0)))
    values = np.append(np.full(LAYERS, CENTRE), 0.0)
    for _ in range(8):
        priors.put(priors.likeliest(values, matrix @ values - y, matrix))
    np.testing.assert_allclose(priors.strengths, best, rtol=0.02)
    fit = fitted(y, Smooth(3.0))
    assert fit.converged
    np.testing.assert_allclose(fit.strength, best, rtol=0.12)
    # Another strength tells the data less well, by more than the grid's steps.
    assert deviance(3.0 * best) > deviance(best) + 0.5
    assert deviance(best / 3.0) > deviance(best) + 0.5


def test_the_averaging_kernel_is_that_of_refits():
    truth, _ = record(np.random.default_rng(1))
    kernel = averaging_kernel_of(fitted(instrument() @ np.append(truth, 2.0), SMOOTH), "x", 1.5)
    for layer in (0, 5, LAYERS - 1):
        ends = []
        for change in (1.0, -1.0):
            moved = truth + change * np.eye(LAYERS)[layer]
            ends.append(fitted(instrument() @ np.append(moved, 2.0), SMOOTH).values["x"])
        np.testing.assert_allclose(0.5 * (ends[0] - ends[1]), kernel.matrix[:, layer], atol=2e-3)
    np.testing.assert_allclose(kernel.degrees_of_freedom, np.trace(kernel.matrix))
    assert 1.0 < kernel.degrees_of_freedom < LAYERS
    own = np.diag(kernel.matrix)
    np.testing.assert_allclose(kernel.resolution, np.where(own > 0, 1.5 / own, np.inf))


def coverage(strength, count, level=0.9):
    """z of the share of layers within the band, of records whose profiles have the prior's strength."""
    rng = np.random.default_rng(7)
    shares = []
    for _ in range(count):
        truth, y = record(rng)
        low, high = band_of(fitted(y, Smooth(3.0, strength=strength)), "x", level, robust=False)
        shares.append(np.mean((truth > low) & (truth < high)))
    return (np.mean(shares) - level) / (np.std(shares, ddof=1) / np.sqrt(count))


def test_bands_cover_what_they_say():
    assert abs(coverage(STRENGTH, 40)) < 3.0
    assert coverage(STRENGTH / 6.0, 20) < -5.0


def test_layers_at_their_bound_are_those_of_bounded_least_squares():
    rng = np.random.default_rng(5)
    truth = 9.0 * np.sin(np.arange(LAYERS))
    matrix = instrument()
    y = matrix @ np.append(truth, 2.0) + rng.normal(size=SAMPLES)
    smooth = Smooth(2.0, strength=5.0, mean=0.5)
    apart = np.sqrt(3.0) * np.abs(np.subtract.outer(np.arange(LAYERS), np.arange(LAYERS))) / 2.0
    root = np.linalg.cholesky(np.linalg.inv(25.0 * (1.0 + apart) * np.exp(-apart))).T
    rows = np.vstack([matrix, np.column_stack([root, np.zeros(LAYERS)])])
    right = np.concatenate([y, root @ np.full(LAYERS, 0.5)])
    low, high = np.append(np.zeros(LAYERS), -50.0), np.append(np.full(LAYERS, 11.0), 50.0)
    exact = optimize.lsq_linear(rows, right, (low, high), method="bvls", tol=1e-12).x
    assert np.sum(exact[:-1] < 1e-9) >= 2
    fit = fitted(y, smooth, low=0.0)
    assert fit.converged
    assert fit.steps < 8
    np.testing.assert_allclose(fit.values["x"], exact[:-1], atol=5e-3)
    below, above = band_of(fit, "x", 0.95, robust=False)
    assert np.all((below >= 0.0) & (below <= fit.values["x"]) & (fit.values["x"] < above))


# -- what is refused ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scale": 0.0}, "scale = 0"),
        ({"scale": -1.0}, "scale = -1"),
        ({"spacing": 0.0}, "spacing = 0"),
        ({"strength": 0.0}, "strength = 0"),
        ({"strength": np.nan}, "strength = nan"),
        ({"mean": np.inf}, "mean = inf"),
    ],
)
def test_priors_that_are_none(change, message):
    with pytest.raises(ValueError, match=message):
        Smooth(**{"scale": 2.0} | change)


def refused(unknown, message, **more):
    common = {"noise": 1.0, "time": np.arange(9.0), "key": jax.random.key(0), **more}
    with pytest.raises(ValueError, match=message):
        inversion.retrieve(np.zeros((1, 9)), jl.Lidar(), stand(np.ones(4)), [unknown], **common)


def test_unknowns_that_are_no_profile():
    refused(Unknown("ground.height", bounds=(0, 1), prior=Smooth(2.0)), "two values or more along one axis")
    profile = profile_of(4, Smooth(2.0, mean=np.ones(3)))
    refused(profile, "mean has the shape")
    refused(profile_of(4, Smooth(2.0)), "solver", solver=optx.LevenbergMarquardt(rtol=0.1, atol=0.1))
    with pytest.raises(ValueError, match="is no LogNormal, no Smooth"):
        profile_of(4, 3.0)


def test_bounds_need_a_strength():
    common = {"noise": 1.0, "key": jax.random.key(0), "max_orders": 1}
    for call in (
        lambda u: inversion.cramer_rao(jl.Lidar(), stand(np.ones(4)), u, **common),
        lambda u: inversion.profile_likelihood(
            np.zeros((1, 9)), jl.Lidar(), stand(np.ones(4)), u, "h", [0, 1], time=np.arange(9.0), **common
        ),
    ):
        with pytest.raises(ValueError, match="strength = None leaves the Smooth prior's strength to a fit"):
            call([profile_of(4, Smooth(2.0)), Unknown("ground.height", bounds=(0, 1), name="h")])


def test_bands_and_kernels_refuse():
    fit = fitted(np.zeros(SAMPLES), SMOOTH)
    with pytest.raises(ValueError, match="name = 'y'; admissible are 'x', 'b'"):
        band_of(fit, "y", 0.9, robust=False)
    with pytest.raises(ValueError, match="level = 1"):
        band_of(fit, "x", 1.0, robust=False)
    with pytest.raises(ValueError, match="spacing = 0"):
        averaging_kernel_of(fit, "x", 0.0)


# -- stands ------------------------------------------------------------------------------------------------

THICK = 2.0


def stand(density, slope=0.0, ground=0.3, columns=1, below=0, **more):
    """Layers over the ground; `below`: voxels below its middle, and as many above the plants."""
    shape = (columns, 1, len(density) + 2 * below)
    size = (40.0 / columns, 40.0, THICK)
    voxels = jl.VoxelMap.from_lad(np.ones(shape), voxel_size=size, origin=(-20.0, -20.0, -below * THICK))
    sides = "periodic" if columns == 1 else "open"
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.5, 0.4), hotspot=True, sides=sides)
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=ground, slope=slope, aspect=90.0, **more))
    return inversion.put_profile(scene, jnp.asarray(density, float))


def profile_of(layers, prior):
    return Unknown(
        apply=inversion.put_profile, name="plants", bounds=(0.0, 2.0), start=np.full(layers, 0.2), prior=prior
    )


def test_layers_lie_on_the_ground():
    density = np.array([0.4, 0.1, 0.3])
    flat = stand(density, below=2).canopy.voxels
    np.testing.assert_allclose(2.0 * flat.leaf[0, 0], [0, 0, *density, 0, 0], atol=1e-6)
    # 45 degrees, falling to the east; columns are 5 m wide, layers 2 m thick.
    steep = stand(density, slope=45.0, columns=8, below=12).canopy.voxels
    leaf = 2.0 * np.asarray(steep.leaf[:, 0])
    np.testing.assert_allclose(leaf.sum(axis=1), density.sum(), rtol=1e-5)
    middle = (leaf * np.arange(leaf.shape[1])).sum(axis=1) / leaf.sum(axis=1)
    np.testing.assert_allclose(np.diff(middle), -5.0 / THICK, rtol=1e-4)
    # As a derivative, too.
    slope = lambda s: jnp.sum(stand_at(s) * jnp.arange(27.0))  # noqa: E731
    got = jax.grad(slope)(10.0)
    expected = (slope(10.1) - slope(9.9)) / 0.2
    assert float(got) == pytest.approx(float(expected), rel=2e-2)
    scene = stand(density)
    with pytest.raises(ValueError, match="no canopy with leaf"):
        inversion.put_profile(jl.Scene(ground=scene.ground), jnp.ones(2))
    with pytest.raises(ValueError, match="from 0 m to 8 m, but the voxel map reaches from 0 m to 6 m"):
        inversion.put_profile(scene, jnp.ones(4))
    # Below the map, too; empty layers may reach out of it.
    with pytest.raises(ValueError, match=r"from -6\.\d+ m to"):
        stand(density, slope=20.0, columns=8, below=1)
    inversion.put_profile(scene, jnp.array([0.1, 0.2, 0.0, 0.0]))


def stand_at(slope):
    """Voxels of the first column as a function of the slope, some within a transformation."""
    base = stand(np.array([0.4, 0.1, 0.3]), columns=8, below=12)
    moved = dataclasses.replace(base.ground, slope=slope)
    scene = inversion.put_profile(jl.Scene(canopy=base.canopy, ground=moved), jnp.array([0.4, 0.1, 0.3]))
    return scene.canopy.voxels.leaf[0, 0]


SHARP = {"divergence": 1e-3, "altitude": 4e5, "sampling_interval": 0.25}


def test_the_closed_form_is_exact_for_a_sharp_pulse():
    """Of a canopy with a hot spot, single scattering and facets as bright as the ratio says."""
    density = np.array([0.0, 0.1, 0.3, 0.2, 0.05])
    lidar = jl.Lidar(pulse=jl.GaussianPulse(fwhm=0.7), **SHARP)
    wave = jl.simulate(
        lidar, stand(density), key=jax.random.key(0), max_orders=1, window=(-90.0, 20.0), n_rays=16
    )
    height, power = np.asarray(wave.height), np.asarray(wave.reflectance[0])
    given = {"edges": THICK * np.arange(6), "pulse": lidar.pulse, "noise": 1e-6}
    # Spherical leaves scatter back as a Lambertian surface of that reflectance times 2/3 does.
    brightness = 2.0 * float(np.sum(power[height > 1.5])) / (1.0 - np.exp(-THICK * 0.5 * density.sum())) / 2.0
    found = inversion.plant_area_profile(height, power, reflectance_ratio=brightness / 0.3, **given)
    np.testing.assert_allclose(found, density, atol=0.01)
    wrong = inversion.plant_area_profile(height, power, reflectance_ratio=2.0 * brightness / 0.3, **given)
    assert np.max(np.abs(wrong - density)) > 0.05
    several = inversion.plant_area_profile(
        height, np.stack([power, 2.0 * power]), reflectance_ratio=brightness / 0.3, **given
    )
    np.testing.assert_allclose(several, [found, found], atol=1e-3)
    with pytest.raises(ValueError, match="edges"):
        inversion.plant_area_profile(height, power, **given | {"edges": [1.0, 1.0]})


TRUTH = np.array([0.05, 0.2, 0.1, 0.3, 0.35, 0.1])


def stands(n, seed=0):
    """Noisy waveforms of a stand at two wavelengths, its noise, and how to fit them."""
    lidar = jl.Lidar(wavelength=(905.0, 1064.0), pulse=jl.GaussianPulse(6.0), divergence=1e-3, altitude=4e5)
    start = stand(np.full(6, 0.2), ground=np.array([0.3, 0.3]), below=1)
    truth = stand(TRUTH, ground=np.array([0.25, 0.35]), below=1)
    plan = jl.plan(lidar, start, max_orders=1, window=(-100.0, 30.0), n_rays=1)
    wave = jl.simulate(lidar, truth, key=jax.random.key(2), plan=plan)
    sigma = float(np.max(wave.reflectance)) / 100.0
    noise = sigma * np.random.default_rng(seed).normal(size=(n, *wave.reflectance.shape))
    unknowns = [
        Unknown("ground.height", bounds=(-2.0, 2.0), start=0.3, name="height"),
        Unknown("ground.reflectance", bounds=(0.05, 0.9), name="ground"),
        profile_of(6, Smooth(4.0, spacing=THICK)),
    ]
    common = {"noise": sigma, "time": wave.time, "key": jax.random.key(1), "plan": plan}
    return np.asarray(wave.reflectance) + noise, lidar, start, unknowns, common


@NARROW
def test_a_profile_from_two_wavelengths(precision, tmp_path):
    observed, lidar, start, unknowns, common = stands(3)
    fit = inversion.retrieve(observed[0], lidar, start, unknowns, **common)
    assert fit.converged, fit.status
    low, high = fit.band("plants")
    assert np.all((low >= 0.0) & (high <= 2.0))
    z = (np.asarray(fit.values["plants"]) - TRUTH) / np.asarray(fit.stderr["plants"])
    assert np.max(np.abs(z)) < 4.0
    assert 0.02 < float(fit.strength["plants"]) < 2.0
    kernel = fit.averaging_kernel("plants", THICK)
    assert kernel.matrix.shape == (6, 6)
    assert 3.0 < kernel.degrees_of_freedom < 6.0
    assert np.all(kernel.resolution > THICK)
    assert np.all(fit.band("plants", robust=True)[1] >= high - 1e-6)

    path = tmp_path / "fits.sqlite"
    many = inversion.retrieve_many(observed, lidar, start, unknowns, lanes=3, path=path, **common)
    np.testing.assert_allclose(many.values["plants"][0], fit.values["plants"], atol=2e-2)
    assert many.strength["plants"].shape == (3,)
    assert many.band("plants")[0].shape == many.averaging_kernel("plants").resolution.shape == (3, 6)
    again = inversion.retrieve_many(observed, lidar, start, unknowns, lanes=3, path=path, **common)
    np.testing.assert_array_equal(again.averaging, many.averaging)
    np.testing.assert_array_equal(again.strength["plants"], many.strength["plants"])
    other = [*unknowns[:2], profile_of(6, Smooth(5.0, spacing=THICK))]
    with pytest.raises(ValueError, match="what differs: prior of 'plants'"):
        inversion.retrieve_many(observed, lidar, start, other, lanes=3, path=path, **common)
