"""Design of instruments: costs against `cramer_rao`, minima against brute force, inadmissible arguments."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import inversion
import jaxlidar as jl
from inversion import Unknown

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
        bound = inversion.cramer_rao(lidar, scene, UNKNOWNS, noise=NOISE, key=jax.random.key(0), plan=plan)
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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"free": ("divergence",)}, "admissible are 'wavelength'"),
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
