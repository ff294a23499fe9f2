"""Energy budgets against closed forms and discrete ordinates; `test_validation.py` has forests.

A plate (R, T) over ground of reflectance r returns R + T^2 r / (1 - R r). Slabs are lit by parallel light
over one period of a canopy without sides. Fractions are compared within four standard errors.
"""

import csv
from typing import final

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from tests.helpers import slab, slow_unless

KEY = jax.random.key(3)
PLATE = jl.Plate(height=2.0, reflectance=(0.5, 0.1), transmittance=(0.3, 0.6))
LIDAR = jl.Lidar(wavelength=(650.0, 850.0))


def total(budget):
    return sum([*budget.absorbed.values(), budget.returned, budget.below, budget.unfollowed])


def close(value, exact, stderr, sigmas=4.0):
    return bool(np.all(np.abs(np.asarray(value) - exact) < sigmas * np.asarray(stderr) + 1e-6))


def test_black_leaves_let_through_what_beer_and_lambert_say():
    """exp(-tau) of the light reaches the ground, to a thousandth: flights are drawn from that law."""
    black = jl.LeafOptics(reflectance=0.0, transmittance=0.0)
    canopy = jl.Canopy(slab(1.0), leaf=black, sides="periodic")
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.0))
    budget = jl.energy_budget(jl.Lidar(), scene, key=KEY, rtol=3e-4)
    ground, stderr = budget.absorbed["ground"], budget.stderr["ground"]
    assert close(ground, np.exp(-1.0), stderr)
    # Planted: optical depths 1.005 too long.
    assert not close(ground, np.exp(-1.0 / 1.005), stderr)


@pytest.mark.parametrize("transmission", slow_unless(["diffuse"], ["straight", "diffuse"]))
def test_a_plate_over_ground(transmission):
    plate = jl.Plate(2.0, PLATE.reflectance, PLATE.transmittance, transmission=transmission)
    scene = jl.Scene(plates=(plate,), ground=jl.Ground(reflectance=(0.9, 0.2)))
    budget = jl.energy_budget(LIDAR, scene, key=KEY, rtol=0.005)
    R, T, r = (np.array(a) for a in ((0.5, 0.1), (0.3, 0.6), (0.9, 0.2)))
    arrived = T / (1 - R * r)
    exact = {
        "returned": R + T * r * arrived,
        "transmitted": arrived,
        "ground": (1 - r) * arrived,
        "plate": (1 - R - T) * (1 + r * arrived),
    }
    estimates = {"returned": budget.returned, "transmitted": budget.transmitted, **budget.absorbed}
    for name, value in exact.items():
        assert close(estimates[name], value, budget.stderr[name]), name
    # The same test rejects light that meets the plate once only.
    assert not close(budget.transmitted, T, budget.stderr["transmitted"])
    np.testing.assert_allclose(total(budget), 1.0, atol=0.01)


def test_absorption_is_split_between_two_plates():
    """Black sheets that transmit: the upper one absorbs 1 - T1 of all, the lower 1 - T2 of the rest."""
    plates = (jl.Plate(1.0, 0.0, 0.5), jl.Plate(3.0, 0.0, 0.2))
    budget = jl.energy_budget(jl.Lidar(), jl.Scene(plates=plates), key=KEY, rtol=0.005)
    assert close(budget.absorbed["plate 2"], 0.8, budget.stderr["plate 2"])
    assert close(budget.absorbed["plate 1"], 0.2 * 0.5, budget.stderr["plate 1"])
    assert close(budget.below, 0.1, budget.stderr["below"])


@pytest.mark.slow
def test_albedo_one_returns_everything():
    canopy = jl.Canopy(slab(2.0), leaf=jl.Isotropic(albedo=1.0), sides="periodic", hotspot=False)
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=1.0))
    budget = jl.energy_budget(jl.Lidar(), scene, key=KEY, rtol=0.02, illumination="parallel")
    assert float(budget.unfollowed[0]) < 1e-3
    np.testing.assert_allclose(float(budget.returned[0]), 1.0, atol=0.06)
    assert float(budget.absorbed["leaf"][0]) == 0.0


@pytest.mark.parametrize("row", slow_unless([1], range(5)))
def test_slabs_against_discrete_ordinates(shared, row):
    with (shared / "reference" / "slabs_isotropic.csv").open() as file:
        row_values = {name: float(value) for name, value in list(csv.DictReader(file))[row].items()}
    leaf = jl.Isotropic(albedo=row_values["omega"])
    scene = jl.Scene(
        canopy=jl.Canopy(slab(row_values["tau"]), leaf=leaf, sides="periodic", hotspot=False),
        ground=jl.Ground(reflectance=row_values["rho_ground"]),
    )
    budget = jl.energy_budget(jl.Lidar(), scene, key=KEY, rtol=0.001, illumination="parallel")
    exact = {
        "returned": row_values["plane_albedo"],
        "transmitted": row_values["Fdown_ground"],
        "leaf": row_values["absorbed_medium"],
        "ground": row_values["absorbed_ground"],
    }
    estimates = {"returned": budget.returned, "transmitted": budget.transmitted, **budget.absorbed}
    for name, value in exact.items():
        assert close(estimates[name], value, budget.stderr[name]), name


@pytest.mark.slow
def test_a_budget_agrees_with_that_of_a_waveform():
    voxels = jl.VoxelMap.from_lad(np.full((6, 6, 8), 0.6), voxel_size=0.5, origin=(-1.5, -1.5, 2.0))
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(reflectance=0.2, transmittance=0.1), hotspot=False)
    scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.2))
    budget = jl.energy_budget(jl.Lidar(divergence=1.0), scene, key=KEY, rtol=0.002)
    wave = jl.simulate(
        jl.Lidar(divergence=1.0), scene, key=KEY, n_photons=65536, max_orders=6, window=(-60.0, 400.0)
    )
    for material in ("leaf", "ground"):
        difference = float(wave.energy_budget[f"absorbed by {material}"][0] - budget.absorbed[material][0])
        assert abs(difference) < 5 * float(budget.stderr[material][0]) + 2e-3


BAD = [
    ({"rtol": 0.0}, r"rtol = 0 is outside the admissible range \(0, 1\)"),
    ({"illumination": "sun"}, "illumination = 'sun' is none of 'beam', 'parallel'"),
    ({"illumination": "parallel"}, "that is admissible where the canopy has periodic"),
    ({"max_orders": 0}, "max_orders = 0 is outside"),
]


@pytest.mark.parametrize(("arguments", "message"), BAD)
def test_bad_input(arguments, message):
    with pytest.raises(ValueError, match=message):
        jl.energy_budget(jl.Lidar(), jl.Scene(plates=(PLATE,)), key=KEY, **arguments)


def test_a_jax_transformation_is_refused_with_its_cause():
    def returned(reflectance):
        scene = jl.Scene(ground=jl.Ground(reflectance=reflectance))
        return jl.energy_budget(jl.Lidar(), scene, key=KEY).returned[0]

    with pytest.raises(TypeError, match=r"cannot run inside a JAX transformation .*Waveform\.energy_budget"):
        jax.grad(returned)(0.3)


def test_an_interrupt_keeps_finished_batches():
    scene = jl.Scene(ground=jl.Ground(reflectance=0.4), plates=(PLATE,))
    messages = []

    def interrupt(progress):
        messages.append(str(progress))
        raise KeyboardInterrupt

    budget = jl.energy_budget(LIDAR, scene, key=KEY, rtol=1e-5, progress=interrupt)
    assert budget.info["stopped"] == "interrupted"
    assert budget.info["batches"] == 8
    assert messages[0].endswith("(aim 1e-05)")
    np.testing.assert_allclose(total(budget), 1.0, atol=0.01)


@final
class HalfLambertian(jl.AbstractLaw):
    """A Lambertian law that reflects half of its reflectance, from every direction."""

    def intensity_factor(self, incident, normal, view, half_angle):
        return 0.5 * jl.Lambertian().intensity_factor(incident, normal, view, half_angle)

    def albedo(self, incident, normal):
        return 0.5 * jnp.ones_like(incident[0])

    def sample(self, incident, normal, u, v):
        return jl.Lambertian().sample(incident, normal, u, v)

    def density(self, incident, normal, out):
        return jl.Lambertian().density(incident, normal, out)

    def largest_intensity_factor(self, half_angle):
        return 0.5


@pytest.mark.parametrize("transmission", slow_unless(["straight"], ["straight", "diffuse"]))
def test_a_law_that_absorbs(transmission):
    """A plate of R = 0.5, T = 0.3 and a law of albedo a = 1/2 absorbs 1 - R a - T, however light goes on."""
    plate = jl.Plate(2.0, 0.5, 0.3, transmission=transmission, law=HalfLambertian())
    budget = jl.energy_budget(jl.Lidar(), jl.Scene(plates=(plate,)), key=KEY, rtol=0.01)
    exact = {"returned": 0.25, "below": 0.3, "plate": 0.45}
    estimates = {"returned": budget.returned, "below": budget.below, **budget.absorbed}
    for name, value in exact.items():
        assert close(estimates[name], value, budget.stderr[name]), name
    np.testing.assert_allclose(total(budget), 1.0, atol=0.01)
