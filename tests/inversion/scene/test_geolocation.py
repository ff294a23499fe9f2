"""Geolocation: the superposition of narrow beams, its derivatives, shifts and their covariance."""

from typing import NamedTuple

import jax
import numpy as np
import pytest
from scipy.spatial import KDTree

import inversion
import jaxlidar as jl
from inversion.scene import geolocation

SHIFT = np.array([5.0, -3.0])
LIDAR = jl.Lidar(altitude=4e5, divergence=0.05, pulse=jl.GaussianPulse(15.0))
# One standard deviation of the noise, over the peak of a record.
NOISE = 0.05


def ridges():
    """Hills, seen without canopy: nodes are then simulated in a moment."""
    x, y = np.meshgrid(np.arange(-90.0, 91.0, 5.0), np.arange(-90.0, 91.0, 5.0), indexing="ij")
    heights = 4.0 * np.cos(x / 12.0) * np.cos(y / 17.0) + 0.1 * x
    return jl.Scene(ground=jl.Terrain(heights, spacing=5.0, origin=(-90.0, -90.0)))


@pytest.fixture(scope="module")
def case():
    """Return the scene, the nominal survey, and the records at the true places."""
    scene = ridges()
    x, y = np.meshgrid(np.linspace(-40.0, 40.0, 3), np.linspace(-40.0, 40.0, 4))
    nominal = np.column_stack([x.ravel(), y.ravel()])
    waves = jl.simulate_many(
        jl.Survey(LIDAR, nominal + SHIFT), scene, key=jax.random.key(0), max_orders=1, rtol=0.01
    )
    return scene, jl.Survey(LIDAR, nominal), waves


@pytest.fixture(scope="module")
def nodes(case):
    """Return the nodes of the scene, which do not depend on the noise of records."""
    scene, survey, _ = case
    footprint = geolocation._footprint_covariance(survey)
    return geolocation._simulate_nodes(survey, scene, footprint, 12.0, jax.random.key(5), 1, 0.03)


def locate(case, records, monkeypatch, nodes, **changes):
    scene, survey, waves = case
    monkeypatch.setattr(geolocation, "_simulate_nodes", lambda *arguments: nodes)
    noise = NOISE * np.asarray(waves.reflectance)[:, 0].max(axis=1, keepdims=True)
    arguments = {"noise": noise, "key": jax.random.key(1), "search_radius": 12.0} | changes
    height = -0.5 * jl.SPEED_OF_LIGHT * np.asarray(waves.time)
    return inversion.geolocate(records, survey, scene, **({"height": height} | arguments))


@pytest.mark.slow
def test_footprints_are_sums_of_narrow_beams_with_exact_derivatives(case, nodes):
    _, survey, waves = case
    records = geolocation._observed_records(waves, None, 1e-3, survey)
    model = geolocation._SurveyModel(records, nodes, survey.position, 12.0, drift=True, height_error=1.0)
    parameters = np.array([*SHIFT, 0.5, -0.5, 0.2])
    for shot in (model.shots[0], model.shots[-1]):
        _, columns = model.simulated(shot, parameters)
        for k, step in enumerate((1e-4, 1e-4, 1e-4, 1e-4)):
            offset = step * np.eye(5)[k]
            upper, lower = (model.simulated(shot, parameters + s * offset)[0] for s in (1.0, -1.0))
            difference = (upper - lower) / (2.0 * step)
            assert np.abs(difference - columns[k]).max() < 1e-5 * max(np.abs(columns).max(), 1e-6)
        # Derivatives of the height are those of a table of samples, of half its accuracy.
        upper, lower = (model.simulated(shot, parameters + s * 0.1 * np.eye(5)[4])[0] for s in (1.0, -1.0))
        assert np.corrcoef(((upper - lower) / 0.2).ravel(), columns[4].ravel())[0, 1] > 0.999
    for shot, wave in zip(model.shots[::5], np.asarray(waves.reflectance)[::5]):
        direct, _ = model.simulated(shot, np.array([*SHIFT, 0.0, 0.0, 0.0]))
        assert np.abs(direct - wave).max() < 0.03 * wave.max()


@pytest.mark.slow
def test_the_shift_is_found_from_waveforms(case):
    scene, survey, waves = case
    place = inversion.geolocate(
        waves, survey, scene, noise=NOISE * waves.reflectance.max(), key=jax.random.key(1), search_radius=12.0
    )
    assert place.status == "converged"
    assert np.abs(place.shift - SHIFT).max() < 0.1
    assert np.allclose(place.position, survey.position + place.shift)
    assert place.fitted.shape == waves.reflectance.shape


@pytest.mark.slow
def test_standard_errors_hold_over_draws_of_noise(case, nodes, monkeypatch):
    random, (_, _, waves) = np.random.default_rng(0), case
    clean = np.asarray(waves.reflectance)[:, 0]
    z = []
    for _ in range(60):
        noise = NOISE * clean.max(axis=1, keepdims=True) * random.normal(size=clean.shape)
        # Up to a factor each.
        gain = random.uniform(0.5, 2.0, (len(clean), 1))
        records = gain * (clean + noise)
        sigma = gain * NOISE * clean.max(axis=1, keepdims=True)
        place = locate(case, records, monkeypatch, nodes, noise=sigma)
        z.append((place.shift - SHIFT) / np.sqrt(np.diag(place.covariance)))
    z = np.array(z)
    assert 0.88 <= np.mean(np.abs(z) < 2.0) <= 0.99
    # Errors of half the size would not hold.
    assert np.mean(np.abs(2.0 * z) < 2.0) < 0.85


@pytest.mark.slow
def test_drift_and_height_offset_are_found(case, nodes, monkeypatch):
    _, _, waves = case
    clean = np.asarray(waves.reflectance)[:, 0]
    place = locate(case, clean, monkeypatch, nodes, drift=True, height_error=1.0)
    assert np.abs(place.drift).max() < 0.5
    assert abs(place.height_offset) < 0.05
    heights = -0.5 * jl.SPEED_OF_LIGHT * np.asarray(waves.time) - 0.4
    # Noise that leaves no room for the prior of the offset.
    low = locate(case, clean, monkeypatch, nodes, noise=1e-3 * clean.max(), height=heights, height_error=1.0)
    assert low.height_offset == pytest.approx(0.4, abs=0.05)
    assert np.abs(low.shift - SHIFT).max() < 0.3


# -- misfit ------------------------------------------------------------------------------------------------


def layered_nodes():
    """Nodes of a rolling terrain under a canopy of varying height and cover, without a simulation."""
    spacing, sigma = 3.85, 5.5
    steps = spacing * np.arange(-30, 31)
    position = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    height = np.arange(40.0, -15.0, -0.3)
    x, y = position.T
    ground = 3.0 * np.cos(x / 14.0) + 2.0 * np.sin(y / 11.0)
    top = ground + 14.0 + 5.0 * np.sin(x / 9.0) * np.cos(y / 8.0)
    cover = 0.5 + 0.3 * np.cos(x / 10.0 + y / 13.0)
    layers = [np.exp(-0.5 * ((height - z[:, None]) / w) ** 2) for z, w in ((top, 3.0), (ground, 1.0))]
    waveform = np.stack([cover[:, None] * layers[0] / 3.0, (1.0 - cover[:, None]) * layers[1]], axis=1)
    precision = np.eye(2) / (0.5 * sigma**2)
    return geolocation._Nodes(position, waveform[:, :, None], height, precision, 15.0, spacing)


def layered_records(random, nodes, position, misfit, length, noise, ratio=1.0):
    """Return records at shifted places, with noise and a relative misfit correlated over `length` m."""
    height = np.arange(35.0, -12.0, -0.5)
    rows = np.broadcast_to(height, (len(position), height.size))
    blank = geolocation._Records(np.ones((len(position), 1, height.size)), np.ones((1, 1, 1)), rows)
    blank = blank._replace(noise=np.ones_like(blank.power))
    model = geolocation._SurveyModel(
        blank, nodes, position, 12.0, drift=False, height_error=0.0, ratio_error=1.0
    )
    parameters = np.array([*SHIFT, np.log(ratio)])
    clean = np.array([model.simulated(shot, parameters)[0][0] for shot in model.shots])
    correlation = np.exp(-0.5 * ((height[:, None] - height) / length) ** 2)
    process = random.multivariate_normal(np.zeros(height.size), correlation, len(position))
    sigma = noise * clean.max(axis=1, keepdims=True)
    return clean * (1.0 + misfit * process) + sigma * random.normal(size=clean.shape), sigma, height


def locate_layered(
    random, monkeypatch, nodes, count, *, misfit, length=2.0, noise=0.02, ratio=1.0, **changes
):
    position = random.uniform(-60.0, 60.0, (count, 2))
    records, sigma, height = layered_records(random, nodes, position, misfit, length, noise, ratio)
    monkeypatch.setattr(geolocation, "_simulate_nodes", lambda *arguments: nodes)
    arguments = {"noise": sigma, "height": height, "key": jax.random.key(0), "search_radius": 12.0}
    return inversion.geolocate(records, jl.Survey(LIDAR, position), jl.Scene(), **(arguments | changes))


def test_misfit_and_ratio_of_reflectances_are_found(monkeypatch):
    random, nodes = np.random.default_rng(0), layered_nodes()
    place = locate_layered(random, monkeypatch, nodes, 24, misfit=0.15, ratio=1.4)
    assert place.status == "converged"
    assert place.misfit == pytest.approx(0.15, rel=0.3)
    assert place.misfit_length == pytest.approx(2.0, rel=0.5)
    assert place.reflectance_ratio == pytest.approx(1.4, rel=0.1)
    assert np.all(np.abs(place.shift - SHIFT) < 3.0 * np.sqrt(np.diag(place.covariance)))
    # Chi-squared is that of the noise alone.
    assert place.chi_squared > 1.5
    clean = locate_layered(random, monkeypatch, nodes, 12, misfit=0.0)
    assert clean.misfit < 0.03
    assert clean.chi_squared == pytest.approx(1.0, abs=0.1)


def test_a_ratio_that_is_not_fitted_stays_as_in_the_scene(monkeypatch):
    random, nodes = np.random.default_rng(1), layered_nodes()
    place = locate_layered(random, monkeypatch, nodes, 8, misfit=0.1, ratio=1.4, ratio_error=0.0)
    assert place.reflectance_ratio == 1.0
    with pytest.raises(ValueError, match="ratio_error"):
        locate_layered(random, monkeypatch, nodes, 8, misfit=0.1, ratio_error=-1.0)


def test_whitened_products_are_those_with_the_inverse_covariance(monkeypatch):
    """By the Gaussian correlation itself, of which the sum of Gaussians is within 1.4 %."""
    random, nodes = np.random.default_rng(2), layered_nodes()
    position = random.uniform(-60.0, 60.0, (2, 2))
    power, sigma, height = layered_records(random, nodes, position, 0.2, 2.0, 0.05)
    rows, noise = np.broadcast_to(height, power.shape), np.broadcast_to(sigma, power.shape)
    records = geolocation._Records(power[:, None], noise[:, None], rows)
    model = geolocation._SurveyModel(records, nodes, position, 12.0, drift=False, height_error=0.0)
    monkeypatch.setattr(geolocation, "_MISFIT_SQUARES", np.array([0.04]))
    monkeypatch.setattr(geolocation, "_MISFIT_LENGTHS", np.array([2.0]))
    misfit = model.misfit(SHIFT, np.array([1.0, 1.3]))
    for shot, scale, whitener in zip(model.shots, (1.0, 1.3), misfit.whiteners):
        weighted = (scale * model.simulated(shot, SHIFT)[0] * shot.inverse_noise)[0]
        correlation = np.exp(-0.5 * ((height[:, None] - height) / 2.0) ** 2)
        covariance = np.eye(height.size) + 0.04 * np.outer(weighted, weighted) * correlation
        columns = random.normal(size=(3, height.size))
        products = whitener(columns) @ whitener(columns).T
        assert np.allclose(products, columns @ np.linalg.solve(covariance, columns.T), atol=0.5, rtol=0.02)
        plain = columns @ columns.T
        assert not np.allclose(products, plain, atol=0.5, rtol=0.02)


def test_the_jackknife_is_that_of_fits_without_a_record():
    """A linear fit, of which the jackknife is exact."""
    random = np.random.default_rng(3)
    design = random.normal(size=(9, 20, 2)) * random.uniform(0.2, 2.0, (9, 1, 1))
    residuals = random.normal(size=(9, 20)) + 1.5 * random.normal(size=(9, 1))

    def solution(shots):
        return np.linalg.lstsq(design[shots].reshape(-1, 2), residuals[shots].ravel())[0]

    every = np.arange(9)
    changes = np.array([solution(every[every != shot]) for shot in every]) - solution(every)
    left = residuals - design @ solution(every)
    information = np.einsum("ski,skj->sij", design, design)
    fit = geolocation._Fit(
        0.0,
        information.sum(axis=0),
        np.zeros(2),
        np.einsum("ski,sk->si", design, left),
        information,
        np.ones(9),
        0.0,
    )
    expected = 8.0 / 9.0 * changes.T @ changes
    # Here the scatter is larger than by the noise in all directions, so that nothing is raised.
    assert np.all(np.linalg.eigvals(expected @ fit.information) > 1.0)
    assert np.allclose(geolocation._jackknife_covariance(fit), expected)
    # Residuals that happen to vanish leave the covariance by the information.
    silent = fit._replace(scores=0.0 * fit.scores)
    assert np.allclose(geolocation._jackknife_covariance(silent), np.linalg.inv(fit.information))


@pytest.mark.slow
def test_standard_errors_hold_over_draws_of_misfit(monkeypatch):
    random, nodes, z, z_of_noise = np.random.default_rng(4), layered_nodes(), [], []
    for _ in range(40):
        state = random.bit_generator.state
        place = locate_layered(random, monkeypatch, nodes, 16, misfit=0.2)
        z.append((place.shift - SHIFT) / np.sqrt(np.diag(place.covariance)))
        # The same records, of which all that differs from the scene is taken for noise.
        random.bit_generator.state = state
        with monkeypatch.context() as patch:
            patch.setattr(geolocation, "_MISFIT_SQUARES", np.zeros(1))
            patch.setattr(geolocation, "_jackknife_covariance", lambda fit: np.linalg.inv(fit.information))
            noisy = locate_layered(random, patch, nodes, 16, misfit=0.2)
        z_of_noise.append((noisy.shift - SHIFT) / np.sqrt(np.diag(noisy.covariance)))
    z = np.abs(z)
    # The larger one of two covariances is on the safe side.
    assert np.mean(z < 2.0) > 0.9
    # Errors of half the size would not hold.
    assert np.mean(2.0 * z < 2.0) < 0.85
    assert np.mean(np.abs(z_of_noise) < 2.0) < 0.7


# -- recorded clouds ---------------------------------------------------------------------------------------

# Standard deviations of the GEDI simulator's footprint and pulse, m.
FOOTPRINT, PULSE = 5.5, 0.95485
# Signal-to-noise ratio: the peak of a record over one standard deviation of the noise.
SIGNAL_TO_NOISE = 20.0


class CloudCase(NamedTuple):
    """Waveforms that the GEDI simulator made at shifted places over a cloud, and nodes over its canopy."""

    nodes: geolocation._Nodes
    lidar: jl.Lidar
    nominal: np.ndarray
    shift: np.ndarray
    waveforms: np.ndarray
    height: np.ndarray

    def locate(self, random, monkeypatch, shots):
        """Locate some of the records, with noise; return the error, m, and the standard errors."""
        clean = self.waveforms[shots]
        sigma = clean.max(axis=1, keepdims=True) / SIGNAL_TO_NOISE
        records = clean + sigma * random.normal(size=clean.shape)
        monkeypatch.setattr(geolocation, "_simulate_nodes", lambda *arguments: self.nodes)
        place = inversion.geolocate(
            records,
            jl.Survey(self.lidar, self.nominal[shots]),
            jl.Scene(),
            noise=sigma,
            height=self.height[shots],
            key=jax.random.key(0),
        )
        assert place.status == "converged"
        return place.shift - self.shift, np.sqrt(np.diag(place.covariance))


_cloud_cases: dict[str, CloudCase] = {}


@pytest.fixture(params=["megaplot", "topography"])
def cloud_case(request, shared):
    """Return the case of a cloud; its nodes are simulated once."""
    name = request.param
    if name not in _cloud_cases:
        points = jl.io.read_las(shared / "als" / f"{name}.laz")
        stored = np.load(shared / "als" / "gedi_simulator.npz")
        nominal, true, first, last, count = (
            stored[f"{name}_shift_given/{field}"]
            for field in ("nominal", "true", "z_first", "z_last", "count")
        )
        # The simulator makes no waveform where there are no returns, as on a lake.
        distance, _ = KDTree(points.position[:, :2]).query(true)
        nominal, true = nominal[distance < 15.0], true[distance < 15.0]
        assert len(nominal) == len(count)
        fwhm = PULSE * np.sqrt(8.0 * np.log(2.0)) / (0.5 * jl.SPEED_OF_LIGHT)
        lidar = jl.Lidar(altitude=4e5, divergence=4e3 * FOOTPRINT / 4e5, pulse=jl.GaussianPulse(fwhm))
        cloud = jl.canopy_from_points(points)
        # Leaves as bright as the ground, as the simulator has it: 2/3 of 0.45 is 0.3.
        canopy = jl.Canopy(cloud.voxels, leaf=jl.LeafOptics(0.45, 0.45))
        survey = jl.Survey(lidar, nominal)
        nodes = geolocation._simulate_nodes(
            survey,
            jl.Scene(canopy=canopy, ground=cloud.terrain),
            geolocation._footprint_covariance(survey),
            20.0,
            jax.random.key(0),
            1,
            0.1,
        )
        height = np.linspace(first, last, count.shape[1], axis=1).astype(float)
        shift = (true - nominal).mean(axis=0)
        _cloud_cases[name] = CloudCase(nodes, lidar, nominal, shift, count.astype(float), height)
    return _cloud_cases[name]


@pytest.mark.slow
def test_all_footprints_over_a_recorded_cloud_are_within_half_a_metre(cloud_case, monkeypatch):
    """Each draw of noise within its standard errors; within 0.5 m the mean of all, which noise moves less."""
    random, shots, errors = np.random.default_rng(0), np.arange(len(cloud_case.nominal)), []
    for _ in range(8):
        error, stderr = cloud_case.locate(random, monkeypatch, shots)
        assert np.all(np.abs(error) < 3.0 * stderr)
        errors.append(error)
    assert np.abs(np.mean(errors, axis=0)).max() < 0.5


@pytest.mark.slow
def test_standard_errors_hold_over_any_eight_footprints(cloud_case, monkeypatch):
    """Over subsets and draws of noise, as what the cloud does not explain is the same in every draw."""
    random, errors, z = np.random.default_rng(1), [], []
    for _ in range(40):
        shots = np.sort(random.choice(len(cloud_case.nominal), 8, replace=False))
        error, stderr = cloud_case.locate(random, monkeypatch, shots)
        errors.append(np.abs(error))
        z.append(np.abs(error) / stderr)
    assert np.quantile(np.max(errors, axis=1), 0.9) < 2.0
    assert 0.86 <= np.mean(np.array(z) < 2.0) <= 0.99
    # Errors of half the size would not hold.
    assert np.mean(2.0 * np.array(z) < 2.0) < 0.8


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"noise": 0.0}, "noise = 0"),
        ({"height": None}, "height = None"),
        ({"search_radius": -1.0}, "search_radius"),
        ({"lidar": jl.Lidar(profile="top-hat")}, "profile"),
        ({"lidar": jl.Lidar(divergence=0.0)}, "divergence"),
        ({"zenith": [0.0, 5.0, 0.0]}, "zenith from 0 to 5"),
        ({"altitude": [4e5, 4e5, 5e5]}, "at several altitudes"),
        ({"records": np.ones((2, 9))}, "2 shots and survey 3"),
        ({"position": [(500.0, 0.0)] * 3}, "off the terrain"),
    ],
)
def test_inadmissible_arguments_are_refused(changes, message):
    arguments = {"noise": 1.0, "key": jax.random.key(0), "height": np.arange(9.0)} | {
        k: v for k, v in changes.items() if k in ("noise", "height", "search_radius")
    }
    position = changes.get("position", np.zeros((3, 2)))
    place = {name: changes.get(name) for name in ("zenith", "altitude")}
    survey = jl.Survey(changes.get("lidar", LIDAR), position, **place)
    records = changes.get("records", np.ones((3, 9)))
    with pytest.raises(ValueError, match=message):
        inversion.geolocate(records, survey, ridges(), **arguments)
