"""Reverse mode by replay against forward mode and finite differences, and its memory.

Along random directions in each kind of parameter, the product with the gradient is the derivative by forward
mode, for the same key: replay walks the same paths. Forward mode itself is compared with differences in
`test_derivatives.py`; here reverse mode is, for single voxels, by a z-test.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar.trace.derivatives import higher_order_replay, replay
from jaxlidar.trace.device_scene import build_device_scene
from tests.helpers import agrees

RANDOM = np.random.default_rng(0)
LEAF = RANDOM.uniform(0.1, 1.0, (3, 3, 4)) * (RANDOM.uniform(size=(3, 3, 4)) < 0.6)
BARK = RANDOM.uniform(0.0, 0.3, (3, 3, 4))
HEIGHTS, SOIL = RANDOM.uniform(-0.3, 0.3, (7, 7)), RANDOM.uniform(0.2, 0.5, (7, 7))
ORIGIN = (-1.5, -1.25, 0.5)
START = {
    name: jnp.asarray(value, float)
    for name, value in {
        "leaf": LEAF,
        "bark": BARK,
        "voxel size": 1.0,
        "terrain heights": HEIGHTS,
        "raster reflectance": SOIL,
        "plate height": 2.1,
        "leaf reflectance": 0.4,
    }.items()
}


def map_of(p, leaf_angles=None, with_bark=True):
    if leaf_angles is not None:
        return jl.VoxelMap.from_lad(
            p["leaf"], voxel_size=p["voxel size"], origin=ORIGIN, leaf_angles=leaf_angles
        )
    bark = p["bark"] if with_bark else None
    return jl.VoxelMap.from_extinction(leaf=p["leaf"], bark=bark, voxel_size=p["voxel size"], origin=ORIGIN)


def everything(p):
    """Return leaf, bark, a plate, and terrain whose reflectance varies."""
    optics = jl.LeafOptics(reflectance=p["leaf reflectance"], transmittance=0.3)
    return jl.Scene(
        canopy=jl.Canopy(map_of(p), leaf=optics, bark=0.3),
        plates=(jl.Plate(height=p["plate height"], reflectance=0.3, transmittance=0.3, coverage=0.5),),
        ground=jl.Terrain(
            heights=p["terrain heights"],
            spacing=1.0,
            origin=(-3.0, -3.0),
            reflectance=p["raster reflectance"],
        ),
    )


def leaves_over_ground(p, leaf_angles=None):
    """Return leaf alone over a plane, with independent paths in and out."""
    voxels = map_of(p, leaf_angles, with_bark=False)
    canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(0.4, 0.3), hotspot=False)
    return jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.5))


def leaf_and_bark(p):
    optics = jl.LeafOptics(reflectance=0.4, transmittance=0.3)
    return jl.Scene(canopy=jl.Canopy(map_of(p), leaf=optics, bark=0.3), ground=jl.Ground(reflectance=0.5))


def planophile(p):
    return leaves_over_ground(p, "planophile")


# Within the voxels, looking down.
INSIDE = {"sensor": (0.1, 0.0, 2.6), "divergence": 50.0, "zenith": 30.0}


def problem(build, zenith, orders, n_rays=600, n_photons=300):
    """Return a loss of parameters and a key: it is not linear in the waveform."""
    geometry = INSIDE if zenith == "inside" else {"divergence": 2.0, "zenith": zenith}
    lidar = jl.Lidar(azimuth=0.0, wavelength=1064.0, **geometry)
    window = (-5.0, 60.0) if zenith == "inside" else (-60.0, 40.0)
    plan = jl.plan(
        lidar, build(START), max_orders=orders, n_rays=n_rays, n_photons=8 * n_photons, window=window
    )

    def loss(p, key):
        setup = jl.make_setup(lidar, build(p), plan)
        samples = jl.total_reflectance(jl.trace_scene(setup, key), setup)[0]
        return jnp.sum(samples**2 * jnp.arange(samples.size))

    return loss


def forward_and_reverse(loss, names):
    """Return derivatives along a random direction in each of the parameters, by both modes."""
    directions = {n: jnp.asarray(np.random.default_rng(2).normal(size=START[n].shape)) for n in names}
    varied, key = {n: START[n] for n in names}, jax.random.key(1)

    def of_varied(p):
        return loss(START | p, key)

    gradient = jax.jit(jax.grad(of_varied))(varied)
    reverse = [float(jnp.sum(gradient[n] * directions[n])) for n in names]
    # One parameter varies at a time.
    one_by_one = {
        n: jnp.stack([directions[n] * (n == m) for m in names]).astype(START[n].dtype) for n in names
    }
    push = jax.jit(jax.vmap(lambda t: jax.jvp(of_varied, (varied,), (t,))[1]))
    return np.asarray(push(one_by_one)), np.asarray(reverse)


CASES = [
    ("voxels at nadir", leaves_over_ground, 0.0, 3, ("leaf",)),
    pytest.param("everything", everything, 12.0, 1, tuple(START), marks=pytest.mark.slow),
    pytest.param("everything", everything, 12.0, 2, tuple(START), marks=pytest.mark.slow),
    pytest.param("everything", everything, 12.0, 6, tuple(START), marks=pytest.mark.slow),
    pytest.param("voxels off nadir", everything, 12.0, 3, ("leaf", "bark"), marks=pytest.mark.slow),
    pytest.param(
        "sensor within the voxels", leaf_and_bark, "inside", 3, ("leaf", "bark"), marks=pytest.mark.slow
    ),
    pytest.param("leaf angles", planophile, 8.0, 1, ("leaf",), marks=pytest.mark.slow),
    pytest.param("leaf angles", planophile, 0.0, 3, ("leaf", "voxel size"), marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("name", "build", "zenith", "orders", "names"), CASES)
def test_forward_and_reverse_agree(name, build, zenith, orders, names):
    forward, reverse = forward_and_reverse(problem(build, zenith, orders), names)
    scale = np.max(np.abs(forward))
    np.testing.assert_allclose(reverse, forward, rtol=2e-4, atol=2e-5 * scale)
    assert np.all(forward != 0.0)
    # Planted: a derivative that is 1 % off.
    with pytest.raises(AssertionError):
        np.testing.assert_allclose(1.01 * reverse, forward, rtol=2e-4, atol=2e-5 * scale)


def loss_of_height():
    """Return a loss of the height of the ground under voxels, of the first order of few rays."""
    lidar = jl.Lidar(divergence=2.0)

    def over_ground_at(height):
        return dataclasses.replace(leaves_over_ground(START), ground=jl.Ground(height=height))

    plan = jl.plan(lidar, over_ground_at(-0.2), max_orders=1, n_rays=16, window=(-60.0, 40.0))

    def loss(height):
        wave = jl.simulate(lidar, over_ground_at(height), plan=plan, key=jax.random.key(0))
        return jnp.sum(wave.reflectance**2)

    return loss


def test_a_gradient_by_a_height_has_a_gradient():
    """Reverse mode through reverse mode is a program: no loop in it has an unknown length."""
    assert "while" in jax.jit(jax.grad(jax.grad(loss_of_height()))).lower(-0.2).as_text()


@pytest.mark.slow
def test_second_derivatives_by_a_height():
    """Reverse mode through reverse mode, and forward through forward."""
    loss = loss_of_height()
    reverse, forward = (jax.jit(d(d(loss)))(-0.2) for d in (jax.grad, jax.jacfwd))
    np.testing.assert_allclose(reverse, forward, rtol=1e-3)
    assert forward != 0.0


@pytest.mark.slow
def test_few_numbers_have_the_same_derivatives_in_directions(monkeypatch):
    """Derivatives with respect to a height: in its direction, which is the default, and by reverse mode."""

    def over_ground_at(p):
        ground = jl.Ground(reflectance=0.5, height=p["height"])
        return dataclasses.replace(leaves_over_ground(p), ground=ground)

    def gradient_and_size():
        loss = problem(over_ground_at, 12.0, 2)
        gradient = jax.jit(jax.grad(lambda height: loss(START | {"height": height}, jax.random.key(1))))
        program = gradient.lower(-0.2)
        return program.compile()(-0.2), program.as_text().count("\n")

    monkeypatch.setitem(START, "height", jnp.asarray(-0.2))
    in_directions, size = gradient_and_size()
    monkeypatch.setattr(replay, "_MAX_DIRECTIONS", 0)
    in_reverse, size_in_reverse = gradient_and_size()
    np.testing.assert_allclose(in_directions, in_reverse, rtol=2e-4)
    assert in_directions != 0.0
    assert size < 0.8 * size_in_reverse


@pytest.mark.slow
@pytest.mark.parametrize(("zenith", "orders"), [(0.0, 2), (12.0, 3)])
def test_second_derivatives_by_forward_over_reverse(zenith, orders):
    """The Hessian is that of forward mode within forward mode, and symmetric.

    Where voxels are thin, it is symmetric in the mean over keys alone: rows have placed collisions.
    """
    loss, key = problem(leaves_over_ground, zenith, orders, n_photons=256, n_rays=128), jax.random.key(1)
    leaf, thin_leaf = START["leaf"] + 0.05, START["leaf"] + 0.02
    v, w = jnp.asarray(np.random.default_rng(5).normal(size=(2, *leaf.shape)), leaf.dtype)

    def of_leaf(leaf):
        return loss(START | {"leaf": leaf}, key)

    def slope(leaf):
        return jax.jvp(of_leaf, (leaf,), (v,))[1]

    product = jax.jit(lambda leaf, v: jax.jvp(jax.grad(of_leaf), (leaf,), (v,))[1])
    forward = jax.jit(lambda leaf: jax.jvp(slope, (leaf,), (w,))[1])
    for leaves in (leaf, thin_leaf):
        np.testing.assert_allclose(jnp.sum(v * product(leaves, w)), forward(leaves), rtol=1e-4)
    np.testing.assert_allclose(jnp.sum(w * product(leaf, v)), forward(leaf), rtol=1e-4)
    assert forward(leaf) != 0.0


@pytest.mark.slow
def test_empty_voxels_have_their_derivative_at_first_order():
    """The gradient in a voxel of zero extinction is the difference to a little leaf there."""
    loss, key = problem(leaves_over_ground, 0.0, 1), jax.random.key(1)
    empty = np.argwhere(np.asarray(START["leaf"]) == 0.0)
    assert len(empty) > 5
    gradient = jax.jit(jax.grad(lambda leaf: loss(START | {"leaf": leaf}, key)))(START["leaf"])
    gradient = gradient[tuple(empty.T)]
    step, value = 0.02, jax.jit(jax.vmap(lambda leaf: loss(START | {"leaf": leaf}, key)))
    # Of second order, from one side: extinction is not negative.
    maps = np.stack([np.asarray(START["leaf"])] * (2 * len(empty) + 1))
    for n, voxel in enumerate(empty):
        maps[(2 * n, *voxel)], maps[(2 * n + 1, *voxel)] = step, 2.0 * step
    values = np.asarray(value(jnp.asarray(maps, START["leaf"].dtype)), float)
    one, two, none = values[0:-1:2], values[1:-1:2], values[-1]
    difference = (4.0 * one - two - 3.0 * none) / (2.0 * step)
    np.testing.assert_allclose(gradient, difference, atol=0.02 * np.max(np.abs(difference)))
    assert np.max(np.abs(gradient)) > 0.1 * np.max(np.abs(difference)) > 0.0


def test_simulate_uses_the_replay_unasked(monkeypatch):
    """`jax.grad` of `simulate` with a plan runs the replay, and `jax.jvp` of it does not."""
    pulled = []
    original = replay.linear_map

    def linear_map(function, transpose, residuals, arguments, results):
        def spied(residuals, cotangents):
            pulled.append(len(cotangents))
            return transpose(residuals, cotangents)

        return original(function, spied, residuals, arguments, results)

    monkeypatch.setattr(replay, "linear_map", linear_map)
    lidar, scene = jl.Lidar(), leaves_over_ground(START)
    plan, key = jl.plan(lidar, scene, max_orders=1, n_rays=64), jax.random.key(0)

    def total(leaf):
        wave = jl.simulate(lidar, leaves_over_ground(START | {"leaf": leaf}), plan=plan, key=key)
        return jnp.sum(wave.reflectance)

    leaf = START["leaf"]
    jax.jit(lambda leaf: jax.jvp(total, (leaf,), (leaf,))).lower(leaf)
    assert not pulled
    jax.jit(jax.grad(total)).lower(leaf)
    assert pulled


def temporaries(orders, **sizes):
    """Return the memory, in bytes, that a compiled gradient in voxels takes beside arguments and results."""
    loss = problem(leaves_over_ground, 0.0, orders, **sizes)
    gradient = jax.jit(jax.grad(lambda leaf: loss(START | {"leaf": leaf}, jax.random.key(0))))
    memory = gradient.lower(START["leaf"]).compile().memory_analysis()
    assert memory is not None
    return memory.temp_size_in_bytes


@pytest.mark.slow
def test_memory_does_not_grow_with_rays():
    small, large = (temporaries(1, n_rays=n) for n in (1024, 16_384))
    # Positions of the rays themselves: three numbers each, in few copies.
    assert large - small < 16_384 * 100
    assert large < 10e6


@pytest.mark.slow
def test_memory_does_not_grow_with_photons():
    small, large = (temporaries(6, n_photons=n) for n in (16_384, 131_072))
    assert large < 1.1 * small


@pytest.mark.slow
def test_memory_is_bounded_in_orders():
    """Flights are kept of fewer photons at a time, the more orders there are."""
    small, large = (temporaries(orders, n_photons=16_384) for orders in (8, 64))
    assert small < 30e6
    assert large < 1.1 * small


@pytest.mark.slow
def test_gradient_does_not_depend_on_the_photons_kept_at_a_time(monkeypatch):
    loss, key = problem(everything, 12.0, 3, n_photons=2048), jax.random.key(1)

    def gradient():
        return jax.jit(jax.grad(lambda leaf: loss(START | {"leaf": leaf}, key)))(START["leaf"])

    groups, original = [], higher_order_replay.PhotonBatch

    def counted(*arguments, **options):
        batch = original(*arguments, **options)
        groups.append(batch.n_groups)
        return batch

    monkeypatch.setattr(higher_order_replay, "PhotonBatch", counted)
    at_once = gradient()
    monkeypatch.setattr(higher_order_replay, "MAX_KEPT_FLIGHTS", 1024)
    np.testing.assert_allclose(gradient(), at_once, rtol=1e-4, atol=1e-6 * np.max(np.abs(at_once)))
    assert groups[-1] > groups[0]


@pytest.mark.slow
@pytest.mark.parametrize("orders", [1, 2, 6])
def test_gradients_in_voxels_agree_with_differences(orders):
    """Means over keys: the gradient along directions that hold single voxels, against central differences."""
    loss = problem(everything, 12.0, orders, n_photons=4096)
    voxels = np.argwhere(LEAF > 0.3)[:3]
    step, keys = 0.1, 24

    def along_voxels(gradient):
        return jnp.stack([gradient[tuple(v)] for v in voxels])

    gradient = jax.jit(jax.grad(lambda leaf, key: loss(START | {"leaf": leaf}, key)))
    value = jax.jit(lambda leaf, key: loss(START | {"leaf": leaf}, key))
    leaf = START["leaf"]
    estimates = [along_voxels(gradient(leaf, k)) for k in jax.random.split(jax.random.key(3), keys)]
    differences = []
    for k in jax.random.split(jax.random.key(4), keys):
        pairs = [[value(leaf.at[tuple(v)].add(s), k) for s in (step, -step)] for v in voxels]
        differences.append([(high - low) / (2.0 * step) for high, low in pairs])
    estimates, differences = np.asarray(estimates, float), np.asarray(differences, float)
    stderr = np.sqrt((np.var(estimates, axis=0) + np.var(differences, axis=0)) / (keys - 1))
    # The noise of a sample biases its square, alike on both sides; a margin for curvature.
    mean, expected = estimates.mean(axis=0), differences.mean(axis=0)
    stderr = stderr + 0.01 * np.abs(expected)
    assert agrees(mean, stderr, expected, sigmas=3.5)
    # Planted: a derivative of the wrong sign.
    assert not agrees(-mean, stderr, expected, sigmas=3.5)


def test_first_order_alone_has_no_table_of_vertical_depths():
    """The cotangent of a table that is not read is a sum of zeros, which XLA takes seconds to evaluate."""
    scene, lidar = leaves_over_ground(START), jl.Lidar(divergence=2.0)
    is_built = []
    for orders in (1, 2):
        plan = jl.plan(lidar, scene, max_orders=orders, n_rays=16, n_photons=128)
        device_scene = build_device_scene(jl.make_setup(lidar, scene, plan), derivatives="all")
        is_built.append(device_scene.depth_above is not None)
    assert is_built == [False, True]


@pytest.mark.slow
@pytest.mark.parametrize("zenith", [150.0, 180.0])
def test_reverse_mode_is_forward_mode_for_a_sensor_below_its_canopy(zenith):
    """Some photons meet nothing, and stay at the sensor: they have no direction to it."""
    voxels = jl.VoxelMap.from_lad(
        np.full((2, 2, 2), 0.5), voxel_size=(2.0, 2.0, 1.0), origin=(-2.0, -2.0, 3.0)
    )
    scene = jl.Scene(canopy=jl.Canopy(voxels, leaf=jl.LeafOptics(0.45, 0.4)))

    def lidar_at(zenith):
        return jl.Lidar(sensor=(0.3, 0.2, 0.5), zenith=zenith, azimuth=10.0, divergence=2.0)

    plan = jl.plan(lidar_at(179.0), scene, max_orders=2, window=(0.0, 150.0), n_photons=2048, n_rays=64)

    def higher(zenith):
        wave = jl.simulate(lidar_at(zenith), scene, plan=plan, key=jax.random.key(0))
        return wave.components["higher"].sum()

    reverse, forward = (jax.jit(d(higher))(zenith) for d in (jax.grad, jax.jacfwd))
    assert np.isfinite(forward)
    np.testing.assert_allclose(reverse, forward, rtol=1e-3, atol=1e-9)
