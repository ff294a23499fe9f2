"""Measures of the hard cases: families of simulations of one structure, compiled once for all their cases.

A family has its usual numbers and a function that makes its measure: from a dict of scalars to a vector. The
measure includes the plan, made for the precision in use, which holds for all numbers of the family. The first
families are simulations, the last ones components of the library.
"""

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxlidar as jl
from jaxlidar.trace.march.voxel_traversal import make_medium, march_to_depths
from tests.helpers import SINGLE_SAMPLE, single_sample_lidar
from tests.stability import hard_answers as answers

KEY = jax.random.key(24)
DOUBLE_PRECISION, BOTH_PRECISIONS = ("float64",), ("float32", "float64")


@dataclass(frozen=True)
class Family:
    """Simulations of one structure.

    - `make`: returns the measure.
    - `answer`: closed form of the measure (see `hard_answers`).
    - `bounds`, `slopes`: errors of values and of derivatives admitted in single and double precision,
      relative to the largest output.
    - `slow`: precisions that run with `-m slow` only.
    """

    usual: Mapping[str, float]
    make: Callable[[], Callable[[dict], Any]]
    answer: Callable[[Any], list]
    bounds: tuple[float, float]
    slopes: tuple[float, float]
    slow: tuple[str, ...] = ()


def simulation(build, usual, outputs, **settings):
    """Return a measure: one trace of the scene and lidar that `build` makes of numbers.

    `widest` are the numbers for which the plan is made, where they differ from the usual ones.
    """
    widest = usual | settings.pop("widest", {})
    plan = jl.plan(*build({k: jnp.asarray(v, float) for k, v in widest.items()}), **settings)

    def measure(p):
        setup = jl.make_setup(*build(p), plan)
        return outputs(setup, jl.trace_scene(setup, KEY))

    return measure


def sample_values(setup, response):
    return jl.total_reflectance(response, setup)[0]


def sample_sum(setup, response):
    return jnp.sum(sample_values(setup, response))[None]


def component_sums(*names):
    """Return a function for the sums of named components, and of the energy budget (`"shares"`)."""

    def outputs(setup, response):
        wave = jl.waveform_of(response, setup)
        absorbed = [v[0] for k, v in wave.energy_budget.items() if k.startswith("absorbed")]
        sums = {
            "shares": sum(wave.energy_budget.values())[0],
            "absorbed": sum(absorbed),
            "all": wave.reflectance.sum(),
        }
        return jnp.stack([sums[n] if n in sums else wave.components[n].sum() for n in names])

    return outputs


# -- ground ------------------------------------------------------------------------------------------------

OVER_GROUND = {
    "rho": 0.3,
    "height": 0.0,
    "slope": 0.0,
    "zenith": 0.0,
    "altitude": 1000.0,
    "divergence": 0.3,
    "aperture": 0.2,
    "fwhm": 6.0,
    "jitter": 0.0,
    "fov": 100.0,
}


def over_ground(p, interval=1.0):
    lidar = jl.Lidar(
        pulse=jl.GaussianPulse(fwhm=p["fwhm"]),
        jitter=p["jitter"],
        altitude=p["altitude"],
        divergence=p["divergence"],
        aperture=p["aperture"],
        zenith=p["zenith"],
        field_of_view=p["fov"],
        sampling_interval=interval,
    )
    # The ground falls away from the sensor: zenith and slope lie in one plane.
    return lidar, jl.Scene(
        ground=jl.Ground(reflectance=p["rho"], height=p["height"], slope=p["slope"], aspect=180.0)
    )


def ground_family(interval, half, bounds, slopes, slow=()):
    times = np.arange(-half, half + interval / 2, interval)

    def make():
        build = functools.partial(over_ground, interval=interval)
        return simulation(build, OVER_GROUND, sample_values, window=(-half, half), widest={"height": 10.0})

    def answer(n):
        # Times of the samples as the plan has them, counted from the first.
        exact = [answers.mpf(str(interval)) * i - answers.mpf(str(half)) for i in range(times.size)]
        return answers.ground(n, exact)

    return Family(OVER_GROUND, make, answer, bounds, slopes, slow)


def measure_short_pulse():
    def build(p):
        lidar = jl.Lidar(pulse=jl.RectangularPulse(length=p["length"]), jitter=p["jitter"], divergence=0.0)
        return lidar, jl.Scene(ground=jl.Ground(reflectance=p["rho"], height=p["height"]))

    # A fixed width of bins: the plan would choose it by the length of the pulse, which the cases change.
    return simulation(build, SHORT_PULSE, sample_values, window=(-20.0, 20.0), bin_width=0.25)


SHORT_PULSE = {"rho": 0.3, "height": 0.0, "length": 4.0, "jitter": 0.0}


def law_family(law, answer, bounds, slopes, slow=()):
    usual = OVER_LAW | ({"roughness": 0.0} if law is jl.Specular else {})

    def make():
        def build(p):
            lidar = jl.Lidar(altitude=p["altitude"], divergence=p["divergence"], aperture=p["aperture"])
            kind = jl.Specular(roughness=p["roughness"]) if law is jl.Specular else law()
            return lidar, jl.Scene(ground=jl.Ground(reflectance=p["rho"], slope=p["slope"], law=kind))

        def outputs(setup, response):
            alpha = setup.lidar.aperture_half_angle
            # Scale apparent reflectances, in the thousands, to order one; for a mirror to the fraction of the
            # pulse.
            return sample_sum(setup, response) * (alpha**2 if law is jl.Specular else alpha)

        return simulation(build, usual, outputs, window=(-30.0, 30.0), widest={"slope": 80.0})

    return Family(usual, make, answer, bounds, slopes, slow)


OVER_LAW = {"rho": 0.6, "slope": 0.0, "altitude": 1000.0, "divergence": 0.0, "aperture": 0.2}

# One sample of 1000 ns about time zero.
CENTRED = {"window": (0.0, 1.0), "bin_width": 2.0}

# -- canopies, first order ---------------------------------------------------------------------------------

SLAB = {
    "leaf": 0.3,
    "bark": 0.1,
    "low": 0.5,
    "middle": 1.0,
    "high": 1.5,
    "R": 0.4,
    "T": 0.3,
    "bark_R": 0.5,
    "rho": 0.45,
    "height": 0.0,
    "slope": 0.0,
    "zenith": 0.0,
    "azimuth": 0.0,
    "x": 0.3,
    "y": 0.4,
    "altitude": 4e5,
    "divergence": 1e-3,
}


def slab_family(hotspot, slow=()):
    def build(p):
        layers = p["leaf"] * jnp.stack([p["low"], p["middle"], p["high"]])
        voxels = jl.VoxelMap.from_extinction(
            leaf=jnp.broadcast_to(layers, (2, 2, 3)),
            bark=jnp.broadcast_to(p["bark"], (2, 2, 3)),
            voxel_size=1.0,
            origin=(-1.0, -1.0, 1.0),
        )
        leaf = jl.LeafOptics(reflectance=p["R"], transmittance=p["T"])
        canopy = jl.Canopy(voxels, leaf=leaf, bark=p["bark_R"], hotspot=hotspot, sides="periodic")
        lidar = single_sample_lidar(
            altitude=p["altitude"],
            divergence=p["divergence"],
            zenith=p["zenith"],
            azimuth=p["azimuth"],
            position=jnp.stack([p["x"], p["y"]]),
        )
        # The slope rises along x alone, so that the height beneath the lidar is that at x = 0 and any y.
        ground = jl.Ground(reflectance=p["rho"], height=p["height"], slope=p["slope"], aspect=90.0)
        return lidar, jl.Scene(canopy=canopy, ground=ground)

    def make():
        outputs = component_sums("leaf", "bark", "ground", "shares")
        # Rays enough that the mean of their positions, which is not quite zero, does not matter off nadir.
        settings = {"max_orders": 1, "n_rays": 128, "footprint": "fixed", "max_step": 1.0, **CENTRED}
        return simulation(build, SLAB, outputs, widest={"zenith": 85.0}, **settings)

    answer = functools.partial(answers.slab, kappa=1 if hotspot else 2)
    return Family(SLAB, make, answer, (1e-5, 1e-8), (2e-4, 1e-6), slow)


ONE_VOXEL = {"tau": 1.0, "size": 1.0, "R": 0.4, "rho": 0.45}


def one_voxel_family(edge, interval):
    """One cubic voxel of the edge `edge` (times `size`), standing on the ground."""

    def build(p):
        size = edge * p["size"]
        voxels = jl.VoxelMap.from_extinction(
            leaf=jnp.broadcast_to(p["tau"] / edge, (1, 1, 1)),
            voxel_size=jnp.broadcast_to(size, (3,)),
            origin=jnp.stack([-0.4 * size, -0.4 * size, jnp.zeros_like(size)]),
        )
        canopy = jl.Canopy(voxels, leaf=jl.LeafOptics(reflectance=p["R"], transmittance=0.0), hotspot=False)
        lidar = single_sample_lidar(sampling_interval=interval, divergence=0.0)
        return lidar, jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=p["rho"]))

    def make():
        window = (-0.4 * interval, -0.399 * interval)
        settings = {"max_orders": 1, "n_rays": 1, "footprint": "fixed", "bin_width": 2e-3 * interval}
        return simulation(build, ONE_VOXEL, sample_sum, window=window, **settings)

    return Family(ONE_VOXEL, make, answers.one_voxel, (1e-5, 1e-9), (1e-4, 1e-9), BOTH_PRECISIONS)


# -- all orders --------------------------------------------------------------------------------------------

CROWN = {
    "p_leaf": 0.3,
    "p_bark": 0.1,
    "R": 0.4,
    "T": 0.3,
    "bark_R": 0.3,
    "rho": 0.5,
    "height": 0.0,
    "slope": 0.0,
    "x": 0.5,
    "y": 0.5,
    "altitude": 1000.0,
    "divergence": 1.0,
    "fov": 100.0,
}


def measure_crown():
    def build(p):
        voxels = jl.VoxelMap.from_probability(
            leaf=jnp.broadcast_to(p["p_leaf"], (2, 2, 3)),
            bark=jnp.broadcast_to(p["p_bark"], (2, 2, 3)),
            voxel_size=1.0,
            origin=(-1.0, -1.0, 1.0),
        )
        leaf = jl.LeafOptics(reflectance=p["R"], transmittance=p["T"])
        lidar = jl.Lidar(
            altitude=p["altitude"],
            divergence=p["divergence"],
            field_of_view=p["fov"],
            position=jnp.stack([p["x"], p["y"]]),
        )
        ground = jl.Ground(reflectance=p["rho"], height=p["height"], slope=p["slope"], aspect=90.0)
        return lidar, jl.Scene(
            canopy=jl.Canopy(voxels, leaf=leaf, bark=p["bark_R"], hotspot=False), ground=ground
        )

    settings = {"max_orders": 3, "n_photons": 512, "n_rays": 32, "window": (-45.0, 45.0), "bin_width": 1.0}
    return simulation(
        build, CROWN, component_sums("shares", "all"), widest={"height": 4.5, "slope": 80.0}, **settings
    )


MANY_ORDERS = {"tau": 1.0, "albedo": 1.0, "rho": 1.0}


def measure_many_orders():
    def build(p):
        voxels = jl.VoxelMap.from_extinction(
            leaf=jnp.broadcast_to(p["tau"] / 3.0, (1, 1, 3)), voxel_size=1.0, origin=(-0.5, -0.5, 0.0)
        )
        canopy = jl.Canopy(voxels, leaf=jl.Isotropic(albedo=p["albedo"]), sides="periodic", hotspot=False)
        return single_sample_lidar(), jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=p["rho"]))

    settings = {"max_orders": 40, "n_photons": 512, "n_rays": 4, **SINGLE_SAMPLE}
    return simulation(build, MANY_ORDERS, component_sums("shares", "absorbed"), **settings)


PLATE = {"R": 0.4, "T": 0.5, "coverage": 1.0, "height": 1e-3, "rho": 0.6}
PLATE_ORDERS = 5


def measure_plate_over_ground():
    def build(p):
        plate = jl.Plate(height=p["height"], reflectance=p["R"], transmittance=p["T"], coverage=p["coverage"])
        return single_sample_lidar(), jl.Scene(plates=(plate,), ground=jl.Ground(reflectance=p["rho"]))

    settings = {
        "max_orders": PLATE_ORDERS,
        "n_photons": 131072,
        "widest": {"coverage": 0.5, "height": 12.0},
        **SINGLE_SAMPLE,
    }
    return simulation(build, PLATE, sample_sum, **settings)


# -- components of the library ------------------------------------------------------------------------------

PROBABILITY = {"p_leaf": 0.3, "p_bark": 0.1, "edge": 0.5}


def measure_probability():
    def measure(p):
        fill = [jnp.broadcast_to(p[name], (1, 1, 1)) for name in ("p_leaf", "p_bark")]
        size = jnp.broadcast_to(p["edge"], (3,))
        voxels = jl.VoxelMap.from_probability(leaf=fill[0], bark=fill[1], voxel_size=size)
        return jnp.concatenate([voxels.leaf.reshape(-1), voxels.bark.reshape(-1)])

    return measure


CHORD = {
    "x": 0.3,
    "y": 0.4,
    "z": 3.5,
    "u": 0.48,
    "v": 0.6,
    "w": -0.64,
    "k": 0.7,
    "contrast": 0.5,
    "limit": 100.0,
}
CHORD_SHAPE = (2, 2, 3)


def measure_chord(periodic):
    sign = 1 - 2 * (np.indices(CHORD_SHAPE).sum(axis=0) % 2)

    def measure(p):
        k = p["k"] * (1.0 + p["contrast"] * jnp.asarray(sign))
        voxels = jl.VoxelMap.from_extinction(leaf=k, voxel_size=1.0)
        leaf = jl.LeafOptics(reflectance=0.5, transmittance=0.3)
        canopy = jl.Canopy(voxels, leaf=leaf, sides="periodic" if periodic else "open", hotspot=False)
        medium = make_medium(canopy, jnp.zeros(3))
        x, w = (tuple(p[n][None] for n in names) for names in ("xyz", "uvw"))
        none, active = jnp.zeros((0, 1)), jnp.ones((1,), bool)
        return march_to_depths(medium, x, w, none, p["limit"][None], active, 512).total_depth

    return measure


LEAF = {
    "N": 1.5,
    "Cab": 40.0,
    "Car": 8.0,
    "Cant": 1.0,
    "Cbrown": 0.1,
    "Cw": 0.01,
    "Cm": 0.009,
}
# The ends of the table, and where pigments, dry matter and water absorb.
LEAF_WAVELENGTHS = (400.0, 532.0, 1064.0, 1450.5, 2500.0)


def measure_leaf():
    def measure(p):
        plant = jl.Prospect(**p)
        optics = (*plant(LEAF_WAVELENGTHS), plant.absorptance(LEAF_WAVELENGTHS))
        return jnp.stack(optics, axis=1).reshape(-1)

    return measure


AIR = {"visibility": 23.0, "height": 0.0, "altitude": 1000.0, "zenith": 0.0, "lidar_ratio": 50.0}


def measure_air():
    def measure(p):
        atmosphere = jl.Atmosphere(
            visibility=p["visibility"],
            lidar_ratio=p["lidar_ratio"],
            rayleigh=False,
            aerosol_scale_height=1400.0,
        )
        where = (550.0, p["height"], p["altitude"], p["zenith"])
        return jnp.stack([atmosphere.two_way_transmittance(*where), atmosphere.backscatter(*where)])

    return measure


PULSES = {"width": 6.0, "decay": 2.0, "jitter": 0.5, "shift": 0.0}
PULSE_TIMES = (-1000.0, -3.5, -0.25, 0.0, 0.5, 7.0)


def measure_pulses():
    def measure(p):
        shapes = (
            jl.GaussianPulse(fwhm=p["width"]),
            jl.RectangularPulse(length=p["width"]),
            jl.ExponentiallyModifiedGaussianPulse(fwhm=p["width"], decay=p["decay"]),
        )
        times = jnp.asarray(PULSE_TIMES) + p["shift"]
        return jnp.stack([s.cumulative(times, p["jitter"]) for s in shapes], axis=1).reshape(-1)

    return measure


def chord_family(periodic):
    make = functools.partial(measure_chord, periodic)
    answer = functools.partial(answers.chord, shape=CHORD_SHAPE, periodic=periodic)
    return Family(CHORD, make, answer, (2e-6, 1e-13), (2e-6, 1e-13), DOUBLE_PRECISION)


FAMILIES = {
    # Derivatives with respect to time have an error of second order in the fine bin of 0.5 ns.
    "ground": ground_family(1.0, 60.0, (2e-4, 2e-4), (1e-2, 1e-2), DOUBLE_PRECISION),
    "ground, 0.1 ns": ground_family(0.1, 12.0, (1e-4, 1e-5), (1e-3, 1e-4), BOTH_PRECISIONS),
    "short pulse": Family(
        SHORT_PULSE,
        measure_short_pulse,
        lambda n: answers.rectangle(n, [answers.mpf(t) for t in range(-20, 21)]),
        (2e-5, 1e-9),
        (1e-4, 1e-9),
        DOUBLE_PRECISION,
    ),
    "equal-angle": law_family(
        jl.EqualAngle, answers.equal_angle, (1e-5, 1e-9), (1e-4, 1e-9), DOUBLE_PRECISION
    ),
    "mirror": law_family(jl.Specular, answers.mirror, (1e-5, 1e-6), (1e-4, 1e-4), DOUBLE_PRECISION),
    "slab": slab_family(hotspot=False, slow=BOTH_PRECISIONS),
    "slab, hot spot": slab_family(hotspot=True, slow=BOTH_PRECISIONS),
    "one voxel of 1 mm": one_voxel_family(1e-3, 1000.0),
    "one voxel of 1 km": one_voxel_family(1e3, 20000.0),
    "crown": Family(CROWN, measure_crown, answers.crown, (1e-5, 1e-9), (1e-4, 1e-9), slow=BOTH_PRECISIONS),
    "40 orders": Family(
        MANY_ORDERS,
        measure_many_orders,
        answers.many_orders,
        (1e-5, 1e-9),
        (1e-4, 1e-9),
        slow=BOTH_PRECISIONS,
    ),
    # Photons estimate the second and third terms of the series.
    "plate": Family(
        PLATE,
        measure_plate_over_ground,
        functools.partial(answers.plate_over_ground, orders=PLATE_ORDERS),
        (2e-3, 2e-3),
        (1e-2, 1e-2),
        BOTH_PRECISIONS,
    ),
    "probability": Family(
        PROBABILITY, measure_probability, answers.probability, (1e-6, 1e-14), (1e-6, 1e-14)
    ),
    "chord": chord_family(periodic=False),
    "endless chord": chord_family(periodic=True),
    "leaf": Family(
        LEAF,
        measure_leaf,
        lambda n: answers.leaf(n, LEAF_WAVELENGTHS),
        (1e-6, 1e-13),
        (1e-6, 1e-13),
    ),
    "air": Family(AIR, measure_air, answers.air, (1e-6, 1e-13), (1e-5, 1e-12)),
    "pulses": Family(
        PULSES,
        measure_pulses,
        lambda n: answers.pulses(n, [answers.mpf(t) for t in PULSE_TIMES]),
        (1e-6, 1e-13),
        (1e-6, 1e-13),
        DOUBLE_PRECISION,
    ),
}
