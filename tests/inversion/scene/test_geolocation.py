"""Geolocation: the superposition of narrow beams, its derivatives, shifts and their covariance."""

import jax
import numpy as np
import pytest

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
