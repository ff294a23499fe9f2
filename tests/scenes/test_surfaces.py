"""Surfaces of the user: a disc, written as a user would, against closed forms.

Layout: a horizontal disc of radius a on the axis of a top-hat beam of radius b > a, over ground of
reflectance 1. With f = a^2 / b^2, first order returns R f from the disc and (1 - f) + f T^2 from the ground.
"""

from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from jaxtyping import Array, Float

import jaxlidar as jl
from jaxlidar.extend import Vec, as_array, as_scalar
from tests.helpers import SINGLE_SAMPLE, agrees, batch_mean, single_sample_lidar, slow_unless


@final
class DiscShape(jl.AbstractShape):
    """A horizontal disc."""

    centre: Float[Array, "3"]
    radius: Float[Array, ""]

    @property
    def lights_itself(self):
        return False

    def moved(self, by):
        return DiscShape(self.centre + by, self.radius)

    def distance(self, x: Vec, w: Vec):
        up = jnp.asarray([0.0, 0.0, 1.0])
        s = jl.Plane(up, self.centre).distance(x, w)
        return jnp.where(self.squared_radius(x, w, s) < self.radius**2, s, 1e30)

    def squared_radius(self, x: Vec, w: Vec, s: Array):
        return (x[0] + s * w[0] - self.centre[0]) ** 2 + (x[1] + s * w[1] - self.centre[1]) ** 2

    def outline(self, x: Vec, w: Vec):
        s = (self.centre[2] - x[2]) / w[2]
        # To first order the distance from the rim, and smooth at the centre.
        return (self.squared_radius(x, w, s) - self.radius**2) / (2.0 * self.radius)

    def tangent(self, x: Vec):
        zero = jnp.zeros_like(self.radius)
        return (zero, zero, zero + 1.0), self.centre[2]

    def crossing(self, points, directions):
        height = float(self.centre[2]) - points[:, 2]
        return height / directions[:, 2], directions[:, 2]


@final
class Disc(jl.AbstractSheet):
    """A horizontal disc that reflects and transmits."""

    height: Float[Array, ""] = eqx.field(converter=as_scalar)
    radius: Float[Array, ""] = eqx.field(converter=as_scalar)
    reflectance: Array = eqx.field(converter=as_array)
    transmittance: Array = eqx.field(converter=as_array, default=0.0)
    coverage: Float[Array, ""] = eqx.field(converter=as_scalar, default=1.0)
    transmission: str = eqx.field(static=True, default="straight")
    law: jl.AbstractLaw = jl.Lambertian()

    @property
    def name(self):
        return "disc"

    @property
    def shape(self):
        zero = jnp.zeros_like(self.height)
        return DiscShape(jnp.stack([zero, zero, self.height]), self.radius)


# The footprint has a radius of 10 m.
LIDAR = single_sample_lidar(profile="top-hat", divergence=0.05)


def sums(wave):
    return {name: wave.components[name].sum() for name in ("disc", "ground", "higher")}


def scene(ground, **disc):
    return jl.Scene(plates=(Disc(5.0, 4.0, **disc),), ground=jl.Ground(reflectance=ground))


@pytest.mark.parametrize(
    ("reflectance", "transmittance"), slow_unless([(0.5, 0.4)], [(0.6, 0.0), (0.5, 0.4)])
)
def test_first_order_of_a_disc(reflectance, transmittance):
    disc_scene = scene(1.0, reflectance=reflectance, transmittance=transmittance)
    plan = jl.plan(LIDAR, disc_scene, max_orders=1, n_rays=4096, **SINGLE_SAMPLE)
    mean, stderr = batch_mean(LIDAR, disc_scene, plan, seed=0, count=16, quantity=sums)
    fraction = (4.0 / 10.0) ** 2
    ground = 1 - fraction + fraction * transmittance**2
    assert agrees(mean["disc"], stderr["disc"], reflectance * fraction, sigmas=4.0)
    assert agrees(mean["ground"], stderr["ground"], ground, sigmas=4.0)
    assert not agrees(mean["disc"], stderr["disc"], 1.02 * reflectance * fraction, sigmas=4.0)


@pytest.mark.slow
def test_a_disc_in_the_energy_budget_and_in_the_plan():
    disc_scene = scene(0.7, reflectance=0.5, transmittance=0.3)
    wave = jl.simulate(
        LIDAR, disc_scene, key=jax.random.key(0), n_photons=65536, max_orders=8, **SINGLE_SAMPLE
    )
    assert float(sum(wave.energy_budget.values())[0]) == pytest.approx(1.0, abs=1e-4)
    assert set(wave.components) == {"ground", "disc", "first", "higher"}
    # Plans know planes only: for another shape they state the bound that always holds.
    table = {e.name: e for e in jl.plan(LIDAR, disc_scene).effects}
    assert table["plates"].bound == 1.0


def test_surfaces_of_the_same_name_are_numbered():
    lower, upper = (jl.Plate(height=height, reflectance=0.2) for height in (1.0, 2.0))
    disc = Disc(5.0, 4.0, reflectance=0.5)
    disc_scene = jl.Scene(plates=(lower, disc, upper), ground=jl.Ground())
    materials = jl.plan(LIDAR, disc_scene, max_orders=1, describe=False).config.materials
    assert materials == ("ground", "plate 1", "disc", "plate 2")


@pytest.mark.slow
def test_derivative_in_the_height_of_a_disc():
    """The mean time of its echo changes by -2 / c per metre."""
    lidar = jl.Lidar(divergence=0.1, pulse=jl.GaussianPulse(fwhm=4.0))
    disc_scene = jl.Scene(plates=(Disc(5.0, 4.0, reflectance=0.5),))
    plan = jl.plan(lidar, disc_scene, max_orders=1, window=(-80.0, 20.0), footprint="fixed")

    def mean_time(height):
        moved = eqx.tree_at(lambda s: s.plates[0].height, disc_scene, height)
        setup = jl.make_setup(lidar, moved, plan)
        wave = jl.waveform_of(jl.trace_scene(setup, jax.random.key(0)), setup)
        return jnp.sum(wave.reflectance[0] * wave.time) / jnp.sum(wave.reflectance[0])

    slope = float(jax.grad(mean_time)(jnp.asarray(5.0)))
    assert slope == pytest.approx(-2 / jl.SPEED_OF_LIGHT, rel=1e-3)


def test_a_derivative_by_coverage_says_what_a_plan_without_gaps_leaves_out():
    """The return of a plate and the ground below it is c R + (1 - c + c T)^2 rho.

    Planted: R, the derivative without the light that passes gaps, as of a plan for c = 1.
    """

    def scene_of(coverage):
        plate = jl.Plate(height=2.0, reflectance=0.2, transmittance=0.5, coverage=coverage)
        return jl.Scene(plates=(plate,), ground=jl.Ground(reflectance=0.5))

    def derivative(coverage):
        plan = jl.plan(jl.Lidar(), scene_of(coverage), max_orders=1, window=(-60.0, 40.0))

        def total(coverage):
            wave = jl.simulate(jl.Lidar(), scene_of(coverage), plan=plan, key=jax.random.key(0))
            return wave.reflectance.sum()

        # Not compiled as a whole: JAX then passes constants as numbers.
        return float(jax.grad(total)(coverage))

    assert derivative(0.9) == pytest.approx(0.2 - 2.0 * (1.0 - 0.9 + 0.9 * 0.5) * (1.0 - 0.5) * 0.5, rel=1e-3)
    with pytest.warns(UserWarning, match="derivatives by the coverage of a plate leave out its gaps"):
        assert derivative(1.0) == pytest.approx(0.2, rel=1e-3)
