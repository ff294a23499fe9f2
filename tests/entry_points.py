"""Valid calls of all public functions and classes that take numbers, as a table.

`ENTRY_POINTS` has for each a function and its arguments by name, all of them valid and concrete. Tests change
an argument at a time (see test_masked_arguments). What takes long is made when it is used.
"""

import functools
import tempfile
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import inversion
import jaxlidar as jl
import jaxlidar.plot


class EntryPoint(NamedTuple):
    """A valid call, and what is particular about its arguments.

    - `function`, `arguments`: the call.
    - `missing`: names of arguments in which NaN stands for a missing number.
    - `messages`: by argument, the name that messages have for it, where it is another one.
    """

    function: Callable[..., Any]
    arguments: dict[str, Any]
    missing: tuple[str, ...] = ()
    messages: dict[str, str] = {}  # noqa: RUF012


def with_field(function: Callable[..., Any], **wrapped: Callable[[Any], Any]) -> Callable[..., Any]:
    """Return the function with some arguments put into a mapping or a sequence, where numbers lie."""

    def call(**arguments: Any) -> Any:
        return function(**{k: wrapped[k](v) if k in wrapped else v for k, v in arguments.items()})

    return call


# -- objects that the calls share --------------------------------------------------------------------------

KEY = jax.random.key(0)
LIDAR, GROUND = jl.Lidar(), jl.Scene(ground=jl.Ground())
CUBE = np.full((2, 2, 2), 0.5)
VOXELS = jl.VoxelMap.from_lad(CUBE, voxel_size=1.0)
LEAF, PROSPECT, PULSE = jl.LeafOptics(0.4, 0.3), jl.Prospect(), jl.GaussianPulse()
LEAVES = jax.vmap(lambda n: jl.Prospect(N=n))(np.ones(2))
TERRAIN = jl.Terrain(np.zeros((3, 3)), 1.0)
TREE = jl.turtle("F")
MESH = jl.Mesh(np.eye(3), np.array([[0, 1, 2]]))
TWO = np.array([[0.0, 0.0], [5.0, 0.0]])
SURVEY = jl.Survey(LIDAR, TWO)
BINS = np.arange(60.0)
HEIGHT, POWER = 30.0 - 0.15 * BINS, 1e-3 + np.exp(-0.5 * ((BINS - 40) / 4) ** 2)
BANDS = np.array([532.0, 1064.0, 1550.0])
SPECTRA = np.tile([0.1, 0.4, 0.3], (2, 1))
RECORDED_PULSE = np.exp(-0.5 * ((np.arange(21.0) - 10) / 4) ** 2)
LINE = {"anchor": np.array([0.0, 0.0, 20.0]), "direction": np.array([0.0, 0.0, -0.15])}
SEGMENT = jl.io.Segment(np.arange(10.0), 0.0)
SHOT = jl.io.AirborneShot(0, **LINE, returning=(SEGMENT,), gps_time=1.0)
UNKNOWN = inversion.Unknown(lambda s: s.ground.height, bounds=(-2.0, 2.0), name="height")
FIT: dict[str, Any] = {"lidar": LIDAR, "scene": GROUND, "key": KEY}
TABLE = np.array([0.0, 1.0, 4.0, 9.0, 16.0])


@functools.cache
def folder() -> Path:
    return Path(tempfile.mkdtemp())


@functools.cache
def plan() -> jl.Plan:
    return jl.plan(LIDAR, GROUND, rtol=0.1, max_orders=1)


@functools.cache
def wave() -> jl.Waveform:
    return jl.simulate(LIDAR, GROUND, key=KEY, plan=plan())


@functools.cache
def observation() -> dict[str, np.ndarray]:
    return {"observed": np.asarray(wave().reflectance), "time": np.asarray(wave().time)}


@functools.cache
def point_cloud() -> jl.io.PointCloud:
    one, position = np.ones(3, int), np.array([[1.0, 1.0, 0.0], [2.0, 3.0, 4.0], [4.0, 1.0, 0.0]])
    return jl.io.PointCloud(position, np.array([2, 5, 2]), one, one, 1.0 * one, {})


@functools.cache
def events() -> jl.PhotonEvents:
    return jl.record(wave(), mode="photons", receiver=jl.PhotonCounter(), key=KEY, pulses=20)


@functools.cache
def waveforms() -> jl.Waveforms:
    return jl.simulate_many(SURVEY, GROUND, key=KEY, rtol=0.1, max_orders=1, truth=True)


@functools.cache
def events_of_two_shots() -> jl.PhotonEvents:
    return jl.record(waveforms(), mode="photons", receiver=jl.PhotonCounter(), key=KEY, pulses=20)


@functools.cache
def written(name: str, text: str) -> Path:
    path = folder() / name
    path.write_text(text)
    return path


def dem() -> Path:
    return written("dem.asc", "ncols 2\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 10\n7 8\n5 6\n")


def vox() -> Path:
    head = "VOXEL SPACE\n#min_corner:(0,0,0)\n#max_corner:(1,1,1)\n#split:(1,1,1)\n"
    return written("a.vox", head + "i j k PadBVTotal\n0 0 0 1\n")


def obj() -> Path:
    return written("a.obj", "v 0 0 0\nv 2 0 0\nv 0 1 0\nf 1 2 3\n")


def qsm() -> Path:
    names = "ID,parentID,startX,startY,startZ,endX,endY,endZ,radius\n"
    return written("a.csv", names + "1,-1,0,0,0,0,0,2,0.1\n")


@functools.cache
def las() -> Path:
    jl.io.write_las(folder() / "a.las", np.zeros((1, 3)))
    return folder() / "a.las"


@functools.cache
def gedi() -> Path:
    jl.io.write_gedi_l1b(folder() / "a.h5", [wave(), wave()], SURVEY, origin=(14.0, 50.0))
    return folder() / "a.h5"


def level_2_file(kind: str) -> Path:
    from tests.io.test_gedi_level2 import write_level_2

    return write_level_2(folder() / f"{kind}.h5", kind)


@functools.cache
def photon_files() -> tuple[Path, Path]:
    from tests.io.test_icesat2 import write_heights, write_photons

    return write_photons(folder() / "atl03.h5"), write_heights(folder() / "atl08.h5")


# -- calls -------------------------------------------------------------------------------------------------

ENTRY_POINTS: dict[str, Callable[[], EntryPoint]] = {
    # -- instruments -----------------------------------------------------------------------------------
    "Lidar": lambda: EntryPoint(
        jl.Lidar,
        {"wavelength": (532.0, 1064.0), "altitude": 500.0, "divergence": 0.3, "aperture": 0.2}
        | {"zenith": 1.0, "azimuth": 2.0, "energy": 1e-3, "sampling_interval": 1.0}
        | {"position": (0.0, 1.0), "field_of_view": 1.0, "jitter": 0.1, "efficiency": 0.9},
    ),
    "GaussianPulse": lambda: EntryPoint(jl.GaussianPulse, {"fwhm": 6.0}),
    "GaussianPulse.cumulative": lambda: EntryPoint(
        PULSE.cumulative, {"t": np.array([0.0, 1.0]), "jitter": 0.1}
    ),
    "GaussianPulse.power": lambda: EntryPoint(PULSE.power, {"t": np.array([0.0, 1.0]), "jitter": 0.1}),
    "GaussianPulse.support": lambda: EntryPoint(PULSE.support, {"jitter": 0.1}),
    "ExponentiallyModifiedGaussianPulse": lambda: EntryPoint(
        jl.ExponentiallyModifiedGaussianPulse, {"fwhm": 6.0, "decay": 2.0}
    ),
    "RectangularPulse": lambda: EntryPoint(jl.RectangularPulse, {"length": 6.0}),
    "SampledPulse": lambda: EntryPoint(
        jl.SampledPulse, {"time": np.arange(4.0), "power": np.array([0.0, 1.0, 2.0, 0.0])}
    ),
    "Receiver": lambda: EntryPoint(
        jl.Receiver,
        {"detection_threshold": 0.1, "saturation": 1.0, "bits": 8, "background": 0.1}
        | {"electronic_noise": 0.1},
    ),
    "record": lambda: EntryPoint(
        lambda wave, wavelength, pulses: jl.record(wave, wavelength, jl.Receiver(), key=KEY, pulses=pulses),
        {"wave": np.full((1, 4), 1e-6), "wavelength": 1064.0, "pulses": 1},
        messages={"wave": "energy"},
    ),
    "record photons": lambda: EntryPoint(
        lambda pulses: jl.record(wave(), receiver=jl.PhotonCounter(), mode="photons", key=KEY, pulses=pulses),
        {"pulses": 2},
    ),
    "first_return_window": lambda: EntryPoint(
        jl.first_return_window,
        {"time": BINS, "energy": POWER[None], "interval": 1.0, "threshold": 0.1},
    ),
    "PhotonCounter": lambda: EntryPoint(
        jl.PhotonCounter,
        {"pixels": 16, "dead_time": 3.2, "detection_probability": 0.9, "background_rate": 1.0}
        | {"jitter": 0.1, "window": (0.0, 100.0)},
    ),
    "Survey": lambda: EntryPoint(
        lambda **arguments: jl.Survey(LIDAR, **arguments),
        {"position": TWO, "zenith": np.array([0.0, 1.0]), "azimuth": np.array([0.0, 1.0])}
        | {"gps_time": np.array([0.0, 1.0]), "scan_angle": np.array([0.0, 1.0])}
        | {"flight_line": np.array([1, 2])},
    ),
    "Survey.about": lambda: EntryPoint(SURVEY.about, {"origin": np.array([1.0, 2.0])}),
    "Survey.grid": lambda: EntryPoint(
        lambda **arguments: jl.Survey.grid(LIDAR, **arguments),
        {"low": (0.0, 0.0), "high": (20.0, 10.0), "spacing": 10.0},
    ),
    "Survey.track": lambda: EntryPoint(
        lambda **arguments: jl.Survey.track(LIDAR, **arguments),
        {"start": (0.0, 0.0), "end": (20.0, 10.0), "spacing": 10.0, "beams": 2, "beam_spacing": 600.0},
    ),
    "Survey.scan": lambda: EntryPoint(
        lambda **arguments: jl.Survey.scan(LIDAR, jl.Oscillating(10.0, 50.0), **arguments),
        {"start": (0.0, 0.0), "end": (0.5, 0.0), "speed": 50.0, "pulse_rate": 1000.0}
        | {"gps_time": 1.0, "flight_line": 2},
    ),
    "Survey sensors": lambda: EntryPoint(
        lambda **arguments: jl.Survey(LIDAR, **arguments), {"sensor": np.ones((2, 3))}
    ),
    "Trajectory": lambda: EntryPoint(
        jl.Trajectory,
        {"time": np.array([0.0, 2.0]), "position": np.ones((2, 3)), "roll": np.zeros(2)}
        | {"pitch": np.zeros(2), "yaw": np.zeros(2)},
    ),
    "Trajectory.at": lambda: EntryPoint(
        jl.Trajectory([0.0, 2.0], np.ones((2, 3))).at, {"time": np.array([0.5, 1.0])}
    ),
    "Survey.fly": lambda: EntryPoint(
        lambda **arguments: jl.Survey.fly(
            jl.Trajectory([0.0, 2.0], np.ones((2, 3))), jl.Oscillating(10.0, 50.0), **arguments
        ),
        {"pulse_rate": 2.0, "mounting": np.zeros(3), "lever_arm": np.zeros(3)},
    ),
    "Oscillating": lambda: EntryPoint(jl.Oscillating, {"half_angle": 10.0, "frequency": 50.0}),
    "Oscillating.direction": lambda: EntryPoint(jl.Oscillating(10.0, 50.0).direction, {"time": BINS}),
    "RotatingPolygon": lambda: EntryPoint(jl.RotatingPolygon, {"half_angle": 10.0, "line_rate": 50.0}),
    "RotatingPolygon.direction": lambda: EntryPoint(jl.RotatingPolygon(10.0, 50.0).direction, {"time": BINS}),
    "Conical": lambda: EntryPoint(jl.Conical, {"half_angle": 10.0, "frequency": 50.0}),
    "Conical.direction": lambda: EntryPoint(jl.Conical(10.0, 50.0).direction, {"time": BINS}),
    # -- scenes ----------------------------------------------------------------------------------------
    "SceneParts": lambda: EntryPoint(
        lambda **arguments: jl.SceneParts(lambda low, high: GROUND, **arguments),
        {"z": (0.0, 20.0), "tile": 100.0, "margin": 10.0},
    ),
    "SceneParts.between": lambda: EntryPoint(
        jl.SceneParts(lambda low, high: GROUND, z=(0.0, 20.0)).between,
        {"low": np.zeros(2), "high": np.ones(2)},
    ),
    "VoxelMap": lambda: EntryPoint(
        jl.VoxelMap, {"leaf": CUBE, "bark": CUBE, "voxel_size": np.ones(3), "origin": np.zeros(3)}
    ),
    "VoxelMap.from_extinction": lambda: EntryPoint(
        jl.VoxelMap.from_extinction,
        {"leaf": CUBE, "bark": CUBE, "voxel_size": 1.0, "origin": (0.0, 0.0, 0.0)},
    ),
    "VoxelMap.from_probability": lambda: EntryPoint(
        jl.VoxelMap.from_probability,
        {"leaf": CUBE, "bark": CUBE, "voxel_size": 1.0, "origin": (0.0, 0.0, 0.0)},
    ),
    "VoxelMap.from_lad": lambda: EntryPoint(
        jl.VoxelMap.from_lad, {"lad": CUBE, "voxel_size": 1.0, "origin": (0.0, 0.0, 0.0), "bark": CUBE}
    ),
    "Canopy": lambda: EntryPoint(
        lambda bark: jl.Canopy(VOXELS, leaf=LEAF, bark=bark, hotspot=False), {"bark": 0.3}
    ),
    "Canopy.leaf_optics": lambda: EntryPoint(
        jl.Canopy(VOXELS, leaf=LEAF, hotspot=False).leaf_optics, {"wavelength": BANDS}
    ),
    "Canopy.bark_reflectance": lambda: EntryPoint(
        jl.Canopy(VOXELS, leaf=LEAF, bark=0.3, hotspot=False).bark_reflectance, {"wavelength": BANDS}
    ),
    "Ground": lambda: EntryPoint(
        jl.Ground,
        {"height": 0.0, "reflectance": 0.3, "slope": 5.0, "aspect": 5.0, "position": (0.0, 0.0)},
    ),
    "Ground.moved": lambda: EntryPoint(jl.Ground().moved, {"by": np.ones(2)}),
    "Terrain": lambda: EntryPoint(
        jl.Terrain,
        {"heights": np.zeros((3, 3)), "spacing": 1.0, "origin": (0.0, 0.0), "reflectance": 0.3},
    ),
    "Terrain.moved": lambda: EntryPoint(TERRAIN.moved, {"by": np.ones(2)}),
    "Terrain.height_at": lambda: EntryPoint(TERRAIN.height_at, {"x": np.ones(2), "y": np.ones(2)}),
    "Plate": lambda: EntryPoint(
        jl.Plate,
        {"height": 1.0, "reflectance": 0.3, "transmittance": 0.2, "coverage": 0.9, "slope": 5.0}
        | {"aspect": 5.0, "position": (0.0, 0.0)},
    ),
    "Plate.moved": lambda: EntryPoint(jl.Plate(1.0, 0.2).moved, {"by": np.ones(2)}),
    "MeshSurface": lambda: EntryPoint(
        lambda vertices, faces, **optics: jl.MeshSurface((vertices, faces), **optics),
        {"vertices": np.eye(3), "faces": np.array([[0, 1, 2]]), "reflectance": 0.3, "transmittance": 0.2},
    ),
    "MeshSurface.moved": lambda: EntryPoint(jl.MeshSurface(MESH).moved, {"by": np.ones(2)}),
    "MeshInstances": lambda: EntryPoint(
        jl.MeshInstances, {"shift": np.zeros((2, 3)), "rotation": np.zeros(2), "scale": np.ones(2)}
    ),
    "Atmosphere": lambda: EntryPoint(
        jl.Atmosphere,
        {"visibility": 23.0, "rayleigh_scale_height": 8450.0, "aerosol_scale_height": 1400.0}
        | {"lidar_ratio": 50.0, "base_height": 0.0},
    ),
    "Atmosphere.extinction": lambda: EntryPoint(
        jl.Atmosphere().extinction, {"wavelength": 1064.0, "height": np.zeros(2)}
    ),
    **{
        f"Atmosphere.{name}": lambda name=name: EntryPoint(
            getattr(jl.Atmosphere(), name),
            {"wavelength": 1064.0, "height": np.zeros(2), "altitude": 1000.0, "zenith": 10.0},
        )
        for name in ("optical_depth", "two_way_transmittance", "backscatter")
    },
    "Plane.of": lambda: EntryPoint(
        jl.Plane.of, {"height": 0.0, "slope": 5.0, "aspect": 5.0, "position": (0.0, 0.0)}
    ),
    # -- optics ----------------------------------------------------------------------------------------
    "Prospect": lambda: EntryPoint(
        jl.Prospect,
        {"N": 1.5, "Cab": 40.0, "Car": 8.0, "Cant": 1.0, "Cbrown": 0.1, "Cw": 0.01, "Cm": 0.009}
        | {"alpha": 40.0},
    ),
    "Prospect()": lambda: EntryPoint(lambda wavelengths: PROSPECT(wavelengths), {"wavelengths": BANDS}),
    "Prospect.absorptance": lambda: EntryPoint(PROSPECT.absorptance, {"wavelengths": BANDS}),
    "LeafOptics": lambda: EntryPoint(jl.LeafOptics, {"reflectance": 0.4, "transmittance": 0.3}),
    "prospect_spectra": lambda: EntryPoint(
        lambda **arguments: jl.prospect_spectra(LEAVES, **arguments),
        {"wavelengths": BANDS, "batch_size": 2},
    ),
    "prospect_jacobian": lambda: EntryPoint(
        lambda **arguments: jl.prospect_jacobian(LEAVES, **arguments),
        {"wavelengths": BANDS, "batch_size": 2},
    ),
    "plate_model": lambda: EntryPoint(
        lambda **arguments: jl.plate_model(surface=jl.leaf_surface(np.array([1.4, 1.5])), **arguments),
        {"k": np.array([0.1, 0.2]), "N": 1.5},
    ),
    "plate_model of a surface": lambda: EntryPoint(
        lambda **surface: jl.plate_model(0.1, 1.5, jl.LeafSurface(**surface)),
        {name: np.full(2, 0.5) for name in ("t_alpha", "r_alpha", "t12", "r12", "t21", "r21")},
    ),
    "leaf_surface": lambda: EntryPoint(jl.leaf_surface, {"n": np.array([1.4, 1.5]), "alpha": 40.0}),
    "Spectrum": lambda: EntryPoint(
        jl.Spectrum,
        {"wavelength": np.array([400.0, 900.0]), "reflectance": np.array([0.1, 0.3]), "scale": 1.0},
    ),
    "Spectrum()": lambda: EntryPoint(
        lambda wavelength: jl.Spectrum([400.0, 900.0], [0.1, 0.3])(wavelength),
        {"wavelength": np.array([500.0, 600.0])},
    ),
    "Specular": lambda: EntryPoint(jl.Specular, {"roughness": 0.1}),
    "LeafAngles": lambda: EntryPoint(jl.LeafAngles, {"probability": np.full(90, 1 / 90)}),
    "LeafAngles.beta": lambda: EntryPoint(jl.LeafAngles.beta, {"mean": 50.0, "std": 15.0}),
    "Isotropic": lambda: EntryPoint(jl.Isotropic, {"albedo": 0.9}),
    "HenyeyGreenstein": lambda: EntryPoint(jl.HenyeyGreenstein, {"albedo": 0.9, "g": 0.5}),
    # -- plants ----------------------------------------------------------------------------------------
    "Habit": lambda: EntryPoint(
        jl.Habit,
        {"height": 15.0, "trunk_diameter": 0.5, "smallest_diameter": 0.03, "clump_diameter": 0.06}
        | {"exponent": 2.0, "length_exponent": 0.65, "bole": 0.08, "stems": 1, "stem_angle": 0.0}
        | {"pieces": 3, "twig": 0.4, "shoots": 8, "shoot_length": 0.6, "shoot_angle": 50.0}
        | {"shoot_buds": 8},
    ),
    "Branching": lambda: EntryPoint(
        jl.Branching,
        {"laterals": 1, "share": (0.2, 0.5), "angle": 50.0, "angle_spread": 8.0, "divergence": 137.5}
        | {"bend": 7.0, "tropism": 2.0},
    ),
    **{
        name: lambda name=name: EntryPoint(getattr(jl, name), {"height": 10.0, "stems": 1})
        for name in ("broadleaf", "conifer", "shrub", "spreading_tree")
    },
    "grow": lambda: EntryPoint(lambda seed: jl.grow(jl.shrub(height=0.5), seed=seed), {"seed": 0}),
    "forest": lambda: EntryPoint(
        lambda **arguments: jl.forest([jl.shrub(height=0.5)] * 2, **arguments),
        {"density": 0.05, "area": (9.0, 9.0), "minimum_distance": 1.0, "shares": [0.5, 0.5]}
        | {"size": (1.0, 1.0), "individuals": 2, "origin": (0.0, 0.0, 0.0), "seed": 0},
    ),
    "stand_of_leaf_area": lambda: EntryPoint(
        lambda **arguments: jl.stand_of_leaf_area(habits=jl.shrub(height=0.5, stems=1), **arguments),
        {"leaf_area_index": 1.0, "heights": np.array([0.5, 1.0]), "density": 0.05, "area": (9.0, 9.0)}
        | {"minimum_distance": 1.0, "shares": [1.0], "individuals": 1, "origin": (0.0, 0.0, 0.0), "seed": 0},
    ),
    "stand_from_inventory": lambda: EntryPoint(
        lambda **arguments: jl.stand_from_inventory(
            {"x": [0.0], "y": [0.0], "height": [0.5]}, jl.shrub(height=0.5, stems=1), **arguments
        ),
        {"leaf_area_index": 1.0, "area": 9.0, "individuals": 1, "seed": 0},
    ),
    "Stand": lambda: EntryPoint(
        lambda **arguments: jl.Stand(TREE, **arguments),
        {"position": np.zeros((2, 3)), "individual": np.zeros(2, int), "azimuth": np.zeros(2)}
        | {"scale": np.ones((2, 3)), "leaf_area": 0.1},
    ),
    "Tree": lambda: EntryPoint(
        jl.Tree,
        {"start": np.zeros((2, 3)), "end": np.ones((2, 3)), "radius_start": np.ones(2)}
        | {"radius_end": np.ones(2), "parent": np.array([-1, 0]), "order": np.array([0, 0])}
        | {"bud_position": np.ones((2, 3)), "bud_direction": np.eye(3)[:2], "bud_radius": np.ones(2)},
    ),
    "Tree.with_bud_radius": lambda: EntryPoint(TREE.with_bud_radius, {"radius": 0.1}),
    "Tree.translated": lambda: EntryPoint(TREE.translated, {"offset": (1.0, 2.0, 3.0)}),
    "Tree.rotated": lambda: EntryPoint(TREE.rotated, {"angle": 10.0}),
    "Tree.scaled": lambda: EntryPoint(TREE.scaled, {"factor": 2.0}),
    "LSystem.rewrite": lambda: EntryPoint(
        jl.LSystem("A", [jl.Rule("A", lambda: "F")]).rewrite,
        {"steps": 1, "seed": 0, "max_modules": 100, "max_steps": 10},
    ),
    "Rule": lambda: EntryPoint(lambda weight: jl.Rule("A", lambda: "F", weight=weight), {"weight": 2.0}),
    "turtle": lambda: EntryPoint(
        lambda **arguments: jl.turtle("F", **arguments),
        {"angle": 90.0, "length": 1.0, "radius": 0.01, "bud_radius": 0.03, "position": (0.0, 0.0, 0.0)}
        | {"heading": (0.0, 0.0, 1.0), "left": (-1.0, 0.0, 0.0)},
    ),
    "voxelise": lambda: EntryPoint(
        lambda **arguments: jl.voxelise(TREE, **arguments),
        {"voxel_size": 0.5, "leaf_area": 1.0, "samples": 2, "origin": (-1.0, -1.0, 0.0)}
        | {"shape": (4, 4, 4)},
    ),
    "voxelise_copies": lambda: EntryPoint(
        lambda **arguments: jl.voxelise_copies(TREE, **arguments),
        {"position": np.zeros((2, 3)), "voxel_size": 0.5, "leaf_area": 1.0, "samples": 2}
        | {"individual": np.zeros(2, int), "azimuth": np.zeros(2), "offsets": 1, "azimuths": 1}
        | {"scale": np.ones((2, 3)), "origin": (-1.0, -1.0, 0.0), "shape": (4, 4, 4)},
    ),
    "canopy_from_points": lambda: EntryPoint(
        lambda **arguments: jl.canopy_from_points(point_cloud(), **arguments),
        {"voxel_size": 1.0, "reflectance": 0.3, "origin": (0.0, 0.0, 0.0), "shape": (6, 6, 6)},
    ),
    "voxelise_points": lambda: EntryPoint(
        jl.voxelise_points,
        {"points": np.random.default_rng(0).random((9, 3)), "voxel_size": 0.5, "leaf_area": 1.0}
        | {"wood_probability": 0.9, "min_points": 1, "origin": (0.0, 0.0, 0.0), "shape": (2, 2, 2)},
    ),
    "voxelise_mesh": lambda: EntryPoint(
        lambda **arguments: jl.voxelise_mesh(MESH, **arguments),
        {"voxel_size": 0.5, "origin": (0.0, 0.0, 0.0), "shape": (3, 3, 3)},
    ),
    "mesh_of": lambda: EntryPoint(
        lambda **arguments: jl.mesh_of(TREE, **arguments),
        {"sides": 6, "leaves": 3, "leaf_length": 0.1, "seed": 0},
    ),
    "Mesh": lambda: EntryPoint(
        jl.Mesh,
        {"vertices": np.eye(3), "faces": np.array([[0, 1, 2]]), "material": np.array([0])},
    ),
    # -- simulation ------------------------------------------------------------------------------------
    "simulate": lambda: EntryPoint(
        lambda **arguments: jl.simulate(LIDAR, GROUND, key=KEY, **arguments),
        {"rtol": 0.1, "atol": 0.1, "n_photons": 1000, "max_orders": 1, "max_step": 1.0, "n_rays": 64},
    ),
    "Waveforms.returns": lambda: EntryPoint(
        waveforms().returns,
        {"wavelength": 1064.0, "record": waveforms().recorded, "background": 0.0, "noise": 1e-18}
        | {"threshold": 1e-17, "fraction": 0.5, "max_returns": 2},
    ),
    "Waveforms.true_returns": lambda: EntryPoint(
        waveforms().true_returns, {"wavelength": 1064.0, "min_reflectance": 1e-3}
    ),
    "simulate_many": lambda: EntryPoint(
        lambda **arguments: jl.simulate_many(SURVEY, GROUND, key=KEY, **arguments),
        {"rtol": 0.1, "max_orders": 1},
    ),
    "plan": lambda: EntryPoint(
        lambda **arguments: jl.plan(LIDAR, GROUND, **arguments),
        {"rtol": 0.1, "max_orders": 1, "max_step": 1.0, "n_photons": 1000, "n_rays": 64}
        | {"window": (-20.0, 40.0), "bin_width": 0.5, "max_memory": 1e9},
    ),
    "plan_scenes": lambda: EntryPoint(
        lambda **arguments: jl.plan_scenes(LIDAR, [GROUND], **arguments),
        {"rtol": 0.1, "max_orders": 1, "n_photons": 1000, "n_rays": 64, "window": (-20.0, 40.0)},
    ),
    "reflectance_factor": lambda: EntryPoint(
        lambda **arguments: jl.reflectance_factor(GROUND, key=KEY, **arguments),
        {"sun": (30.0, 0.0), "view": (0.0, 0.0), "wavelengths": (650.0, 850.0), "n_photons": 1000}
        | {"max_orders": 1},
        messages={"wavelengths": "wavelength"},
    ),
    "plan_reflectance": lambda: EntryPoint(
        lambda **arguments: jl.plan_reflectance(GROUND, **arguments),
        {"sun": (30.0, 0.0), "view": (0.0, 0.0), "wavelengths": (650.0, 850.0), "n_photons": 1000}
        | {"max_orders": 1},
        messages={"wavelengths": "wavelength"},
    ),
    "energy_budget": lambda: EntryPoint(
        lambda **arguments: jl.energy_budget(LIDAR, GROUND, key=KEY, **arguments),
        {"rtol": 0.1, "max_orders": 10, "max_photons": 1000},
    ),
    "analog_returns": lambda: EntryPoint(
        lambda **arguments: jl.analog_returns(LIDAR, GROUND, plan(), key=KEY, **arguments),
        {"n_photons": 10, "cone": 10.0},
    ),
    "photon_paths": lambda: EntryPoint(
        lambda **arguments: jl.photon_paths(LIDAR, GROUND, plan(), key=KEY, **arguments),
        {"n_photons": 10, "leaving": 5.0},
    ),
    "Waveform.nan_where_lost": lambda: EntryPoint(wave().nan_where_lost, {"share": 0.01}),
    # -- files -----------------------------------------------------------------------------------------
    "io.Segment": lambda: EntryPoint(
        lambda samples, start, step, channel, gain, offset, table: jl.io.AirborneShot(
            0,
            **LINE,
            returning=(jl.io.Segment(samples, start, step, channel, gain, offset, table),),
        ),
        {"samples": np.arange(10.0), "start": 0.0, "step": 1.0, "channel": 0, "gain": 1.0, "offset": 0.0}
        | {"table": 0},
    ),
    "io.AirborneShot": lambda: EntryPoint(
        lambda **arguments: jl.io.AirborneShot(returning=(SEGMENT,), **arguments),
        {"index": 0, **LINE, "noise_mean": 0.0, "noise_std": 1.0, "pedestal": 0.0, "pulse_zero": 0.0}
        | {"metres": np.ones(3), "gps_time": 1.0, "scan_angle": 1.0, "flight_line": 1},
    ),
    "io.AirborneShot.of_channel": lambda: EntryPoint(SHOT.of_channel, {"channel": 0}),
    "io.AirborneShot.time_from": lambda: EntryPoint(SHOT.time_from, {"elevation": 1.0}),
    "io.AirborneShot.position_at": lambda: EntryPoint(SHOT.position_at, {"elevation": 1.0}),
    "io.Case": lambda: EntryPoint(
        lambda rtol: jl.io.Case(LIDAR, GROUND, KEY, {**{"rtol": 0.1}, "rtol": rtol}).simulate(),
        {"rtol": 0.1},
    ),
    "io.read_dem": lambda: EntryPoint(
        lambda **arguments: jl.io.read_dem(dem(), **arguments),
        {"bounds": (0.0, 0.0, 20.0, 20.0), "fill": 0.0, "reflectance": 0.3},
    ),
    "io.read_las": lambda: EntryPoint(lambda scale: jl.io.read_las(las(), scale=scale), {"scale": 2.0}),
    "io.read_obj": lambda: EntryPoint(lambda scale: jl.io.read_obj(obj(), scale=scale), {"scale": 2.0}),
    "io.read_qsm": lambda: EntryPoint(lambda scale: jl.io.read_qsm(qsm(), scale=scale), {"scale": 2.0}),
    "io.read_vox": lambda: EntryPoint(lambda fill: jl.io.read_vox(vox(), fill=fill), {"fill": 1.0}),
    "io.read_gedi_l1b": lambda: EntryPoint(lambda shot: jl.io.read_gedi_l1b(gedi(), shot), {"shot": 0}),
    "io.write_gedi_l1b": lambda: EntryPoint(
        lambda **arguments: jl.io.write_gedi_l1b(
            folder() / "b.h5", [wave(), wave()], SURVEY, key=KEY, **arguments
        ),
        {"origin": (14.0, 50.0), "elevation": 0.0, "shot_number": [1, 2], "margin": 20, "gain": 1e4}
        | {"noise_mean": 240.0, "noise_std": 3.0, "solar_elevation": -20.0},
    ),
    "io.read_gedi_l2a": lambda: EntryPoint(
        lambda shot_number: jl.io.read_gedi_l2a(level_2_file("2A"), shot_number)["rh"],
        {"shot_number": [1, 2]},
    ),
    "io.read_gedi_l2b": lambda: EntryPoint(
        lambda shot_number: jl.io.read_gedi_l2b(level_2_file("2B"), shot_number)["pai"],
        {"shot_number": [1, 2]},
    ),
    "io.read_atl03": lambda: EntryPoint(
        lambda stretch: jl.io.read_atl03(photon_files()[0], stretch=stretch).height, {"stretch": (0.0, 90.0)}
    ),
    "io.read_atl03 latitude": lambda: EntryPoint(
        lambda latitude: jl.io.read_atl03(photon_files()[0], latitude=latitude).height,
        {"latitude": (40.0, 42.0)},
    ),
    "io.read_atl08": lambda: EntryPoint(
        lambda segment: jl.io.read_atl08(photon_files()[1], segment=segment)["ground"], {"segment": 100.0}
    ),
    "io.write_las": lambda: EntryPoint(
        lambda **arguments: jl.io.write_las(folder() / "b.las", **arguments),
        {"position": np.zeros((2, 3)), "intensity": np.ones(2), "return_number": np.array([1, 2])}
        | {"number_of_returns": np.array([2, 2]), "gps_time": np.ones(2)}
        | {"classification": np.array([1, 2]), "scan_angle": np.ones(2), "point_source": np.array([1, 2])},
    ),
    "io.write_las_waveforms": lambda: EntryPoint(
        lambda point_format: jl.io.write_las_waveforms(folder() / "c.las", [SHOT], point_format=point_format),
        {"point_format": 9},
    ),
    "io.write_raster": lambda: EntryPoint(
        with_field(
            lambda **arguments: jl.io.write_raster(folder() / "a.tif", **arguments),
            values=lambda values: {"height": values},
        ),
        {"values": np.array([1.0, 2.0]), "position": TWO},
        missing=("values",),
    ),
    # -- plots -----------------------------------------------------------------------------------------
    "plot.waveform": lambda: EntryPoint(
        lambda **arguments: jl.plot.waveform(wave(), **arguments), {"wavelength": 1064.0, "sigma": 2.0}
    ),
    "plot.residuals": lambda: EntryPoint(
        lambda **arguments: jl.plot.residuals(wave(), **arguments),
        {"observed": observation()["observed"], "noise": 0.1, "wavelength": 1064.0, "limit": 5.0},
    ),
    "plot.fit": lambda: EntryPoint(
        lambda **arguments: jl.plot.fit(wave(), **arguments),
        {"observed": observation()["observed"], "noise": 0.1, "wavelength": 1064.0, "limit": 5.0},
    ),
    "plot.photons": lambda: EntryPoint(
        lambda **arguments: jl.plot.photons(events(), **arguments),
        {"distance": np.zeros(1), "label": np.zeros(len(events().time), int)},
    ),
    "plot.comparison": lambda: EntryPoint(
        with_field(jl.plot.comparison, pairs=lambda x: {"ground": (np.ones(2), x)}),
        {"pairs": np.ones(2)},
        missing=("pairs",),
        messages={"pairs": "ground"},
    ),
    "plot.profile": lambda: EntryPoint(
        jl.plot.profile, {"height": np.arange(3.0), "density": np.ones(2)}, missing=("density",)
    ),
    "plot.averaging_kernel": lambda: EntryPoint(
        jl.plot.averaging_kernel, {"kernel": np.ones((2, 2)), "height": np.arange(3.0)}
    ),
    "plot.spectrum": lambda: EntryPoint(
        lambda wavelength: jl.plot.spectrum(PROSPECT, wavelength=wavelength), {"wavelength": BANDS}
    ),
    "plot.survey": lambda: EntryPoint(
        lambda values: jl.plot.survey(SURVEY, values=values), {"values": np.ones(2)}, missing=("values",)
    ),
    "plot.points": lambda: EntryPoint(
        lambda **arguments: jl.plot.points(waveforms().returns(), **arguments),
        {"size": 1.0, "elevation": 25.0, "azimuth": 200.0},
    ),
    "plot.section": lambda: EntryPoint(
        lambda **arguments: jl.plot.section(waveforms().returns(), **arguments),
        {"start": np.array([-1.0, 0.0]), "end": np.array([9.0, 0.0]), "width": 20.0, "size": 1.0},
    ),
    "plot.waterfall": lambda: EntryPoint(
        lambda **arguments: jl.plot.waterfall(waveforms(), **arguments),
        {"shots": np.arange(2), "distance": np.array([0.0, 1.0]), "wavelength": 1064.0, "overlap": 1.5},
    ),
    "plot.tree": lambda: EntryPoint(
        lambda **arguments: jl.plot.tree(TREE, **arguments),
        {"alpha": 0.5, "max_buds": 10, "elevation": 8.0, "azimuth": 20.0},
    ),
    # -- inversion -------------------------------------------------------------------------------------
    "inversion.Unknown": lambda: EntryPoint(
        lambda **arguments: inversion.Unknown(lambda s: s.ground.height, **arguments),
        {"bounds": (-2.0, 2.0), "prior": (0.0, 1.0), "start": 0.5},
    ),
    "inversion.LogNormal": lambda: EntryPoint(inversion.LogNormal, {"median": 1.0, "spread": 2.0}),
    "inversion.Smooth": lambda: EntryPoint(
        inversion.Smooth, {"scale": 2.0, "spacing": 1.0, "strength": 1.0, "mean": 1.0}
    ),
    "inversion.Smooth.correlation": lambda: EntryPoint(inversion.Smooth(2.0).correlation, {"layers": 3}),
    "inversion.put_profile": lambda: EntryPoint(
        lambda density: inversion.put_profile(
            jl.Scene(canopy=jl.Canopy(VOXELS, leaf=LEAF, hotspot=False)), density
        ),
        {"density": np.ones(2)},
    ),
    "inversion.log_density": lambda: EntryPoint(
        lambda observed, noise, time, **options: inversion.log_density(
            observed, unknowns=[UNKNOWN], noise=noise, time=time, plan=plan(), **FIT, **options
        ),
        {"observed": observation()["observed"], "noise": 0.01, "time": observation()["time"]}
        | {"noise_floor": 0.01, "scale": (0.5, 2.0)},
    ),
    "inversion.retrieve": lambda: EntryPoint(
        lambda observed, noise, time, **options: inversion.retrieve(
            observed, unknowns=[UNKNOWN], noise=noise, time=time, plan=plan(), **FIT, **options
        ),
        {"observed": observation()["observed"], "noise": 0.01, "time": observation()["time"]}
        | {"max_steps": 1, "starts": 1, "noise_floor": 0.01, "scale": (0.5, 2.0)},
    ),
    "inversion.retrieve sizes": lambda: EntryPoint(
        lambda **options: inversion.retrieve(
            observation()["observed"],
            unknowns=[UNKNOWN],
            noise=0.01,
            time=observation()["time"],
            **FIT,
            **options,
        ),
        {"n_photons": 1000, "n_rays": 64, "max_orders": 1},
    ),
    "inversion.retrieve_many": lambda: EntryPoint(
        lambda observed, noise, time, **options: inversion.retrieve_many(
            observed, unknowns=[UNKNOWN], noise=noise, time=time, plan=plan(), **FIT, **options
        ),
        {"observed": observation()["observed"][None], "noise": 0.01, "time": observation()["time"]}
        | {"max_steps": 1, "starts": 1, "noise_floor": 0.01, "scale": (0.5, 2.0), "lanes": 1},
    ),
    "inversion.retrieve_many start": lambda: EntryPoint(
        lambda start: inversion.retrieve_many(
            observation()["observed"][None],
            unknowns=[UNKNOWN],
            noise=0.01,
            time=observation()["time"],
            plan=plan(),
            max_steps=1,
            start={"height": start},
            **FIT,
        ),
        {"start": np.array([0.5])},
    ),
    "inversion.cramer_rao": lambda: EntryPoint(
        lambda **arguments: inversion.cramer_rao(unknowns=[UNKNOWN], plan=plan(), **FIT, **arguments),
        {"noise": 0.01, "time": observation()["time"]},
    ),
    "inversion.cramer_rao sizes": lambda: EntryPoint(
        lambda **arguments: inversion.cramer_rao(unknowns=[UNKNOWN], noise=0.01, **FIT, **arguments),
        {"n_photons": 1000, "n_rays": 64, "max_orders": 1},
    ),
    "inversion.profile_likelihood": lambda: EntryPoint(
        lambda **arguments: inversion.profile_likelihood(
            unknowns=[UNKNOWN], name="height", plan=plan(), max_steps=1, **FIT, **arguments
        ),
        {"observed": observation()["observed"], "values": np.array([0.0, 1.0]), "noise": 0.01}
        | {"time": observation()["time"]},
    ),
    "inversion.judge_record": lambda: EntryPoint(
        inversion.judge_record,
        {"signal": POWER, "noise": 0.01, "pulse": RECORDED_PULSE, "degrade": 0, "stale_return": 0},
    ),
    "inversion.gaussian_decomposition": lambda: EntryPoint(
        inversion.gaussian_decomposition,
        {"time": BINS, "power": POWER, "noise": 0.01, "width": 4.0, "max_echoes": 2},
    ),
    "inversion.gaussian_decomposition with a pulse": lambda: EntryPoint(
        lambda **arguments: inversion.gaussian_decomposition(BINS, POWER, noise=0.01, **arguments),
        {"pulse": RECORDED_PULSE, "pulse_error": 0.01},
    ),
    "inversion.richardson_lucy": lambda: EntryPoint(
        inversion.richardson_lucy, {"power": POWER, "pulse": RECORDED_PULSE, "iterations": 3}
    ),
    "inversion.wiener": lambda: EntryPoint(
        inversion.wiener, {"power": POWER, "pulse": RECORDED_PULSE, "noise_to_signal": 0.01}
    ),
    "inversion.find_ground": lambda: EntryPoint(
        inversion.find_ground,
        {"height": HEIGHT, "power": POWER, "pulse": RECORDED_PULSE, "noise": 0.01, "threshold": 0.1},
    ),
    "inversion.signal_ends": lambda: EntryPoint(
        inversion.signal_ends,
        {"height": HEIGHT, "power": POWER, "noise": 0.01, "pulse": RECORDED_PULSE, "threshold": 6.0},
    ),
    "inversion.relative_heights": lambda: EntryPoint(
        inversion.relative_heights,
        {"height": HEIGHT, "power": POWER, "ground": 0.0, "levels": (25.0, 50.0), "ends": (29.0, 22.0)},
        missing=("ground", "ends"),
    ),
    "inversion.relative_heights without ends": lambda: EntryPoint(
        inversion.relative_heights,
        {"height": HEIGHT, "power": POWER, "noise": 0.01, "pulse": RECORDED_PULSE, "threshold": 6.0},
    ),
    "inversion.ground_and_canopy": lambda: EntryPoint(
        inversion.ground_and_canopy,
        {"height": HEIGHT, "power": POWER, "pulse": RECORDED_PULSE, "ground": 24.0, "ends": (29.0, 22.0)}
        | {"reflectance_ratio": 1.5},
        missing=("ground", "ends"),
    ),
    "inversion.ground_and_canopy without ends": lambda: EntryPoint(
        inversion.ground_and_canopy,
        {"height": HEIGHT, "power": POWER, "pulse": RECORDED_PULSE, "noise": 0.01},
    ),
    "inversion.gap_probability": lambda: EntryPoint(
        inversion.gap_probability,
        {"canopy": np.array([0.1, 0.2]), "ground": 0.3, "reflectance_ratio": 1.5},
    ),
    "inversion.plant_area_index": lambda: EntryPoint(
        inversion.plant_area_index,
        {"gap": np.array([0.9, 0.5]), "zenith": 0.0, "projection": 0.5, "clumping": 1.0},
        missing=("gap",),
    ),
    "inversion.plant_area_profile": lambda: EntryPoint(
        inversion.plant_area_profile,
        {"height": HEIGHT, "power": POWER, "edges": np.array([0.0, 2.0, 4.0]), "pulse": RECORDED_PULSE}
        | {"ground": 24.0, "ends": (29.0, 22.0), "reflectance_ratio": 1.5, "zenith": 0.0}
        | {"projection": 0.5, "clumping": 1.0, "smallest_gap": 1e-3},
        missing=("ground", "ends"),
    ),
    "inversion.gedi_metrics": lambda: EntryPoint(
        lambda elevation, waveform, noise_mean, noise_std, **settings: inversion.gedi_metrics(
            [
                types.SimpleNamespace(
                    elevation=elevation, waveform=waveform, noise_mean=noise_mean, noise_std=noise_std
                )
            ],
            inversion.GediSettings(**settings),
        ),
        {"elevation": HEIGHT, "waveform": POWER, "noise_mean": 0.0, "noise_std": 0.01, "smoothing": 6.5}
        | {"mode_smoothing": 6.5, "front_threshold": 3.0, "back_threshold": 6.0},
    ),
    "inversion.gedi_settings": lambda: EntryPoint(inversion.gedi_settings, {"group": 1}),
    "inversion.gedi_table": lambda: EntryPoint(
        lambda **arguments: inversion.gedi_table([], **arguments)["ground"],
        {"group": 1, "edges": np.array([0.0, 5.0]), "reflectance_ratio": 1.5, "projection": 0.5}
        | {"clumping": 1.0},
    ),
    "inversion.compare": lambda: EntryPoint(
        lambda sigmas: inversion.compare({"h": np.ones(2)}, {"h": np.ones(2)}, on=None, sigmas=sigmas),
        {"sigmas": 2.0},
    ),
    "inversion.photon_ground_and_canopy": lambda: EntryPoint(
        lambda **arguments: inversion.photon_ground_and_canopy(events(), **arguments),
        {
            "distance": np.zeros(1),
            "segment": 20.0,
            "percentile": 98.0,
            "background_rate": 1.0,
            "least": 5,
        },
    ),
    "inversion.clumped_leaves": lambda: EntryPoint(
        lambda **arguments: inversion.clumped_leaves(
            jl.Scene(canopy=jl.Canopy(VOXELS, leaf=LEAF)), key=KEY, **arguments
        ),
        {"density": 0.6, "size": (3.0, 4.0)},
    ),
    "inversion.MarkovField": lambda: EntryPoint(inversion.MarkovField, {"difference": 0.1, "mean": 0.2}),
    "inversion.geolocate": lambda: EntryPoint(
        lambda **arguments: inversion.geolocate(
            survey=jl.Survey(jl.Lidar(divergence=20.0), TWO), scene=GROUND, key=KEY, **arguments
        ),
        {"records": np.stack([POWER, POWER]), "height": HEIGHT, "noise": 0.01, "search_radius": 2.0}
        | {"height_error": 0.1, "ratio_error": 0.5, "max_orders": 1, "rtol": 0.1},
    ),
    "inversion.retrieve_scene": lambda: EntryPoint(
        lambda **arguments: inversion.retrieve_scene(
            survey=SURVEY, scene=GROUND, unknowns=[UNKNOWN], key=KEY, **arguments
        ),
        {
            "waveforms": np.asarray(waveforms().reflectance),
            "time": np.asarray(waveforms().time),
            "noise": 0.01,
        }
        | {"gain": (0.5, 2.0), "offset": (-0.1, 0.1), "groups": np.zeros(2, int), "held_out": 0.0}
        | {"max_steps": 2, "draws": 1, "max_orders": 1, "n_rays": 8, "n_photons": 8},
    ),
    "inversion.Recorder": lambda: EntryPoint(
        inversion.Recorder,
        {
            "width": (0.1, 1.0),
            "impulse": np.array([0.0, 0.5, 1.0, 0.5, 0.0]),
            "offset": (-0.1, 0.1),
            "interleaved": 1,
            "pulse_noise": 0.1,
        }
        | {"correlation": 0.1},
    ),
    "inversion.Recorder.recorded": lambda: EntryPoint(
        lambda reflectance, step: inversion.Recorder().recorded(reflectance, {}, step=step),
        {"reflectance": observation()["observed"], "step": 1.0},
    ),
    "inversion.receiver_impulse": lambda: EntryPoint(
        with_field(
            inversion.receiver_impulse,
            pulses=lambda x: [x] * 3,
            echoes=lambda x: [x] * 3,
            noise=lambda x: [x] * 3,
        ),
        {"pulses": RECORDED_PULSE, "echoes": POWER, "noise": np.full(60, 0.01), "before": 2, "after": 4}
        | {"interleaved": 1},
    ),
    "inversion.shot_response": lambda: EntryPoint(
        lambda signal, noise_std, pulse_time, pulse_power, fraction: inversion.shot_response(
            [
                types.SimpleNamespace(
                    signal=signal, noise_std=noise_std, pulse_time=pulse_time, pulse_power=pulse_power
                )
            ]
            * 3,
            fraction=fraction,
        ),
        {"signal": np.exp(-0.5 * ((np.arange(300.0) - 100.0) / 7.0) ** 2), "noise_std": 0.01}
        | {"pulse_time": np.arange(21.0) - 10.0, "pulse_power": RECORDED_PULSE, "fraction": 0.5},
    ),
    "inversion.recorded_pulse": lambda: EntryPoint(
        inversion.recorded_pulse, {"time": np.arange(21.0), "power": RECORDED_PULSE, "finer": 4}
    ),
    "inversion.amplitudes": lambda: EntryPoint(
        inversion.amplitudes,
        {"counts": np.array([0.0, 1.0, 2.0]), "table": TABLE, "noise": 0.1, "saturation": 3.0},
        missing=("table",),
    ),
    "inversion.corrected_table": lambda: EntryPoint(
        with_field(inversion.corrected_table, pulses=lambda x: [x] * 3, echoes=lambda x: [x] * 3),
        {"table": TABLE, "pulses": np.array([0, 0, 1, 3, 1, 0, 0, 0]), "noise": 0.1}
        | {"echoes": np.array([0, 0, 0, 1, 3, 1, 0, 0, 0, 0]), "knots": np.array([0.0, 4.0])}
        | {"before": 2, "after": 2},
        missing=("table",),
    ),
    "inversion.invert_leaves": lambda: EntryPoint(
        inversion.invert_leaves,
        {"wavelengths": BANDS, "reflectance": SPECTRA, "transmittance": 0.8 * SPECTRA, "noise": 0.01}
        | {"max_steps": 5, "chunk": 2},
        missing=("reflectance", "transmittance"),
    ),
    "inversion.invert_leaves bounds": lambda: EntryPoint(
        with_field(
            lambda **arguments: inversion.invert_leaves(BANDS, SPECTRA, max_steps=5, **arguments),
            bounds=lambda x: {"Cab": x},
            domain=lambda x: {"Cab": x},
        ),
        {"bounds": (1.0, 90.0), "domain": (500.0, 1100.0)},
        messages={"bounds": "bounds", "domain": "domain"},
    ),
}
