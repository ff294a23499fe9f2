"""Values outside their range are detected while JAX is tracing, as constructors refuse concrete ones."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl
from jaxlidar._fields.ranges import SUM_OF_FRACTIONS, is_outside
from jaxlidar.extend import Range, inadmissible, reasons

CUBE = np.full((2, 2, 2), 0.5)
CONSTRUCTORS = {
    "Ground.slope": (lambda x: jl.Ground(slope=x), (0.0, 45.0, 89.9), (90.0, 200.0)),
    "Ground.height": (lambda x: jl.Ground(height=x), (-1e4, 0.0), ()),
    "Ground.reflectance": (lambda x: jl.Ground(reflectance=x), (0.0, 1.0), (-0.01, 1.01)),
    "Lidar.zenith": (lambda x: jl.Lidar(zenith=x), (0.0, 89.0), (89.5, 200.0)),
    "Lidar.altitude": (lambda x: jl.Lidar(altitude=x), (1.0, 1e6), (0.0, -5.0)),
    "Lidar.field_of_view": (lambda x: jl.Lidar(field_of_view=x), (1.0,), (0.0, -1.0)),
    "Plate.coverage": (lambda x: jl.Plate(1.0, 0.2, coverage=x), (0.0, 1.0), (-0.1, 1.1)),
    "Plate.reflectance + transmittance": (lambda x: jl.Plate(1.0, x, 0.6), (0.0, 0.4), (0.5, 0.9)),
    "LeafOptics.reflectance + transmittance": (lambda x: jl.LeafOptics(0.6, x), (0.0, 0.4), (0.5, 0.9)),
    "Prospect.N": (lambda x: jl.Prospect(N=x), (1.0, 3.0), (0.9, -1.0)),
    "Prospect.Cab": (lambda x: jl.Prospect(Cab=x), (0.0, 80.0), (-0.1,)),
    "Prospect.Car": (lambda x: jl.Prospect(Car=x), (0.0, 20.0), (-0.1,)),
    "Prospect.Cant": (lambda x: jl.Prospect(Cant=x), (0.0, 20.0), (-0.1,)),
    "Prospect.Cbrown": (lambda x: jl.Prospect(Cbrown=x), (0.0, 1.0), (-0.1,)),
    "Prospect.Cw": (lambda x: jl.Prospect(Cw=x), (0.0, 0.02), (-0.01,)),
    "Prospect.Cm": (lambda x: jl.Prospect(Cm=x), (0.0, 0.02), (-0.01,)),
    "Spectrum.scale * reflectance": (
        lambda x: jl.Spectrum([400.0, 900.0], [0.2, 0.5], scale=x),
        (0.0, 2.0),
        (2.1, 5.0),
    ),
    "VoxelMap.leaf": (lambda x: jl.VoxelMap.from_extinction(leaf=x * CUBE, voxel_size=1.0), (0.0,), (-1.0,)),
    "Isotropic.albedo": (lambda x: jl.Isotropic(x), (0.0, 1.0), (-0.1, 1.1)),
    "HenyeyGreenstein.g": (lambda x: jl.HenyeyGreenstein(0.5, x), (-0.9, 0.9), (1.0, -1.0)),
    "Specular.roughness": (lambda x: jl.Specular(x), (0.0, 0.5), (-0.1, 0.6)),
    "Atmosphere.visibility": (lambda x: jl.Atmosphere(visibility=x), (5.0, 23.0), (0.0, -1.0)),
    "Receiver.saturation": (lambda x: jl.Receiver(saturation=x), (1e-15,), (0.0, -1.0)),
    "GaussianPulse.fwhm": (lambda x: jl.GaussianPulse(x), (0.0, 6.0), (-1.0,)),
    "RectangularPulse.length": (lambda x: jl.RectangularPulse(x), (0.0, 6.0), (-1.0,)),
    "LeafAngles.probability": (lambda x: jl.LeafAngles(x * np.ones(90)), (1.0,), (-1.0,)),
}


@pytest.mark.parametrize("name", list(CONSTRUCTORS))
def test_traced_and_concrete_values_have_one_range(name):
    make, good, bad = CONSTRUCTORS[name]
    field = name.partition(".")[2]

    @jax.jit
    def checks(x):
        return inadmissible(make(x)), reasons(make(x))[field]

    for x in good:
        assert not inadmissible(make(x))
        assert not any(checks(x))
    for x in bad:
        with pytest.raises(ValueError, match="outside the admissible range"):
            make(x)
    for x in (*bad, np.nan, np.inf):
        assert all(checks(x)), x


def test_angles_from_the_vertical_may_pass_through_zero_where_they_are_traced():
    make, _, _ = CONSTRUCTORS["Ground.slope"]
    with pytest.raises(ValueError, match="slope = -1"):
        make(-1.0)
    assert not jax.jit(lambda x: inadmissible(make(x)))(-1.0)
    assert jax.jit(lambda x: inadmissible(make(x)))(-90.0)


def test_waveforms_of_inadmissible_values_are_nan():
    lidar, key = jl.Lidar(), jax.random.key(0)
    plan = jl.plan(lidar, jl.Scene(ground=jl.Ground(slope=5.0)), window=(-60.0, 60.0))

    @jax.jit
    @jax.value_and_grad
    def total(slope):
        scene = jl.Scene(ground=jl.Ground(slope=slope))
        return jl.simulate(lidar, scene, key=key, plan=plan).reflectance.sum()

    assert np.isfinite(total(5.0)).all()
    assert np.isnan(total(200.0)[0])
    # In a batch the other scenes are not affected.
    values, _ = jax.vmap(total)(jnp.array([5.0, 200.0]))
    assert np.isnan(values).tolist() == [False, True]


def test_every_reason_has_a_path():
    @jax.jit
    def reasons_of(slope, coverage, zenith, bark):
        canopy = jl.Canopy(jl.VoxelMap.from_extinction(bark=CUBE, voxel_size=1.0), bark=bark, hotspot=False)
        plates = (jl.Plate(4.0, 0.2), jl.Plate(5.0, 0.2, coverage=coverage))
        return reasons((jl.Lidar(zenith=zenith), jl.Scene(canopy, plates, jl.Ground(slope=slope))))

    verdicts = reasons_of(200.0, 2.0, 90.0, 1.5)
    wrong = {name for name, is_so in verdicts.items() if is_so}
    assert wrong == {"[0].zenith", "[1].ground.slope", "[1].plates[1].coverage", "[1].canopy.bark"}
    assert not any(reasons_of(20.0, 0.5, 1.0, 0.5).values())
    # A spectrum as reflectance has ranges of its fields.
    gravel = jl.Ground(reflectance=jl.spectrum("gravel"))
    assert "ground.reflectance.scale" in reasons(jl.Scene(ground=gravel))


def test_values_of_a_batch_and_of_wavelengths_are_checked_one_by_one():
    slopes = jnp.array([0.0, 95.0, 30.0, jnp.nan])
    assert jax.vmap(lambda s: inadmissible(jl.Ground(slope=s)))(slopes).tolist() == [False, True, False, True]
    plate = jax.jit(lambda r: inadmissible(jl.Plate(0.0, r, jnp.array([0.5, 0.1]))))
    assert not plate(jnp.array([0.5, 0.9]))
    assert plate(jnp.array([0.9, 0.5]))
    with pytest.raises(ValueError, match="3 values and 2 values"):
        plate(jnp.array([0.1, 0.1, 0.1]))


def test_values_out_of_order_are_detected():
    lidar = jax.jit(lambda x: inadmissible(jl.Lidar(wavelength=x)))
    pulse = jax.jit(lambda x: inadmissible(jl.SampledPulse(x, [0.0, 1.0, 0.0])))
    for is_inadmissible, good in ((lidar, [532.0, 1064.0, 1550.0]), (pulse, [-1.0, 0.0, 2.0])):
        assert not is_inadmissible(jnp.array(good))
        assert is_inadmissible(jnp.array([good[0], good[2], good[1]]))
        assert is_inadmissible(jnp.array([good[0], good[1], good[1]]))
    spectrum = jax.jit(lambda x: inadmissible(jl.Spectrum(x, [0.1, 0.2, 0.3])))
    assert spectrum(jnp.array([500.0, 700.0, 600.0]))


def test_values_changed_after_construction_are_detected():
    ground = eqx.tree_at(lambda g: g.slope, jl.Ground(), jnp.asarray(200.0))
    assert inadmissible(ground)


def test_rounding_at_a_limit_is_admissible(precision):
    for limit, admissible in ((1.0, Range(0.0, 1.0)), (89.0, Range(0.0, 89.0)), (0.0, Range(0.0))):
        x = jnp.asarray(limit, precision)
        eps = float(jnp.finfo(precision).eps)
        for step in (-1, 1):
            assert not is_outside(x + step * eps * max(limit, 1.0), Range(limit, limit))
        assert not is_outside(x, admissible)
    assert is_outside(jnp.asarray(1.0 + 1e-4, precision), SUM_OF_FRACTIONS)
    assert is_outside(jnp.asarray(0.0, precision), Range(0.0, low_open=True))


def test_objects_without_ranges_are_admissible():
    assert not inadmissible((jl.Lambertian(), None, 3.0, [jl.Scene()], {"a": "text"}))
