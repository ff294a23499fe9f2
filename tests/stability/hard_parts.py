"""For the hard cases, measures of parts of the library: from a dict of scalars to a vector."""

import jax.numpy as jnp
import numpy as np

import jaxlidar as jl
from jaxlidar.trace.voxel_traversal import make_medium, march_to_depths

PROBABILITY = {"p_leaf": 0.3, "p_bark": 0.1, "edge": 0.5}


def probability():
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


def chord(periodic):
    sign = 1 - 2 * (np.indices(CHORD_SHAPE).sum(axis=0) % 2)

    def measure(p):
        k = p["k"] * (1.0 + p["contrast"] * jnp.asarray(sign))
        voxels = jl.VoxelMap.from_extinction(leaf=k, voxel_size=1.0)
        leaf = jl.LeafOptics(reflectance=0.5, transmittance=0.3)
        canopy = jl.Canopy(voxels, leaf=leaf, sides="periodic" if periodic else "open")
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


def leaf():
    def measure(p):
        plant = jl.Prospect(**p)
        optics = (*plant(LEAF_WAVELENGTHS), plant.absorptance(LEAF_WAVELENGTHS))
        return jnp.stack(optics, axis=1).reshape(-1)

    return measure


AIR = {"visibility": 23.0, "height": 0.0, "altitude": 1000.0, "zenith": 0.0, "lidar_ratio": 50.0}


def air():
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


def pulses():
    def measure(p):
        shapes = (
            jl.GaussianPulse(fwhm=p["width"]),
            jl.RectangularPulse(length=p["width"]),
            jl.ExponentiallyModifiedGaussianPulse(fwhm=p["width"], decay=p["decay"]),
        )
        times = jnp.asarray(PULSE_TIMES) + p["shift"]
        return jnp.stack([s.cumulative(times, p["jitter"]) for s in shapes], axis=1).reshape(-1)

    return measure
