"""Design of instruments: costs against `cramer_rao`, minima against brute force, inadmissible arguments."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from inversion import Unknown
from inversion.fit.design_trace import DivergenceNodes
from tests.helpers import ask

LIDAR = jl.Lidar(wavelength=680.0, altitude=4e5, divergence=0.01, pulse=jl.GaussianPulse(fwhm=8.0))
UNKNOWNS = [
    Unknown("canopy.leaf.Cab", bounds=(5.0, 100.0), name="Cab"),
    Unknown("ground.height", bounds=(-2.0, 2.0), name="height", prior=(0.0, 0.5)),
    Unknown("ground.reflectance", bounds=(0.0, 0.5), name="soil", prior=(0.2, 0.05)),
]
FAST = {"max_orders": 1, "n_rays": 8}
LIMITS = {"wavelength": (500.0, 800.0), "pulse.fwhm": (3.0, 12.0)}
NOISE = 2e-5


def stand(Cab=40.0, density=0.3):
    voxels = jl.VoxelMap.from_lad(
        np.full((1, 1, 4), density), voxel_size=(20.0, 20.0, 1.0), origin=(-10.0, -10.0, 1.0)
    )
    canopy = jl.Canopy(voxels, leaf=jl.Prospect(Cab=Cab), sides="periodic")
    return jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.2))


@pytest.fixture(scope="module")
def best():
    scenes = [stand(), stand(Cab=60.0, density=0.2)]
    return inversion.design(LIDAR, scenes, UNKNOWNS, limits=LIMITS, noise=NOISE, starts=6, **FAST)


def reference_cost(wavelength, fwhm, scenes, plan_window=(-120.0, 60.0)):
    """Return the mean over scenes of the relative variances, by `cramer_rao`."""
    lidar = jl.Lidar(wavelength=wavelength, altitude=4e5, divergence=0.01, pulse=jl.GaussianPulse(fwhm=fwhm))
    widths = {u.name: float(u.bounds[1] - u.bounds[0]) for u in UNKNOWNS}
    costs = []
    for scene in scenes:
        plan = jl.plan(lidar, scene, window=plan_window, **FAST)
        bound = ask(
            inversion.cramer_rao, None, lidar, scene, UNKNOWNS, noise=NOISE, key=jax.random.key(0), plan=plan
        )
        costs.append(sum((float(bound.stderr[name]) / width) ** 2 for name, width in widths.items()))
    return np.mean(costs)


@pytest.mark.slow
def test_costs_are_those_of_cramer_rao(best):
    scenes = [stand(), stand(Cab=60.0, density=0.2)]
    assert best.initial_cost == pytest.approx(reference_cost(680.0, 8.0, scenes), rel=0.02)
    at_best = reference_cost(best.values["wavelength"], float(best.values["pulse.fwhm"]), scenes)
    assert best.cost == pytest.approx(at_best, rel=0.02)
    assert best.converged
    assert [bound.labels for bound in best.bounds] == [("Cab", "height", "soil")] * 2


@pytest.mark.slow
def test_the_minimum_is_that_of_brute_force(best):
    scenes = [stand(), stand(Cab=60.0, density=0.2)]
    wavelengths = np.linspace(510.0, 790.0, 15)
    costs = [reference_cost(wavelength, 3.0, scenes) for wavelength in wavelengths]
    # The gradient finds a minimum between the points of the grid, no worse than the best of these.
    assert best.cost < 1.02 * min(costs)
    assert abs(float(best.values["wavelength"][0]) - wavelengths[np.argmin(costs)]) < 20.0
    # Wavelengths matter, and so do pulses: the shortest is best.
    assert max(costs) > 3 * min(costs)
    assert float(best.values["pulse.fwhm"]) == pytest.approx(3.0, abs=0.1)
    assert reference_cost(wavelengths[np.argmin(costs)], 12.0, scenes) > min(costs)


@pytest.mark.slow
def test_costs_and_noise_are_functions_of_your_own():
    def noise(lidar, reflectance):
        # Background noise in energy: its part of the apparent reflectance falls with the energy sent.
        return NOISE * (1e-3 / lidar.energy) * jnp.ones_like(reflectance)

    best = inversion.design(
        LIDAR,
        stand(),
        UNKNOWNS,
        free=("energy",),
        limits={"energy": (5e-4, 4e-3)},
        noise=noise,
        cost=lambda bound: bound.stderr["height"] ** 2,
        starts=1,
        **FAST,
    )
    assert float(best.lidar.energy) == pytest.approx(4e-3, rel=1e-3)
    assert best.cost < best.initial_cost
    assert best.cost == pytest.approx(float(best.bounds[0].stderr["height"]) ** 2, rel=1e-3)


SLOPE = [
    Unknown("ground.height", bounds=(-2.0, 2.0), name="height"),
    Unknown("ground.slope", bounds=(0.0, 40.0), name="slope"),
    Unknown("ground.reflectance", bounds=(0.0, 1.0), name="soil", prior=(0.3, 0.05)),
]


def bare_ground_cost(unknowns, scene, window, noise, **lidar_options):
    """Return the relative variances of bare ground by `cramer_rao`."""
    lidar = jl.Lidar(altitude=4e5, pulse=jl.GaussianPulse(fwhm=6.0), **lidar_options)
    plan = jl.plan(lidar, scene, window=window)
    bound = ask(
        inversion.cramer_rao, None, lidar, scene, unknowns, noise=noise, key=jax.random.key(0), plan=plan
    )
    widths = {u.name: float(u.bounds[1] - u.bounds[0]) for u in unknowns}
    return sum((float(bound.stderr[name]) / width) ** 2 for name, width in widths.items())


@pytest.mark.slow
def test_the_best_divergence_is_that_of_brute_force():
    # A wide footprint on a slope has a wide echo, from which the slope is known, and the height less.
    scene = jl.Scene(ground=jl.Ground(slope=15.0, reflectance=0.3))
    lidar = jl.Lidar(altitude=4e5, divergence=0.05, pulse=jl.GaussianPulse(fwhm=6.0))
    best = inversion.design(
        lidar,
        scene,
        SLOPE,
        free=("divergence",),
        limits={"divergence": (0.005, 0.08)},
        noise=3e-4,
        starts=2,
    )

    def cost_at(divergence):
        return bare_ground_cost(SLOPE, scene, (-160.0, 160.0), 3e-4, divergence=divergence)

    divergences = np.geomspace(0.005, 0.08, 13)
    costs = [cost_at(divergence) for divergence in divergences]
    divergence, lowest = float(best.values["divergence"]), int(np.argmin(costs))
    assert divergences[lowest - 1] < divergence < divergences[lowest + 1]
    assert best.cost < 1.002 * min(costs)
    assert best.cost == pytest.approx(cost_at(divergence), rel=1e-3)
    assert best.initial_cost == pytest.approx(cost_at(0.05), rel=1e-3)
    # Narrower and wider footprints tell much less, so that the grid would show a wrong minimum.
    assert costs[0] > 10 * min(costs)
    assert costs[-1] > 2 * min(costs)


@pytest.mark.slow
def test_the_best_sampling_interval_is_that_of_brute_force():
    unknowns = [SLOPE[0], SLOPE[2]]
    # Several heights: for one of them, long samples are best where the echo lies astride two.
    scenes = [jl.Scene(ground=jl.Ground(height=z, reflectance=0.3)) for z in (-0.4, -0.2, 0.0, 0.2, 0.4)]
    lidar = jl.Lidar(altitude=4e5, divergence=0.01, sampling_interval=2.0, pulse=jl.GaussianPulse(fwhm=6.0))
    options = {"free": ("sampling_interval",), "limits": {"sampling_interval": (0.5, 9.0)}, "starts": 3}
    start = min(jl.plan(lidar, scene).sample_start for scene in scenes)

    def cost_at(interval, noise):
        sampling = {"divergence": 0.01, "sampling_interval": interval}
        window = (start, start + 64.0)
        return np.mean([bare_ground_cost(unknowns, scene, window, noise, **sampling) for scene in scenes])

    # Of noise that is the same in all samples, long samples have less; too long ones do not tell the height.
    best = inversion.design(lidar, scenes, unknowns, noise=0.01, **options)
    intervals = np.arange(1.0, 9.1, 1.0)
    costs = [cost_at(interval, 0.01) for interval in intervals]
    interval, lowest = float(best.values["sampling_interval"]), int(np.argmin(costs))
    assert intervals[lowest - 1] < interval < intervals[lowest + 1]
    assert best.cost < 1.002 * min(costs)
    assert best.cost == pytest.approx(cost_at(interval, 0.01), rel=2e-3)
    assert costs[0] > 3 * min(costs)
    assert costs[-1] > 1.5 * min(costs)

    # White noise, as by default: short samples lose nothing.
    best = inversion.design(lidar, scenes, unknowns, **options)
    assert float(best.values["sampling_interval"]) == pytest.approx(0.5, rel=1e-3)
    peaks = [jnp.max(jl.simulate(lidar, s, key=jax.random.key(0)).reflectance) for s in scenes]
    assert best.cost == pytest.approx(
        cost_at(0.5, 0.01 * float(np.mean(peaks)) * np.sqrt(0.5 / 2.0)), rel=2e-2
    )
    assert best.cost < 0.99 * best.initial_cost


def test_divergences_are_interpolated_by_a_polynomial_of_the_logarithm():
    nodes = DivergenceNodes(0.1, 1.6, 5)
    np.testing.assert_allclose(nodes.divergences[[0, 2, 4]], [0.1, 0.4, 1.6], rtol=1e-6)
    np.testing.assert_allclose(nodes.refined.divergences[::2], nodes.divergences)
    values = np.log(nodes.divergences) ** 4

    def interpolated(divergence):
        return jnp.sum(nodes.weights(divergence) * values)

    for divergence in (0.1, 0.23, 1.6):
        value, slope = jax.value_and_grad(interpolated)(divergence)
        assert float(value) == pytest.approx(np.log(divergence) ** 4, rel=1e-4, abs=1e-5)
        assert float(slope) == pytest.approx(4 * np.log(divergence) ** 3 / divergence, rel=1e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"free": ("zenith",)}, "admissible are 'wavelength'"),
        (
            {"free": ("divergence",), "limits": {"divergence": (0.0, 1.0)}},
            "lower of limits of divergence = 0",
        ),
        ({"free": ("sampling_interval",), "noise": np.full((1, 50), 0.1)}, "does not broadcast"),
        ({"free": "wavelength"}, "no sequence"),
        ({"free": ("wavelength",), "limits": {"pulse.fwhm": (1.0, 2.0)}}, "which free does not have"),
        ({"free": ("wavelength",), "limits": {"wavelength": (700.0, 800.0)}}, "in its limits"),
        ({"noise": 0.0}, "noise = 0"),
        ({"starts": 0}, "starts"),
    ],
)
def test_inadmissible_arguments_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        inversion.design(
            LIDAR, jl.Scene(ground=jl.Ground()), [Unknown("ground.height", bounds=(-1, 1))], **options
        )
