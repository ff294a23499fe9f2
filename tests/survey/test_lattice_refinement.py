"""Shots of first order: lattices of rays that are made denser until the tolerance is met."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

import jaxlidar as jl
from jaxlidar.survey.choose_strategy import choose_strategy
from jaxlidar.survey.per_shot import (
    aim_offset,
    begins_with_few_rays,
    error_of_interleaved,
    lidar_of_shot,
    shot_geometry,
    trace_chunk,
    trace_together,
)
from jaxlidar.trace.device_scene import aim_at, build_device_scene
from jaxlidar.trace.first.first_order import first_order
from jaxlidar.trace.first.footprint import (
    RaySlice,
    fibonacci_disc,
    interleaving_shifts,
    make_beam,
    spread_over_strips,
)
from jaxlidar.trace.first.lattices_of_shots import (
    LatticeParts,
    add_parts,
    empty_tally,
    lattice_sums,
    strips_of_columns,
)
from tests.helpers import BY_PRECISION

KEY = jax.random.key(5)
LIDAR = jl.Lidar(altitude=1000.0, divergence=3.0, pulse=jl.GaussianPulse(fwhm=4.0))


def edge(thickness: float = 3.0) -> jl.Scene:
    """Return a crown whose edge every shot sees."""
    density = np.zeros((20, 20, 6))
    density[10:, :, 6 - round(thickness) :] = 0.8
    canopy = jl.Canopy(jl.VoxelMap.from_lad(density, voxel_size=1.0), leaf=jl.Prospect(), hotspot=False)
    return jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.3))


def shots(count: int = 8) -> jl.Survey:
    """Return shots across the edge, at x = 10."""
    return jl.Survey(LIDAR, np.stack([10.0 + np.linspace(-1.6, 1.6, count), np.full(count, 10.0)], axis=1))


@BY_PRECISION
def test_slices_of_a_lattice_make_up_that_lattice(precision):
    beam, shift = make_beam(LIDAR), jnp.asarray([0.3, 0.8])
    (x, y), energy = fibonacci_disc(beam, 24 * 5, shift)
    slices = [fibonacci_disc(beam, 24, shift, RaySlice(jnp.asarray(n), jnp.asarray(5))) for n in range(5)]
    close = {"atol": 2e-5 if precision == "float32" else 1e-6}
    np.testing.assert_allclose(x, np.concatenate([s[0][0] for s in slices]), **close)
    np.testing.assert_allclose(y, np.concatenate([s[0][1] for s in slices]), **close)
    np.testing.assert_allclose(energy, np.concatenate([s[1] for s in slices]) / 5, rtol=1e-6)
    # Far out in a dense lattice, turns are still those of the golden ratio.
    distant = fibonacci_disc(beam, 64, shift, RaySlice(jnp.asarray(1000), jnp.asarray(1024)))[0]
    number = 64_000 + np.arange(64)
    turn = 2 * np.pi * ((number * (np.sqrt(5.0) - 1) / 2) % 1.0 + 0.8)
    angle = np.angle(np.exp(1j * (np.arctan2(distant[1], distant[0]) - turn)))
    assert np.abs(angle).max() < 1e-4


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.7, 0.4)])
def test_interleaved_lattices_make_up_a_denser_one(shift: tuple[float, float]):
    """Their rays enclose energy in equal steps, and turn by one angle; planted: shifts at random do not."""
    beam, n_lattices, n_rays = make_beam(LIDAR), 8, 16

    def steps(shifts) -> tuple[np.ndarray, np.ndarray]:
        """Return the largest deviations from equal steps of enclosed energy, and of turns."""
        rays = np.stack([np.stack(fibonacci_disc(beam, n_rays, s)[0]) for s in jnp.asarray(shifts)], axis=1)
        (x, y), radius = rays.reshape(2, -1), float(beam.radius)
        enclosed, turn = 1.0 - np.exp(-2.0 * (x**2 + y**2) / radius**2), np.arctan2(y, x) / (2 * np.pi)
        order = np.argsort(enclosed)
        energy_steps, turns = np.diff(enclosed[order]), np.diff(turn[order])
        of_first = np.abs((turns - turns[0] + 0.5) % 1.0 - 0.5)
        return np.abs(energy_steps * n_lattices * n_rays - 1.0).max(), of_first.max()

    assert max(steps(interleaving_shifts(jnp.asarray(shift), n_lattices))) < 1e-3
    assert min(steps(np.random.default_rng(0).uniform(size=(n_lattices, 2)))) > 0.1


@pytest.mark.slow
def test_interleaved_lattices_miss_less_than_independent_ones():
    """Of the fraction of a beam behind an edge, the scatter of lattices bounds the error of their mean."""
    beam, random = make_beam(LIDAR), np.random.default_rng(1)
    radius = float(beam.radius)
    # (trials, lattices, rays): x across the beam, and an edge at random in each trial.
    edges = random.uniform(-0.6, 0.6, 4000)[:, None, None] * radius
    shifts = {
        "interleaved": jax.vmap(lambda s: interleaving_shifts(s, 8))(
            jnp.asarray(random.uniform(size=(4000, 2)))
        ),
        "independent": jnp.asarray(random.uniform(size=(4000, 8, 2))),
    }
    exact = np.asarray(jax.scipy.stats.norm.cdf(edges[:, 0, 0] / (0.5 * radius)))
    squares = {}
    for name, lattices in shifts.items():
        x = jax.vmap(jax.vmap(lambda s: fibonacci_disc(beam, 16, s)[0][0]))(lattices)
        fractions = np.mean(np.asarray(x) < edges, axis=2)
        scatter = fractions.var(axis=1, ddof=1).mean() / 8
        squares[name] = np.mean((fractions.mean(axis=1) - exact) ** 2), scatter
    interleaved, independent = squares["interleaved"], squares["independent"]
    assert interleaved[0] < 0.5 * independent[0]
    assert interleaved[0] < 0.5 * interleaved[1]
    # Of independent ones the scatter is the squared error.
    assert 0.9 < independent[0] / independent[1] < 1.1


@BY_PRECISION
def test_rays_are_spread_over_the_columns_that_a_footprint_grazes(precision):
    """The share beyond an edge is exact by any shift; planted: rays of equal energies miss it by most."""
    strategy = strategy_of(narrow_shots(2), edge())
    scene, beam, n_lattices, n_rays = strategy.context.scene, make_beam(NARROW), 8, 8
    # The edge of a column lies 1.5 radii of the footprint to the east, and one 0.3 radii to the south.
    radius = float(beam.radius)
    offset = jnp.asarray([10.0 - 1.5 * radius, 10.0 + 0.3 * radius, 0.0])
    aim = scene.medium.origin + offset

    def shares(shift, is_spread):
        """Return the shares of the energy beyond the edges, and of the rays of the first."""
        strips = strips_of_columns(scene, beam, aim, n_lattices * n_rays, n_lattices, is_spread)

        def rays_of(shift, strips):
            rays = fibonacci_disc(beam, n_rays, shift)
            return spread_over_strips(beam, *rays, strips)

        (x, y), energy = jax.vmap(rays_of)(interleaving_shifts(shift, n_lattices), strips)
        is_beyond = jnp.stack([x > 1.5 * radius, y > 0.3 * radius])
        share = jnp.sum(jnp.where(is_beyond, energy, 0.0), axis=(1, 2)) / jnp.sum(energy)
        return *share, jnp.mean(is_beyond[0])

    shifts = jnp.asarray(np.random.default_rng(2).uniform(size=(400, 2)))
    east, south, rays = (np.asarray(a) for a in jax.vmap(lambda s: shares(s, jnp.asarray(True)))(shifts))
    exact_east, exact_south = scipy.special.ndtr([-3.0, -0.6])
    # One ray of eight is beyond the edge, give or take one or two of 64.
    assert 64 * rays.min() >= 5
    assert 64 * rays.max() <= 11
    assert abs(east.mean() / exact_east - 1.0) < 0.03
    assert np.abs(east / exact_east - 1.0).max() < 0.45
    assert abs(south.mean() / exact_south - 1.0) < 0.01
    assert np.abs(south - exact_south).max() < 0.06
    # Planted.
    equal = np.asarray(jax.vmap(lambda s: shares(s, jnp.asarray(False)))(shifts)[0])
    assert np.mean(equal == 0.0) > 0.8
    assert equal.max() > 10.0 * exact_east


@pytest.mark.slow
def test_errors_of_shots_straight_down_that_graze_columns_are_those_reported():
    random = np.random.default_rng(3)
    density = np.where(random.random((20, 20, 8)) < 0.5, 1.0, 0.0)
    canopy = jl.Canopy(jl.VoxelMap.from_lad(density, voxel_size=1.0), leaf=jl.Prospect(), hotspot=False)
    scene = terrain_under(jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.3)))
    survey = jl.Survey(NARROW, random.uniform(2.0, 18.0, (100, 2)), 0.0)
    draws = [
        jl.simulate_many(survey, scene, key=key, max_orders=1, rtol=0.02)
        for key in jax.random.split(jax.random.key(11), 16)
    ]
    values, errors = (np.stack([np.asarray(getattr(w, n)) for w in draws]) for n in ("reflectance", "stderr"))
    mean, typical = values.mean(axis=0), np.sqrt(np.mean(errors**2, axis=0))
    largest = mean.max(axis=-1, keepdims=True)
    # Rays are not quite parallel. Where two columns return the same, the few that cross from one to the other
    # on their way are all that differs: such errors are below the second bound and not always told.
    counts = (mean > 0.01 * largest) & (typical > 5e-4 * largest)
    deviation = (values - mean)[:, counts] * np.sqrt(16 / 15)
    z = deviation / np.maximum(errors[:, counts], 0.1 * typical[counts])
    assert 0.85 < np.sqrt(np.mean(z**2)) < 1.15
    assert np.mean(np.abs(z) < 2.0) > 0.93
    # Planted: errors a third smaller.
    assert np.mean(np.abs(z) < 4.0 / 3.0) < 0.88


@pytest.mark.slow
def test_every_shot_has_the_error_that_it_reports_within_the_tolerance():
    survey, scene, rtol = shots(), edge(), 0.01
    waveforms = jl.simulate_many(survey, scene, key=KEY, max_orders=1, rtol=rtol, shared=False)
    assert np.all(waveforms.error <= rtol)
    plan = jl.plan(survey, scene, max_orders=1, n_rays=1 << 14, describe=False)
    exact = [jl.simulate(lidar, scene, key=KEY, plan=plan).reflectance for lidar in survey]

    def chi_squared(waveforms: jl.Waveforms) -> np.ndarray:
        """Return that of each shot, per sample."""
        mean, stderr = np.asarray(waveforms.reflectance), np.asarray(waveforms.stderr)
        counts = mean > 0.01 * mean.max(axis=-1, keepdims=True)
        error = np.where(counts, np.maximum(stderr, 2e-4 * mean), 1.0)
        square = np.where(counts, ((mean - np.asarray(exact)) / error) ** 2, 0.0)
        return square.sum(axis=(1, 2)) / counts.sum(axis=(1, 2))

    # Errors of the samples of a shot are correlated: each shot counts about once.
    assert 0.05 < chi_squared(waveforms).mean() < 2.5
    # Planted: a crown thinner by a layer.
    wrong = jl.simulate_many(survey, edge(2.0), key=KEY, max_orders=1, rtol=rtol, shared=False)
    assert chi_squared(wrong).mean() > 100.0


@pytest.mark.slow
def test_a_tolerance_out_of_reach_is_reported():
    waveforms = jl.simulate_many(shots(1), edge(), key=KEY, max_orders=1, rtol=1e-6, shared=False)
    assert 1e-6 < float(waveforms.error[0]) < 1e-3


NARROW = jl.Lidar(altitude=1000.0, divergence=0.3, pulse=jl.GaussianPulse(fwhm=4.0))


def narrow_shots(count: int) -> jl.Survey:
    """Return shots of 0.3 m across the edge at x = 10 and across an edge along y."""
    x = 10.0 + np.linspace(-0.35, 0.35, count)
    return jl.Survey(
        NARROW, np.stack([x, np.linspace(4.0, 15.0, count)], axis=1), np.linspace(0.0, 8.0, count)
    )


def terrain_under(scene: jl.Scene) -> jl.Scene:
    heights = 0.4 * np.sin(np.arange(31)[:, None] / 3.0) + 0.3 * np.cos(np.arange(31)[None, :] / 2.0) - 0.8
    return jl.Scene(canopy=scene.canopy, ground=jl.Terrain(heights, 1.0, (-5.0, -5.0), reflectance=0.3))


def strategy_of(survey: jl.Survey, scene: jl.Scene):
    return choose_strategy(survey, scene, rtol=0.2, max_orders=1, window=None, shared=None)


def test_footprints_that_meet_a_few_columns_begin_with_few_rays():
    """The cost of a shot grows with the voxels that it meets, without a step where these are small."""
    lidar = jl.Lidar(altitude=1000.0, divergence=0.3, pulse=jl.GaussianPulse(fwhm=4.0))
    survey = jl.Survey(lidar, [(10.0, 10.0)])
    crown = edge()
    leaf = np.repeat(np.asarray(crown.canopy.voxels.leaf), 2, axis=0)
    for axis in (1, 2):
        leaf = np.repeat(leaf, 2, axis=axis)
    fine = jl.VoxelMap.from_extinction(leaf=leaf, voxel_size=0.5)
    fine_crown = dataclasses.replace(crown, canopy=dataclasses.replace(crown.canopy, voxels=fine))
    strategies = [
        choose_strategy(survey, scene, rtol=0.05, max_orders=1, window=None, shared=False)
        for scene in (crown, fine_crown)
    ]
    assert [begins_with_few_rays(strategy.context) for strategy in strategies] == [True, True]
    # Footprints of 3 m at 1 %, whose lattices need hundreds of rays.
    wide = choose_strategy(shots(), fine_crown, rtol=0.01, max_orders=1, window=None, shared=False)
    assert not begins_with_few_rays(wide.context)


def shots_of_a_tripod() -> jl.Survey:
    """Return shots of 0.3 m at 20 m, from three places beside the crown."""
    lidar = jl.Lidar(sensor=(0.0, 0.0, 1.5), divergence=15.0, pulse=jl.GaussianPulse(fwhm=4.0))
    sensors = np.array([(-6.0, 6.0, 1.5), (-6.0, 9.0, 2.0), (-5.5, 12.0, 1.5)])
    return jl.Survey(lidar, sensor=sensors, zenith=[95.0, 100.0, 80.0], azimuth=90.0)


@pytest.mark.parametrize(
    "shots_of",
    [lambda: narrow_shots(3), pytest.param(shots_of_a_tripod, marks=pytest.mark.slow)],
    ids=["above", "tripod"],
)
@BY_PRECISION
def test_parts_of_many_shots_are_those_of_single_ones(precision, shots_of):
    """Lattices that are traced together return what each returns alone; planted: that of another shot."""
    strategy = strategy_of(shots_of(), terrain_under(edge()))
    setup, shots = strategy.setup, shot_geometry(strategy.survey, 0, 3).in_precision()
    n_rays, shifts = 8, jnp.asarray([[0.3, 0.8], [0.6, 0.1], [0.9, 0.5]])
    slices = RaySlice(jnp.asarray([0, 1, 2]), jnp.asarray([1, 3, 4]))

    @eqx.filter_jit
    def trace_by_both_ways():
        scene = build_device_scene(setup, derivatives="none")
        offsets = jax.vmap(lambda shot: aim_offset(setup.lidar, shot))(shots)
        beams = jax.vmap(lambda shot: make_beam(lidar_of_shot(setup.lidar, shot)))(shots)
        aims = jnp.pad(offsets - offsets[:1], ((0, 0), (0, 3 - offsets.shape[1])))
        first_aim, tally = aim_at(scene, setup.lidar, offsets[0]), empty_tally(scene, 3)
        # In two chunks, which are added to one tally: they have 0.3 and 0.7 of the energy.
        for energy in (0.3, 0.7):
            parts = LatticeParts(jnp.arange(3), jnp.full(3, energy), beams, aims, shifts, slices)
            tally = add_parts(first_aim, tally, parts, 3, n_rays)
        together = lattice_sums(scene, tally, 3)

        def trace_alone(lattice):
            shot, offset, beam, shift, ray_slice = lattice
            aimed = aim_at(scene, lidar_of_shot(setup.lidar, shot), offset)
            return first_order(aimed, *fibonacci_disc(beam, n_rays, shift, ray_slice))

        return together, jax.lax.map(trace_alone, (shots, offsets, beams, shifts, slices))

    together, alone = trace_by_both_ways()
    close = {"rtol": 1e-4, "atol": 2e-6} if precision == "float32" else {"rtol": 1e-9, "atol": 1e-12}
    for name in ("weights", "outside", "arrived", "scattered"):
        np.testing.assert_allclose(getattr(together, name), getattr(alone, name).sum(axis=2), **close)
    np.testing.assert_allclose(together.escaped, alone.escaped.sum(axis=1), **close)
    assert np.abs(together.weights[0] - alone.weights[1].sum(axis=1)).max() > 0.01


@pytest.mark.slow
def test_narrow_shots_have_the_error_that_they_report_within_the_tolerance():
    """Few rays first, and more for shots that need them; two wavelengths."""
    lidar = dataclasses.replace(NARROW, wavelength=[900.0, 1550.0])
    x = 10.0 + np.linspace(-0.35, 0.35, 24)
    survey = jl.Survey(lidar, np.stack([x, np.linspace(4.0, 15.0, 24)], axis=1))
    scene, rtol = terrain_under(edge()), 0.1
    waveforms = jl.simulate_many(survey, scene, key=KEY, max_orders=1, rtol=rtol)
    assert np.all(waveforms.error <= rtol)
    assert np.any(waveforms.error > 0.1 * rtol)
    exact = jl.simulate_many(survey, scene, key=jax.random.key(6), max_orders=1, rtol=0.02)

    def worst(waveforms: jl.Waveforms) -> float:
        """Return the largest relative error of a shot, in the root mean square over its samples."""
        square = np.mean(
            (np.asarray(waveforms.reflectance) - np.asarray(exact.reflectance)) ** 2, axis=(1, 2)
        )
        return float(np.sqrt(square / np.mean(np.asarray(exact.reflectance) ** 2, axis=(1, 2))).max())

    assert 1e-4 < worst(waveforms) < 1.5 * rtol
    # Planted: a crown thinner by a layer.
    wrong = terrain_under(edge(2.0))
    assert worst(jl.simulate_many(survey, wrong, key=KEY, max_orders=1, rtol=rtol)) > 3.0 * rtol


@pytest.mark.slow
def test_results_do_not_depend_on_which_shots_are_traced_together():
    strategy = strategy_of(narrow_shots(20), edge())
    chunks = [shot_geometry(strategy.survey, first, count) for first, count in ((0, 20), (3, 9))]
    all_shots, nine_shots = (
        trace_chunk(
            strategy.context,
            chunk,
            strategy.setup.plan.n_samples,
            0.1,
            strategy.kept_names,
            KEY,
        )
        for chunk in chunks
    )
    assert np.ptp(np.asarray(all_shots["error"])) > 0
    np.testing.assert_allclose(
        all_shots["reflectance"][3:12], nine_shots["reflectance"], rtol=1e-3, atol=1e-6
    )
    np.testing.assert_allclose(all_shots["error"][3:12], nine_shots["error"], rtol=1e-2, atol=1e-5)


def test_interleaved_lattices_gain_the_more_the_more_columns_a_beam_crosses():
    """From (8 lattices)^-1/4 straight down to 8^-0.45 for level beams, which have no sine over cosine."""
    scene = strategy_of(narrow_shots(2), edge()).context.scene
    factor = np.asarray(error_of_interleaved(scene, np.array([0.0, 2.0, 10.0, 30.0, 90.0])))
    assert np.all(np.diff(factor) < 0.0)
    np.testing.assert_allclose(factor[[0, -1]], 8.0 ** np.array([-0.25, -0.45]), rtol=1e-5)


@pytest.mark.slow
def test_errors_of_narrow_shots_are_those_of_interleaved_lattices():
    """Over voxels filled at random, 2 s.e. hold, and hardly a shot is beyond twice the tolerance."""
    random = np.random.default_rng(3)
    density = np.where(random.random((20, 20, 8)) < 0.2, 3.0, 0.0)
    canopy = jl.Canopy(jl.VoxelMap.from_lad(density, voxel_size=1.0), leaf=jl.Prospect(), hotspot=False)
    scene = terrain_under(jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.3)))
    survey, rtol = jl.Survey(NARROW, random.uniform(2.0, 18.0, (300, 2)), 5.0), 0.05
    exact = jl.simulate_many(survey, scene, key=jax.random.key(6), max_orders=1, rtol=0.1 * rtol)
    waveforms = jl.simulate_many(survey, scene, key=KEY, max_orders=1, rtol=rtol)
    expected, stderr = np.asarray(exact.reflectance), np.asarray(waveforms.stderr)
    difference = np.asarray(waveforms.reflectance) - expected
    peak = expected.max(axis=-1, keepdims=True)
    is_significant = (expected > 0.01 * peak) & (stderr > 0.002 * peak)
    z = np.abs(difference / np.where(is_significant, stderr, 1.0))[is_significant]
    assert 0.93 < np.mean(z < 2.0) < 0.99
    # Planted: half of these errors hold too few, and those of independent lattices nearly all.
    assert np.mean(z < 1.0) < 0.93
    assert np.mean(z < 2.0 * 8**0.25) > 0.99

    def beyond(wrong: float = 0.0) -> float:
        """Return the fraction of shots beyond twice the tolerance; `wrong`: a planted relative error."""
        significant = expected > 0.01 * peak
        relative = np.where(significant, difference / np.where(significant, expected, 1.0) + wrong, 0.0)
        error = np.sqrt((relative**2).sum(axis=(1, 2)) / significant.sum(axis=(1, 2)))
        return float(np.mean(error > 2.0 * rtol))

    assert beyond() < 0.02
    assert beyond(wrong=2.0 * rtol) > 0.2


@pytest.mark.slow
def test_dense_lattices_lose_no_digits():
    """The budget of a shot whose lattices have tens of thousands of rays sums to one, in single precision."""
    strategy = strategy_of(narrow_shots(2), terrain_under(edge()))
    shots = jax.tree.map(lambda a: a[1:], shot_geometry(strategy.survey, 0, 2).in_precision())

    context = strategy.context

    @jax.jit
    def budget_of(n_parts):
        results = trace_together(context, shots, n_parts, KEY, strategy.kept_names)
        return sum(jnp.sum(a) for a in results["energy_budget"].values())

    assert abs(float(budget_of(jnp.array([10_000]))) - 1.0) < 5e-5
