"""Derivatives at the outline of a sphere of the user, against closed forms.

Layout: a Lambertian sphere of radius a and reflectance r on the axis of a Gaussian beam of radius w, above
ground of reflectance rho, seen from 400 km, in parallel light. The sphere hides the fraction

    f = 1 - exp(-2 a^2 / w^2),   df/da = 4 a / w^2 exp(-2 a^2 / w^2),

of the beam. First order returns rho (1 - f) from the ground, and from the sphere

    r integral of sqrt(1 - s^2 / a^2) 4 s / w^2 exp(-2 s^2 / w^2) ds   over s from 0 to a.

Without the outline derivatives of the first are zero: that wrong answer is rejected.
"""

import warnings
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from scipy.integrate import quad

import jaxlidar as jl
from jaxlidar.extend import Vec, add, as_array, as_scalar, dot, normalise, scale
from tests.helpers import SINGLE_SAMPLE, agrees, single_sample_lidar

# The radius of the beam, m, at the sphere and at the ground alike.
WIDTH = 10.0
RADIUS, SPHERE, GROUND = 6.0, 0.3, 0.8
START = {"radius": RADIUS, "east": 0.0, "width": 1.0, "height": 7.0}


class AbstractSphereShape(jl.AbstractShape):
    """A sphere, met from outside."""

    centre: eqx.AbstractVar[Float[Array, "3"]]
    radius: eqx.AbstractVar[Float[Array, ""]]

    @property
    def lights_itself(self):
        return False

    def moved(self, by):
        return type(self)(self.centre + by, self.radius)

    def from_axis(self, x: Vec, w: Vec):
        """Return the distance of the centre along rays, and its squared distance from them."""
        to_centre = tuple(c - p for c, p in zip(self.centre, x))
        ahead = dot(to_centre, w)
        across = add(to_centre, scale(w, -ahead))
        return ahead, dot(across, across)

    def distance(self, x: Vec, w: Vec):
        ahead, across2 = self.from_axis(x, w)
        half_chord2 = self.radius**2 - across2
        is_met = (half_chord2 > 0) & (ahead > 0)
        return jnp.where(is_met, ahead - jnp.sqrt(jnp.where(is_met, half_chord2, 1.0)), 1e30)

    def tangent(self, x: Vec):
        normal = normalise(tuple(p - c for p, c in zip(x, self.centre)))
        return normal, dot(normal, x)

    def crossing(self, points, directions):
        centre, radius = np.asarray(self.centre, float), float(self.radius)
        ahead = np.einsum("nk,nk->n", centre - points, directions)
        return ahead + np.where(np.arange(len(points)) % 2, radius, -radius), np.full(len(points), -1.0)


@final
class SphereShape(AbstractSphereShape):
    """A sphere that does not state its outline."""

    centre: Float[Array, "3"]
    radius: Float[Array, ""]


@final
class OutlinedSphereShape(AbstractSphereShape):
    """A sphere that states its outline."""

    centre: Float[Array, "3"]
    radius: Float[Array, ""]

    def outline(self, x: Vec, w: Vec):
        return jnp.sqrt(self.from_axis(x, w)[1]) - self.radius


@final
class Sphere(jl.AbstractSheet):
    """An opaque sphere."""

    height: Float[Array, ""] = eqx.field(converter=as_scalar)
    radius: Float[Array, ""] = eqx.field(converter=as_scalar)
    east: Float[Array, ""] = eqx.field(converter=as_scalar, default=0.0)
    reflectance: Array = eqx.field(converter=as_array, default=SPHERE)
    transmittance: Array = eqx.field(converter=as_array, default=0.0)
    coverage: Float[Array, ""] = eqx.field(converter=as_scalar, default=1.0)
    transmission: str = eqx.field(static=True, default="straight")
    law: jl.AbstractLaw = jl.Lambertian()
    outlined: bool = eqx.field(static=True, default=True)

    @property
    def name(self):
        return "sphere"

    @property
    def shape(self):
        centre = jnp.stack([self.east, jnp.zeros_like(self.height), self.height])
        return (OutlinedSphereShape if self.outlined else SphereShape)(centre, self.radius)


def returns(radius, east, width):
    """Return the first order of the sphere and of the ground, by quadrature in double precision."""

    def density(x, y):
        return 2.0 / (np.pi * width**2) * np.exp(-2.0 * (x * x + y * y) / width**2)

    def ring(s):
        turns = np.linspace(0.0, 2.0 * np.pi, 65)[:-1]
        return s * 2.0 * np.pi * np.mean(density(east + s * np.cos(turns), s * np.sin(turns)))

    hidden = quad(ring, 0.0, radius)[0]
    lit = quad(lambda s: ring(s) * np.sqrt(1.0 - (s / radius) ** 2), 0.0, radius)[0]
    return np.array([SPHERE * lit, GROUND * (1.0 - hidden)])


def exact_derivative(name, east):
    """Return the derivatives of `returns` by central differences."""
    start = {"radius": RADIUS, "east": east, "width": WIDTH}
    step = 1e-3
    sides = [returns(**start | {name: start[name] + s}) for s in (-step, step)]
    return (sides[1] - sides[0]) / (2.0 * step)


def build(p, ground=None, canopy=None, outlined=True, profile="gaussian"):
    lidar = single_sample_lidar(divergence=2e3 * WIDTH / 4e5 * p["width"], profile=profile)
    sphere = Sphere(p["height"], p["radius"], p["east"], outlined=outlined)
    ground = jl.Ground(reflectance=GROUND) if ground is None else ground
    return lidar, jl.Scene(plates=(sphere,), ground=ground, canopy=canopy)


def make_estimator(name, start, n_keys=8, **scene):
    """Return a function that returns value and derivative of the returns of sphere and ground.

    It maps the value of the parameter `name` to both, each with its standard error.
    """
    start = {key: jnp.asarray(value) for key, value in (START | start).items()}
    plan = jl.plan(*build(start, **scene), max_orders=1, n_rays=8192, **SINGLE_SAMPLE)

    def measure(value, key):
        setup = jl.make_setup(*build(start | {name: value}, **scene), plan)
        wave = jl.waveform_of(jl.trace_scene(setup, key, reverse=False), setup)
        return jnp.stack([wave.components[material].sum() for material in ("sphere", "ground")])

    @jax.jit
    def trace(value, key):
        return jax.jvp(lambda v: measure(v, key), (value,), (jnp.ones(()),))

    def estimate(value):
        keys = jax.random.split(jax.random.key(2), n_keys)
        batches = zip(*(trace(jnp.asarray(value), key) for key in keys))
        arrays = (np.array(a, float) for a in batches)
        return [(a.mean(axis=0), a.std(axis=0, ddof=1) / np.sqrt(n_keys)) for a in arrays]

    return estimate


@pytest.mark.slow
@pytest.mark.parametrize(("name", "east"), [("radius", 0.0), ("radius", 5.0), ("east", 5.0), ("width", 3.0)])
def test_first_order_of_a_sphere(name, east):
    estimate = make_estimator(name, {"east": east})
    (value, value_stderr), (slope, stderr) = estimate((START | {"east": east})[name])
    assert agrees(value, value_stderr + 1e-6, returns(RADIUS, east, WIDTH), sigmas=4.0)
    unit = WIDTH if name == "width" else 1.0
    exact = unit * exact_derivative(name, east)
    assert agrees(slope, stderr + 1e-5, exact, sigmas=4.0)
    # Without the outline.
    assert not agrees(slope, stderr + 1e-5, exact * [1.0, 0.0], sigmas=4.0)


@pytest.mark.slow
def test_the_gradient_is_that_of_the_jacobian():
    start = {key: jnp.asarray(value) for key, value in START.items()}
    plan = jl.plan(*build(start), max_orders=1, n_rays=512, **SINGLE_SAMPLE)

    def total(p):
        setup = jl.make_setup(*build(p), plan)
        return jl.total_reflectance(jl.trace_scene(setup, jax.random.key(0)), setup).sum()

    reverse, forward = jax.jit(jax.grad(total))(start), jax.jit(jax.jacfwd(total))(start)
    for name in start:
        np.testing.assert_allclose(reverse[name], forward[name], rtol=1e-3, atol=1e-6, err_msg=name)


@pytest.mark.slow
def test_a_top_hat_beam():
    """The sphere hides a^2 / w^2 of the beam, as long as it lies within."""
    exact = {"radius": -2.0 * RADIUS / WIDTH**2, "width": 2.0 * RADIUS**2 / WIDTH**2, "east": 0.0}
    for name, derivative in exact.items():
        estimate = make_estimator(name, {"east": 1.0}, profile="top-hat")
        _, (slope, stderr) = estimate((START | {"east": 1.0})[name])
        assert agrees(slope[1], stderr[1] + 1e-4, GROUND * derivative, sigmas=4.0), name
        assert name == "east" or not agrees(slope[1], stderr[1] + 1e-4, 0.0, sigmas=4.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["radius", "east"])
def test_a_sphere_over_terrain_and_beside_voxels(name):
    """Rays move with the outline, with cells and with voxels at once; against central differences."""
    random = np.random.default_rng(0)
    terrain = jl.Terrain(random.uniform(-2.0, 2.0, (41, 41)), 2.0, (-40.0, -40.0), GROUND)
    leaf = random.uniform(0.0, 0.1, (16, 16, 1))
    voxels = jl.VoxelMap.from_extinction(leaf=leaf, voxel_size=3.0, origin=(-24.0, -24.0, 4.0))
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(reflectance=0.4, transmittance=0.3))
    scene = {"ground": terrain, "canopy": canopy}
    estimate, middle = make_estimator(name, {"east": 5.0}, **scene), (START | {"east": 5.0})[name]
    _, (slope, stderr) = estimate(middle)
    sides = [estimate(middle + step)[0] for step in (-0.3, 0.3)]
    difference = (sides[1][0] - sides[0][0]) / 0.6
    difference_stderr = np.hypot(sides[0][1], sides[1][1]) / 0.6
    margin = 4.0 * np.hypot(stderr, difference_stderr) + 0.01 * np.abs(difference)
    assert np.all(np.abs(slope - difference) < margin), (slope, stderr, difference)
    assert abs(difference[1]) > 2.0 * margin[1]


def test_a_shape_without_outline_warns_of_derivatives():
    def total(radius):
        setup = jl.make_setup(*build(start | {"radius": radius}, outlined=False), plan)
        return jl.total_reflectance(jl.trace_scene(setup, jax.random.key(0)), setup).sum()

    def by_reflectance(reflectance):
        ground = jl.Ground(reflectance=reflectance)
        setup = jl.make_setup(*build(start, ground, outlined=False), plan)
        return jl.total_reflectance(jl.trace_scene(setup, jax.random.key(0)), setup).sum()

    start = {key: jnp.asarray(value) for key, value in START.items()}
    plan = jl.plan(*build(start, outlined=False), max_orders=1, n_rays=64, **SINGLE_SAMPLE)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.eval_shape(total, start["radius"])
        jax.eval_shape(jax.grad(by_reflectance), jnp.asarray(0.3))
    for derivative in (jax.grad, jax.jacfwd):
        with pytest.warns(jl.OutlineWarning, match="outline"):
            jax.eval_shape(derivative(total), start["radius"])
