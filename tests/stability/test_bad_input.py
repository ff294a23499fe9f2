"""Inadmissible input is a ValueError at construction that names the field, and the value or the range."""

import jax
import numpy as np
import pytest

import jaxlidar as jl

KEY = jax.random.key(0)
CUBE = np.full((2, 2, 2), 0.5)
GRID = {"voxel_size": 1.0}
LEAF = jl.LeafOptics(reflectance=0.4, transmittance=0.3)
LOW = jl.VoxelMap.from_extinction(leaf=CUBE, **GRID)
GROUND = jl.Scene(ground=jl.Ground())


def voxels(**changes):
    return jl.VoxelMap.from_extinction(**({"leaf": CUBE} | GRID | changes))


DARK, PALE = (jl.Spectrum([w, w + 800.0], [0.2, r]) for w, r in ((400.0, 0.4), (900.0, 0.9)))

CASES = {
    "negative extinction": (lambda: voxels(leaf=-CUBE), r"leaf = -0.5 .*\[0, inf\)"),
    "NaN extinction": (lambda: voxels(leaf=CUBE * np.nan), "leaf = nan"),
    "infinite extinction": (lambda: voxels(bark=CUBE * np.inf), "bark = inf"),
    "shapes that differ": (lambda: voxels(bark=np.ones((2, 2, 3))), "leaf and bark have the shapes"),
    "no material": (lambda: voxels(leaf=None), "leaf and bark are both None"),
    "no voxels": (lambda: voxels(leaf=np.zeros((0, 2, 2))), "shape"),
    "voxel size": (lambda: voxels(voxel_size=(1.0, -1.0, 1.0)), r"voxel_size = -1 .*\(0, inf\)"),
    "voxel size of two": (lambda: voxels(voxel_size=(1.0, 1.0)), r"voxel_size has shape \(2,\)"),
    "origin of two": (lambda: voxels(origin=(0.0, 0.0)), r"origin has shape \(2,\)"),
    "origin": (lambda: voxels(origin=(0.0, np.nan, 0.0)), "origin = nan"),
    "p above 1": (
        lambda: jl.VoxelMap.from_probability(leaf=1.2 * np.ones((1, 1, 1)), **GRID),
        r"leaf = 1.2 .*\[0, 1\]",
    ),
    "p below 0": (lambda: jl.VoxelMap.from_probability(bark=-CUBE, **GRID), "bark = -0.5"),
    "negative LAD": (lambda: jl.VoxelMap.from_lad(-CUBE, **GRID), "lad = -0.5"),
    "leaf angles": (lambda: jl.VoxelMap.from_lad(CUBE, leaf_angles="flat", **GRID), "'flat' is none of"),
    "no leaf angles": (lambda: jl.LeafAngles(np.zeros(90)), r"sum of probability = 0 .*\(0, inf\)"),
    "beta angles": (lambda: jl.LeafAngles.beta(45.0, 60.0), "std = 60"),
    "R + T": (lambda: jl.LeafOptics(reflectance=0.7, transmittance=0.5), "reflectance . transmittance = 1.2"),
    "plate R + T": (lambda: jl.Plate(height=0.0, reflectance=0.7, transmittance=0.5), r"= 1.2 .*\[0, 1"),
    "plate R + T, a spectrum": (lambda: jl.Plate(height=0.0, reflectance=PALE, transmittance=0.2), "= 1.1 "),
    "plate R + T, a spectrum of T": (lambda: jl.Plate(0.0, reflectance=0.2, transmittance=PALE), "= 1.1 "),
    # At 1200 nm, where the darker one ends.
    "plate R + T, spectra": (
        lambda: jl.Plate(0.0, DARK, jl.Spectrum([900.0, 1200.0], [0.2, 0.7])),
        r"reflectance \+ transmittance = 1.1 ",
    ),
    "coverage": (lambda: jl.Plate(height=0.0, reflectance=0.5, coverage=1.5), "coverage = 1.5"),
    "plate transmission": (
        lambda: jl.Plate(height=0.0, reflectance=0.5, transmission="odd"),
        "'odd' is none of",
    ),
    "ground reflectance": (lambda: jl.Ground(reflectance=1.5), r"reflectance = 1.5 .*\[0, 1\]"),
    "ground height": (lambda: jl.Ground(height=np.nan), "height = nan"),
    "slope": (lambda: jl.Ground(slope=90.0), r"slope = 90 .*\[0, 90\)"),
    "roughness": (lambda: jl.Specular(roughness=-0.1), "roughness = -0.1"),
    "albedo": (lambda: jl.Isotropic(albedo=1.1), "albedo = 1.1"),
    "leaf missing": (lambda: jl.Canopy(LOW, hotspot=False), "leaf = None"),
    "bark missing": (lambda: jl.Canopy(voxels(bark=CUBE), leaf=LEAF, hotspot=False), "bark = None"),
    "bark": (lambda: jl.Canopy(voxels(bark=CUBE), leaf=LEAF, bark=2.0, hotspot=False), "bark = 2"),
    "sides": (lambda: jl.Canopy(LOW, leaf=LEAF, sides="closed", hotspot=False), "'closed' is none of"),
    "transmission": (
        lambda: jl.Canopy(LOW, leaf=LEAF, transmission="none", hotspot=False),
        "'none' is none of",
    ),
    "rtol": (lambda: jl.simulate(jl.Lidar(), GROUND, key=KEY, rtol=0.0), "rtol = 0"),
    "rtol with a plan": (
        lambda: jl.simulate(jl.Lidar(), GROUND, key=KEY, plan=jl.plan(jl.Lidar(), GROUND), rtol=5.0),
        r"rtol = 5 is outside the admissible range \(0, 1\)",
    ),
    "max_seconds": (lambda: jl.simulate(jl.Lidar(), GROUND, key=KEY, max_seconds=0.0), "max_seconds = 0"),
    "atol": (lambda: jl.simulate(jl.Lidar(), GROUND, key=KEY, atol=-1.0), "atol = -1"),
    "photons": (lambda: jl.simulate(jl.Lidar(), GROUND, key=KEY, n_photons=0), "n_photons = 0"),
    "orders": (lambda: jl.plan(jl.Lidar(), GROUND, max_orders=0), "max_orders = 0"),
    "step": (lambda: jl.plan(jl.Lidar(), GROUND, max_step=-1.0), "max_step = -1"),
    "window": (lambda: jl.plan(jl.Lidar(), GROUND, window=(5.0, 1.0)), "window"),
    "bin width": (lambda: jl.plan(jl.Lidar(), GROUND, bin_width=0.0), "bin_width = 0"),
    "footprint": (lambda: jl.plan(jl.Lidar(), GROUND, footprint="odd"), "'odd' is none of"),
    "scene above the sensor": (
        lambda: jl.plan(jl.Lidar(altitude=10.0), jl.Scene(ground=jl.Ground(height=20.0))),
        "altitude = 10",
    ),
    "values per wavelength": (
        lambda: jl.plan(
            jl.Lidar(wavelength=(532.0, 1064.0)), jl.Scene(ground=jl.Ground(reflectance=[0.1, 0.2, 0.3]))
        ),
        "ground reflectance",
    ),
    "plate R + T at the lidar's wavelengths": (
        lambda: jl.plan(
            jl.Lidar(wavelength=(532.0, 1064.0)),
            jl.Scene(plates=(jl.Plate(1.0, DARK, transmittance=[0.9, 0.0]),)),
        ),
        r"plate reflectance \+ transmittance = 1.13",
    ),
    "spectrum": (lambda: jl.spectrum("bark of gold"), "no bundled spectrum"),
}


@pytest.mark.parametrize("name", list(CASES))
def test_refused(name):
    make, words = CASES[name]
    with pytest.raises(ValueError, match=words):
        make()


def test_traced_geometry_needs_a_plan():
    def height(h):
        return jl.simulate(jl.Lidar(), jl.Scene(ground=jl.Ground(height=h)), key=KEY).reflectance.sum()

    with pytest.raises(ValueError, match="make a plan outside"):
        jax.grad(height)(1.0)


def test_a_plan_that_does_not_cover_the_scene_is_refused():
    lidar, low = jl.Lidar(), jl.Scene(ground=jl.Ground())
    plan = jl.plan(lidar, low)
    with pytest.raises(ValueError, match=r"plan does not fit: .*the scene reaches to 1 m"):
        jl.simulate(lidar, jl.Scene(ground=jl.Ground(height=1.0)), key=jax.random.key(0), plan=plan)
    plate = jl.Scene(plates=(jl.Plate(height=0.0, reflectance=0.3, transmittance=0.2),))
    with pytest.raises(ValueError, match=r"also has plate\.R, plate\.T"):
        jl.simulate(lidar, plate, key=jax.random.key(0), plan=plan)


def test_a_spectrum_and_a_transmittance_that_fit():
    """Their sum is checked where both are defined; values by wavelength are checked with the lidar."""
    jl.Plate(height=0.0, reflectance=PALE, transmittance=0.1)
    jl.Plate(height=0.0, reflectance=DARK, transmittance=jl.Spectrum([1200.0, 2000.0], [0.6, 0.9]))
    jl.Plate(height=0.0, reflectance=PALE, transmittance=[0.5, 0.1])

    def passed(scale):
        spectrum = jl.Spectrum(DARK.wavelength, DARK.reflectance, scale=scale)
        return jl.Plate(height=0.0, reflectance=spectrum, transmittance=0.9).transmittance

    assert float(jax.jit(passed)(1.0)) == pytest.approx(0.9)
