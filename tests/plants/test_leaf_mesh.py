"""Leaves of random places against the law of Beer and Lambert: gaps, first-order returns, areas, stands.

Rays are as far from one another as leaves are long, so that each meets leaves of its own: hits of one
realisation are independent, and their number is binomial.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import jaxlidar as jl
from jaxlidar._vectors import FAR, vec
from jaxlidar.plants import leaf_mesh as module
from jaxlidar.scenes.mesh_surface import build_mesh_tree
from tests.helpers import slow_unless

KEY = jax.random.key(7)
LEAF = jl.LeafOptics(reflectance=0.4, transmittance=0.35)
SPACING = 0.15
TOP, THICKNESS = 6.0, 2.0
# Level of the tests: |z| < 4 with a hundred of them.
SIGMAS = 4.0


def layer(leaf_angles="spherical", lai=1.5):
    """A layer of 10 m by 6 m and 2 m thickness."""
    density = np.full((5, 3, 4), lai / THICKNESS)
    size = (2.0, 2.0, THICKNESS / 4)
    return jl.VoxelMap.from_lad(
        density, voxel_size=size, origin=(0, 0, TOP - THICKNESS), leaf_angles=leaf_angles
    )


def leaves_of(voxels, leaf_area=0.005, key=KEY, **options):
    return jl.leaf_mesh(voxels, leaf_area, key=key, leaf=LEAF, **options)


def rays(zenith, spacing=SPACING):
    """Return starts at the top of the layer, and directions, of parallel rays that do not leave its sides."""
    s, c = np.sin(np.deg2rad(zenith)), np.cos(np.deg2rad(zenith))
    margin = THICKNESS * s / c
    x, y = np.meshgrid(np.arange(0.3, 9.7 - margin, spacing / c), np.arange(0.3, 5.7, spacing))
    start = np.stack([x.ravel(), y.ravel(), np.full(x.size, TOP)], axis=1)
    return start, np.tile([s, 0.0, -c], (x.size, 1))


def meet(surface, *beams):
    """Return, for each group of rays, distances at which they meet a surface, and cosines of incidence."""
    start, w = (np.concatenate(arrays) for arrays in zip(*beams))
    # From a metre before: leaves reach out of the layer.
    hit = jax.jit(lambda s, x, w: build_mesh_tree([s]).meet(vec(x.T), vec(w.T)))(
        surface, jnp.asarray(start - w, float), jnp.asarray(w, float)
    )
    cosine = np.abs((np.stack(hit.normal, axis=-1) * w).sum(axis=1))
    ends = np.cumsum([len(a) for a, _ in beams])[:-1]
    return list(zip(np.split(np.asarray(hit.distance, float) - 1.0, ends), np.split(cosine, ends)))


def projection(leaf_angles, zenith):
    g, square = jl.LeafAngles.named(leaf_angles).tables()
    mu = np.linspace(0.0, 1.0, len(g))
    return tuple(np.interp(np.cos(np.deg2rad(zenith)), mu, np.asarray(a)) for a in (g, square))


def z_of_gaps(count, n, leaf_angles, zenith, lai=1.5):
    """z-score of the number of gaps of n rays, against the law of Beer and Lambert."""
    expected = np.exp(-projection(leaf_angles, zenith)[0] * lai / np.cos(np.deg2rad(zenith)))
    return (count - n * expected) / np.sqrt(n * expected * (1.0 - expected))


@pytest.mark.parametrize(
    ("leaf_angles", "shape", "leaf_area"),
    # A needle of the same area would be longer than rays are apart.
    slow_unless(
        [("erectophile", "needle", 0.0006)],
        [
            ("spherical", "rhombus", 0.005),
            ("planophile", "ellipse", 0.005),
            ("erectophile", "needle", 0.0006),
        ],
    ),
)
def test_gaps_are_those_of_beer_and_lambert(leaf_angles, shape, leaf_area):
    beams = {zenith: rays(zenith) for zenith in (0.0, 60.0)}
    surface = leaves_of(layer(leaf_angles), leaf_area, shape=shape)
    for (zenith, (start, _)), (distance, _) in zip(beams.items(), meet(surface, *beams.values())):
        count, n = np.sum(distance >= FAR), len(start)
        assert abs(z_of_gaps(count, n, leaf_angles, zenith)) < SIGMAS
        # Half of the leaf area, and at nadir other leaf angles, are found out.
        assert z_of_gaps(count, n, leaf_angles, zenith, lai=0.75) < -2 * SIGMAS
        wrong = "planophile" if leaf_angles == "spherical" else "spherical"
        assert zenith > 0.0 or abs(z_of_gaps(count, n, wrong, zenith)) > SIGMAS


@pytest.mark.parametrize("leaf_angles", ["spherical", "planophile"])
def test_the_mean_first_order_return_has_the_hot_spot(leaf_angles):
    """A hit at the incidence angle i returns R cos(i); E[return] = R f (exp(-tau_1) - exp(-tau_2)).

    The way back is the gap of the way there. Two independent ways, exp(-2 tau), are rejected.
    """
    beams = {zenith: rays(zenith) for zenith in (0.0, 30.0, 60.0)}
    hits = meet(leaves_of(layer(leaf_angles)), *beams.values())
    # Sums of squared z-scores of 15 bins.
    one_way = two_ways = across = 0.0
    for zenith, (distance, cosine) in zip(beams, hits):
        returned = np.where(distance < FAR, 0.4 * cosine, 0.0)
        # Leaves reach out of the first and the last bin.
        edges = np.array([-1.0, 0.4, 0.8, 1.2, 1.6, 10.0]) / np.cos(np.deg2rad(zenith))
        path = np.clip(edges, 0.0, THICKNESS / np.cos(np.deg2rad(zenith)))
        in_bin = np.stack([np.where(np.digitize(distance, edges) - 1 == k, returned, 0.0) for k in range(5)])
        mean, stderr = in_bin.mean(axis=1), in_bin.std(axis=1) / np.sqrt(len(distance))
        g, square = projection(leaf_angles, zenith)
        passed = np.exp(-g * 1.5 / THICKNESS * path)
        expected = -0.4 * square / g * np.diff(passed)
        one_way += np.sum(((mean - expected) / stderr) ** 2)
        two_ways += np.sum(((mean + 0.2 * square / g * np.diff(passed**2)) / stderr) ** 2)
        across += np.sum(((mean - expected * g / square) / stderr) ** 2)
    assert 1e-4 < stats.chi2.sf(one_way, 15) < 1.0 - 1e-4
    # Nor would leaves that are all across the beam return that.
    assert stats.chi2.sf(min(two_ways, across), 15) < 1e-6


@pytest.mark.slow
def test_returns_vary_more_with_larger_leaves():
    """Variance of the gap fraction of footprints of 0.5 m; of voxels it is the same in all."""
    start, direction = rays(0.0, spacing=0.05)
    footprint = np.unique(np.floor(start[:, :2] / 0.5), axis=0, return_inverse=True)[1]
    variances = []
    for area in (0.002, 0.02, 0.2):
        ((distance, _),) = meet(leaves_of(layer(), area), (start, direction))
        variances.append(np.var(np.bincount(footprint, distance >= FAR) / np.bincount(footprint)))
    n = footprint.max()
    for smaller, larger in itertools.pairwise(variances):
        assert stats.f.sf(larger / smaller, n, n) < 1e-6


def test_numbers_of_leaves_are_poisson_by_voxel():
    density = np.zeros((8, 8, 8))
    density[::2] = np.linspace(0.1, 2.0, 8)
    voxels = jl.VoxelMap.from_lad(density, voxel_size=(0.5, 1.0, 2.0), origin=(4e5, 5.2e6, 100.0))
    surface = leaves_of(voxels, 0.01)
    centre = surface.corners().reshape(-1, 6, 3)
    centre = 0.5 * (centre.max(axis=1) + centre.min(axis=1))
    index = np.floor((centre - voxels.origin) / np.array([0.5, 1.0, 2.0])).astype(int)
    # In coordinates of a map corners are rounded to 1e-9 m, and places to single precision.
    counts = np.zeros((8, 8, 8))
    np.add.at(counts, tuple(np.clip(index, 0, 7).T), 1)
    assert counts[1::2].sum() <= 0.001 * counts.sum()
    expected = density[::2] * 1.0 / 0.01
    chi = np.sum((counts[::2] - expected) ** 2 / expected)
    assert 1e-4 < stats.chi2.cdf(chi, expected.size) < 1 - 1e-4
    assert stats.chi2.sf(np.sum((counts[::2] - 2 * expected) ** 2 / expected / 2), expected.size) < 1e-9
    # Two triangles of half a leaf each.
    corners = surface.corners()
    area = 0.5 * np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    np.testing.assert_allclose(area, 0.005, rtol=1e-3)


def test_leaves_have_the_optics_of_a_model():
    surface = jl.leaf_mesh(layer(lai=0.1), key=KEY)
    prospect = jl.Prospect()(np.array([532.0, 1064.3]))
    for field, expected in zip((surface.reflectance, surface.transmittance), prospect):
        np.testing.assert_allclose(field["leaf"](np.array([532.0, 1064.3])), expected, rtol=1e-4)
    assert surface.materials == ("leaf",)
    assert surface.two_sided
    flat = leaves_of(layer(lai=0.1))
    assert (float(flat.reflectance["leaf"]), float(flat.transmittance["leaf"])) == pytest.approx((0.4, 0.35))


def test_the_key_decides():
    first, again = (leaves_of(layer(lai=0.1), key=jax.random.key(1)) for _ in range(2))
    other = leaves_of(layer(lai=0.1), key=jax.random.key(2))
    np.testing.assert_array_equal(first.vertices, again.vertices)
    assert first.vertices.shape != other.vertices.shape or np.any(first.vertices != other.vertices)


# -- trees and stands --------------------------------------------------------------------------------------


def leaf_areas(surface):
    """Return the one-sided leaf area of each copy, m2."""
    corners = surface.corners().reshape(len(surface.instances), -1, 3, 3)
    cross = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    return 0.5 * np.linalg.norm(cross, axis=2).sum(axis=1)


def test_a_tree_has_leaves_in_its_clumps():
    tree = jl.turtle("F[+FJ]FJ", angle=45, length=2.0, radius=0.1).with_bud_radius(0.3)
    surface = leaves_of(tree, 1e-3, clump_leaf_area=2.0)
    total = leaf_areas(surface)[0]
    assert abs(total - 4.0) < SIGMAS * np.sqrt(4.0 * 1e-3)
    assert abs(total - 2.0) > 2 * SIGMAS * np.sqrt(4.0 * 1e-3)
    corners = surface.corners().reshape(-1, 6, 3)
    centre = 0.5 * (corners.max(axis=1) + corners.min(axis=1))
    distance = np.linalg.norm(centre[:, None] - tree.bud_position, axis=2)
    assert abs(np.sum(distance[:, 0] < distance[:, 1]) - 2000.0) < SIGMAS * np.sqrt(2000.0)
    # Uniform in the volume of the sphere, not in its radius.
    share = (distance.min(axis=1) / 0.3) ** 3
    assert stats.kstest(share, "uniform").pvalue > 1e-4
    assert stats.kstest(np.cbrt(share), "uniform").pvalue < 1e-9
    # Without an area, a leaf for each clump.
    shrub = jl.grow(jl.shrub(height=1.0, stems=1))
    n = len(shrub.bud_radius)
    assert abs(leaves_of(shrub, 2e-4).n_triangles / 2 - n) < SIGMAS * np.sqrt(n)


def test_copies_of_a_stand_share_leaves():
    habit = jl.shrub(height=1.5, stems=1)
    stand = jl.stand_of_leaf_area(
        1.0, (1.0, 2.0, 3.0), habit, density=300.0, area=(20.0, 20.0), individuals=2
    )
    surfaces = leaves_of(stand, 1e-3)
    assert len(surfaces) == 2
    assert sum(len(surface.instances) for surface in surfaces) == len(stand)
    total = sum(leaf_areas(surface).sum() for surface in surfaces)
    leaves = sum(surface.n_triangles for surface in surfaces) / 2
    assert abs(total - 400.0) < SIGMAS * 400.0 / np.sqrt(leaves)
    for surface in surfaces:
        # Areas as the crowns', and each copy where its tree is.
        numbers = [int(np.argmin(np.abs(stand.position - s).sum(axis=1))) for s in surface.instances.shift]
        ratio = leaf_areas(surface) / stand.tree_leaf_area[numbers]
        np.testing.assert_allclose(ratio, ratio[0], rtol=1e-4)
        np.testing.assert_allclose(
            surface.instances.scale**2 * 1e-3 / np.mean(surface.instances.scale**2),
            leaf_areas(surface) / (surface.n_triangles / 2),
            rtol=1e-4,
        )
        for number, box in zip(numbers, surface.bounds()):
            buds = stand[number].bud_position
            assert np.all(box[0] < buds.min(axis=0) + 0.3)
            assert np.all(box[1] > buds.max(axis=0) - 0.3)
    # A scene takes them as they are, beside other meshes.
    scene = jl.Scene(meshes=[leaves_of(layer(lai=0.1)), surfaces])
    assert len(scene.meshes) == 3


def test_copies_like_no_other_are_one_mesh():
    tree = jl.grow(jl.shrub(height=1.0, stems=1))
    place = [(0, 0, 0), (4, 0, 0), (8, 0, 0), (12, 0, 0)]
    scale = [(1, 1, 1), (1, 1, 1), (1, 2, 1), (2, 1, 1)]
    stand = jl.Stand(tree, place, scale=scale, leaf_area=[1e-3, 1e-3, 1e-3, 2e-3])
    shared, single = leaves_of(stand, 1e-4)
    assert (len(shared.instances), len(single.instances)) == (2, 1)
    expected = 3e-3 * len(tree.bud_radius)
    assert abs(leaf_areas(single).sum() - expected) < SIGMAS * np.sqrt(expected * 1e-4)
    assert np.all(single.bounds()[0, 0] > (4.0, -4.0, -1.0))


# -- scans and waveforms -----------------------------------------------------------------------------------


def plot_of_crowns(lai_factor=1.0):
    """Ellipsoids of leaves from about 2 m to 6 to 11 m over 40 m by 40 m, in voxels of 0.5 m."""
    random = np.random.default_rng(1)
    place = 0.5 * np.moveaxis(np.indices((80, 80, 24)), 0, -1) + 0.25
    density = np.zeros((80, 80, 24))
    for x, y in itertools.product(np.arange(2.5, 40.0, 5.0), repeat=2):
        stands, dx, dy, radius, top, bottom = random.uniform(
            [0, -1, -1, 1.2, 6.0, 1.8], [1, 1, 1, 2.2, 11, 3]
        )
        if stands < 0.7:
            centre = np.array([x + dx, y + dy, 0.5 * (top + bottom)])
            inside = (((place - centre) / [radius, radius, 0.5 * (top - bottom)]) ** 2).sum(axis=-1) < 1.0
            density[inside] = 0.7 * lai_factor
    return jl.VoxelMap.from_lad(density, voxel_size=0.5)


RINGS = ((0.0, 30.0), (50.0, 65.0), (80.0, 90.0))
SENSOR = np.array([20.0, 20.0, 1.5])


def scan_of_rings(n):
    """Return n shots of a VZ-400 in each of three rings of zenith angles, even by solid angle."""
    random = np.random.default_rng(0)
    up = [random.uniform(np.cos(np.deg2rad(b)), np.cos(np.deg2rad(a)), n) for a, b in RINGS]
    zenith, azimuth = 180.0 - np.rad2deg(np.arccos(np.concatenate(up))), random.uniform(0.0, 360.0, 3 * n)
    sensor = np.tile(SENSOR, (3 * n, 1))
    return jl.Survey(jl.instrument("RIEGL VZ-400"), sensor=sensor, zenith=zenith, azimuth=azimuth)


def true_gaps(voxels, survey):
    """Return the mean gap probability of the axes of shots in each ring, by steps of 2 cm."""
    depth = np.zeros(len(survey))
    for distance in np.arange(0.01, 40.0, 0.02):
        index = np.floor((SENSOR + distance * survey.direction) / 0.5).astype(int)
        inside = np.all((index >= 0) & (index < voxels.shape), axis=1)
        depth[inside] += 0.02 * np.asarray(voxels.leaf, float)[tuple(index[inside].T)]
    return np.exp(-depth).reshape(3, -1).mean(axis=1)


def shares_without_return(survey, scene, least_reflectance):
    many = jl.simulate_many(survey, scene, key=KEY, rtol=0.3, max_orders=1)
    returns = many.returns()
    is_hit = np.zeros(len(survey), bool)
    is_hit[returns.shot[returns.reflectance >= least_reflectance]] = True
    return 1.0 - is_hit.reshape(3, -1).mean(axis=1)


@pytest.mark.slow
def test_a_terrestrial_scan_recovers_the_gap_fraction():
    """Shots without a return brighter than 0.05: the edge of a leaf returns a little of a beam."""
    voxels, survey = plot_of_crowns(), scan_of_rings(3000)
    true, least = true_gaps(voxels, survey), 0.05
    over_leaves = shares_without_return(survey, jl.Scene(meshes=[leaves_of(voxels)]), least)
    np.testing.assert_allclose(over_leaves, true, atol=0.02)
    # Voxels return the expected light, and half of the leaves pass more.
    with pytest.warns(UserWarning, match="see crowns alone"):
        over_voxels = shares_without_return(survey, jl.Scene(canopy=jl.Canopy(voxels, leaf=LEAF)), least)
    assert np.all(over_voxels < true - 0.05)
    few, half = scan_of_rings(500), jl.Scene(meshes=[leaves_of(plot_of_crowns(0.5))])
    assert np.all(shares_without_return(few, half, least) > true_gaps(voxels, few) + 0.02)


@pytest.mark.slow
@pytest.mark.parametrize("zenith", [0.0, 30.0, 60.0])
def test_the_mean_waveform_is_that_of_the_voxels(zenith):
    """200 shots through leaves of their own: as many realisations."""
    voxels = jl.VoxelMap.from_lad(
        np.full((16, 8, 4), 0.75), voxel_size=(2.0, 2.0, 0.5), origin=(0.0, 0.0, 4.0)
    )
    ground = jl.Ground(reflectance=0.3)
    x, y = (a.ravel() for a in np.meshgrid(np.arange(1.0, 21.0), np.arange(2.5, 12.5)))
    # Beams travel to the east, and are within the map above their places on the ground.
    x = x + (17.0 if zenith == 60.0 else 4.0)
    lidar = jl.Lidar(altitude=100.0, divergence=2.0, pulse=jl.GaussianPulse(fwhm=1.0))
    survey = jl.Survey(lidar, np.stack([x, y], axis=1), zenith=zenith, azimuth=90.0)

    def simulated(survey, rtol, **scene):
        return jl.simulate_many(survey, jl.Scene(ground=ground, **scene), key=KEY, rtol=rtol, max_orders=1)

    middle = survey.subset(np.array([95]))
    one_way, two_ways = (
        simulated(middle, 0.003, canopy=jl.Canopy(voxels, leaf=LEAF, hotspot=hotspot))
        for hotspot in (True, False)
    )
    shots = simulated(survey, 0.1, meshes=[leaves_of(voxels)])
    # Records of leaves, which reach out of their voxels, are longer.
    times = np.intersect1d(shots.time.round(3), one_way.time.round(3))
    wave = shots.reflectance[:, 0, np.isin(shots.time.round(3), times)].astype(float)
    one_way, two_ways = (
        many.reflectance[0, 0, np.isin(many.time.round(3), times)] for many in (one_way, two_ways)
    )
    is_lit = one_way > 0.01 * one_way.max()
    mean, stderr = wave.mean(axis=0)[is_lit], wave.std(axis=0)[is_lit] / np.sqrt(len(wave))
    assert is_lit.sum() > 10
    assert np.abs((mean - one_way[is_lit]) / stderr).max() < SIGMAS
    assert np.abs((mean - two_ways[is_lit]) / stderr).max() > 1.5 * SIGMAS


# -- refused input -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"leaf_area": 0.0}, r"leaf_area = 0 is outside"),
        ({"leaf_area": -0.1}, r"leaf_area = -0.1 is outside"),
        ({"leaf_area": np.nan}, r"leaf_area = nan"),
        ({"leaf_area": 1e-9}, r"leaf_area = 1e-09 m2 makes about 90,000,000,000 leaves of 90 m2"),
        ({"leaf_area": 1e9}, r"leaf_area = 1e\+09 m2, but the canopy has 90 m2 of leaves, of which none"),
        ({"shape": "oak"}, r"shape = 'oak' is none of 'rhombus', 'ellipse', 'needle'"),
        ({"leaf_angles": "flat"}, r"leaf_angles = 'flat' is none of"),
        ({"clump_leaf_area": 0.1}, r"clump_leaf_area = 0.1, but voxels have no leaf clumps"),
        ({"voxels": layer(lai=0.0)}, r"has no leaf area; admissible is a canopy with leaf"),
        ({"voxels": jl.VoxelMap(None, np.ones((1, 1, 1)), 1.0, 0.0)}, r"has no leaf area"),
        ({"voxels": jl.turtle("F", angle=0, length=1.0, radius=0.1)}, r"has no leaf area"),
        ({"voxels": jl.Stand(jl.turtle("F", angle=0, length=1.0, radius=0.1), [(0, 0, 0)])}, "no leaf area"),
    ],
)
def test_refused_numbers(change, message):
    arguments = {"voxels": layer(), "key": KEY, "leaf": LEAF} | change
    with pytest.raises(ValueError, match=message):
        jl.leaf_mesh(arguments.pop("voxels"), **arguments)


def test_memory_is_that_of_the_machine(monkeypatch):
    monkeypatch.setattr(module, "machine_memory", lambda: 1e7)
    with pytest.raises(
        ValueError, match=r"makes about 18,000 leaves .* admissible on this machine are 8,333"
    ):
        leaves_of(layer())
