"""The canopies HET01, HET04 and HET06 of RAMI, as discs and as voxels, and their reference values.

A folder holds the scene files and the reference values of Eradiate's regression tests: `*.def` with discs
(radius, centre, normal) and positions of crowns (x, y, z), and `het0?_brfpp_ref.nc`, NetCDF, with `vza`, the
view zenith angle in degrees, negative on the side of the sun, and `brf`, the reflectance factor.

- HET01, floating spheres: 15 spheres of 10 m radius, each of the same 49,999 discs, on a periodic square of
  100 m.
- HET04, real zoom-in: 205 spheres of 4 m radius (31,999 discs) and 409 cylinders of 3 m radius and 12 m
  height (17,999 discs), on a periodic square of 270 m.
- HET06, conifers: 10,000 cones of 1.8 m radius and 12 m height (6,480 discs) on trunks, on a square of 500 m
  with nothing around it. The places of the discs are unknown; they are drawn here as the reference drew them.

Optics and angles are those of the code that made the reference.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import h5py
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxlidar as jl
from jaxlidar.extend import as_scalar, dot, from_frame, polar

NAMES = ("HET01", "HET04", "HET06")
WAVELENGTH = 550.0
# Corners of the polygon that stands for a disc, and points that spread its area over voxels.
CORNERS, POINTS = 6, 4
# Points a voxel that fill the outline of a crown evenly.
EVEN_POINTS = 30
# Leaf inclination in HET06: theta / 90 degrees has a Beta distribution with these parameters.
INCLINATION = (1.853, 1.066)
CONE_RADIUS, CONE_HEIGHT, CONE_DISCS, CONE_DISC_RADIUS = 1.8, 12.0, 6480, 0.05
TRUNK_RADIUS, TRUNK_HEIGHT, TRUNK_SIDES = 0.15, 1.5, 24
# Azimuths, clockwise from north: the sun stands in the east, views of negative zenith angles as well.
EAST, WEST = 90.0, 270.0


class Outline(NamedTuple):
    """Outline of a crown: its volume, m3, and a function that draws n points in it, (n, 3)."""

    volume: float
    draw: Callable[[int], np.ndarray]


class Cloud(NamedTuple):
    """Copies of a crown of discs.

    - `discs`: (n, 7) radius, centre and normal, m. - `position`: (copies, 3) m.
    - `reflectance`, `transmittance`: of a disc. - `outline`: of the crown.
    """

    discs: np.ndarray
    position: np.ndarray
    reflectance: float
    transmittance: float
    outline: Outline


class Forest(NamedTuple):
    """A canopy of RAMI.

    - `clouds`: kinds of crowns. - `ground`: its reflectance. - `sun`: zenith angle, degrees.
    - `side`, `height`: of the scene, m. - `is_periodic`: False if there is nothing around it.
    - `target_height`: height of the square that the sensor looks at, m.
    - `leaf_angles`: of voxels. - `trunks`: reflectance of trunks.
    """

    clouds: tuple[Cloud, ...]
    ground: float
    sun: float
    side: float
    height: float
    is_periodic: bool
    target_height: float
    leaf_angles: str | jl.LeafAngles = "spherical"
    trunks: float = 0.0

    def area(self, zenith: float) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the area in view on the ground: the target, moved down along the line of sight."""
        shift, half = self.target_height * np.tan(np.deg2rad(zenith)), 0.5 * self.side
        return (shift - half, -half), (shift + half, half)


def read_forest(folder: Path, name: str) -> Forest:
    """Read a canopy from the scene files of a folder."""

    def load(file: str) -> np.ndarray:
        (path,) = folder.rglob(file)
        return np.loadtxt(path)

    if name == "HET01":
        crowns, places = load("het01_UNI_sphere.def"), load("het01_UNI_instances.def")
        spheres = Cloud(crowns, places, 0.4957, 0.4409, sphere(10.0))
        return Forest((spheres,), 0.159, 20.0, 100.0, 30.0, True, 30.0)
    if name == "HET04":
        crowns, places = load("het04_sph.def"), load("het04_sph_positions.def")
        spheres = Cloud(crowns, places, 0.49, 0.41, sphere(4.0))
        crowns, places = load("het04_cyl.def"), load("het04_cyl_positions.def")
        cylinders = Cloud(crowns, places, 0.45, 0.30, cylinder(3.0, 12.0))
        return Forest((spheres, cylinders), 0.15, 20.0, 270.0, 15.0, True, 15.0)
    cones = Cloud(cone_discs(), load("het06_scene.def"), 0.08, 0.03, cone())
    a, b = INCLINATION
    mean, std = a / (a + b), np.sqrt(a * b / (a + b + 1)) / (a + b)
    angles = jl.LeafAngles.beta(90 * mean, 90 * std)
    height = TRUNK_HEIGHT + CONE_HEIGHT
    return Forest((cones,), 0.86, 40.0, 500.0, height, False, 0.5 * height, angles, 0.14)


def read_reference(folder: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the view zenith angles, degrees, and the reflectance factors of the reference."""
    (path,) = folder.rglob(f"{name.lower()}_brfpp_ref.nc")
    with h5py.File(path) as file:
        return file["vza"][:, 0], file["brf"][0, 0, :, 0, 0]


def cone_discs(seed: int = 1) -> np.ndarray:
    """Return the discs of a conifer, drawn at random."""
    rng = np.random.default_rng(seed)
    theta, turns = 0.5 * np.pi * rng.beta(*INCLINATION, CONE_DISCS), rng.uniform(size=CONE_DISCS)
    normal = np.column_stack([np.sin(theta)[:, None] * _circle(turns), np.cos(theta)])
    return np.column_stack([np.full(CONE_DISCS, CONE_DISC_RADIUS), cone().draw(CONE_DISCS), normal])


def cone(seed: int = 2) -> Outline:
    """Return the crown of a conifer, whose base lies at the top of the trunk."""

    def draw(n: int) -> np.ndarray:
        rng = np.random.default_rng(seed)
        depth = CONE_HEIGHT * rng.uniform(size=n) ** (1 / 3)
        radius = CONE_RADIUS * depth / CONE_HEIGHT * np.sqrt(rng.uniform(size=n))
        plan = radius[:, None] * _circle(rng.uniform(size=n))
        return np.column_stack([plan, TRUNK_HEIGHT + CONE_HEIGHT - depth])

    return Outline(np.pi / 3 * CONE_RADIUS**2 * CONE_HEIGHT, draw)


def cylinder(radius: float, height: float, seed: int = 2) -> Outline:
    """Return a cylinder upon the origin."""

    def draw(n: int) -> np.ndarray:
        rng = np.random.default_rng(seed)
        plan = radius * np.sqrt(rng.uniform(size=(n, 1))) * _circle(rng.uniform(size=n))
        return np.column_stack([plan, rng.uniform(0.0, height, n)])

    return Outline(np.pi * radius**2 * height, draw)


def sphere(radius: float, seed: int = 2) -> Outline:
    """Return a sphere about the origin."""

    def draw(n: int) -> np.ndarray:
        rng = np.random.default_rng(seed)
        direction = rng.normal(size=(n, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return radius * rng.uniform(size=(n, 1)) ** (1 / 3) * direction

    return Outline(4 / 3 * np.pi * radius**3, draw)


def _circle(turns: np.ndarray) -> np.ndarray:
    """Return points of the unit circle, (*shape of turns, 2)."""
    return np.stack([np.cos(2 * np.pi * turns), np.sin(2 * np.pi * turns)], axis=-1)


def on_discs(discs: np.ndarray, radius: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Return points in the planes of discs, at polar coordinates in units of their radius; (n, points, 3)."""
    normal = discs[:, 4:] / np.linalg.norm(discs[:, 4:], axis=1, keepdims=True)
    # Across the normal, from the axis that is least along it.
    axis = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    first = np.cross(normal, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normal, first)
    plane = (discs[:, :1] * radius)[..., None] * _circle(turns)
    return discs[:, None, 1:4] + plane[..., :1] * first[:, None] + plane[..., 1:] * second[:, None]


def polygons(discs: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of regular polygons of the discs' areas, turned at random."""
    circumradius = np.sqrt(np.pi / (0.5 * CORNERS * np.sin(2 * np.pi / CORNERS)))
    turns = np.arange(CORNERS) / CORNERS + np.random.default_rng(seed).uniform(size=(len(discs), 1))
    vertices = on_discs(discs, np.full(CORNERS, circumradius), turns)
    fan = np.array([(0, k, k + 1) for k in range(1, CORNERS - 1)])
    faces = np.arange(len(discs))[:, None, None] * CORNERS + fan
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)


def points(discs: np.ndarray, seed: int = 0) -> np.ndarray:
    """Return points that stand for equal shares of the discs' areas; (POINTS n, 3)."""
    k = np.arange(POINTS) + 0.5
    # A spiral of the golden angle covers a disc evenly.
    turns = 0.5 * (3 - np.sqrt(5)) * k + np.random.default_rng(seed).uniform(size=(len(discs), 1))
    return on_discs(discs, np.sqrt(k / POINTS), turns).reshape(-1, 3)


def density(cloud: Cloud, forest: Forest, size: float, even: bool) -> np.ndarray:
    """Return the leaf area density of a kind of crown in voxels of a size, m2/m3; (nx, ny, nz).

    `even`: spread the area of the discs evenly over the outline of the crown.
    """
    n, layers = round(forest.side / size), int(np.ceil(forest.height / size))
    total = np.zeros((n, n, layers), np.float32)
    n_even = round(EVEN_POINTS * cloud.outline.volume / size**3)
    of_crown = cloud.outline.draw(n_even) if even else points(cloud.discs)
    of_crown += (0.5 * forest.side, 0.5 * forest.side, 0.0)
    for position in cloud.position:
        index = np.floor((of_crown + position) / size).astype(np.int32)
        # Some discs reach a few centimetres into the ground, or above the scene.
        index[:, 2] = np.clip(index[:, 2], 0, layers - 1)
        low = index.min(axis=0)
        box = index.max(axis=0) - low + 1
        count = np.bincount(np.ravel_multi_index((index - low).T, box), minlength=box.prod())
        x, y, z = (start + np.arange(length) for start, length in zip(low, box))
        # Discs that cross a side enter by the opposite one; where nothing repeats there are few of them.
        total[np.ix_(x % n, y % n, z)] += count.reshape(box)
    leaf_area = np.pi * np.sum(cloud.discs[:, 0] ** 2)
    return leaf_area / len(of_crown) / size**3 * total


class LeafScattering(jl.AbstractPhase):
    """Scattering by leaves of spherical orientation that reflect and transmit by the cosine law.

    With beta the scattering angle and t the share of the scattered light that is transmitted, the intensity
    factor is

        2 / (3 pi) (sin beta - beta cos beta) + 2 t / 3 cos beta

    (Ross 1981). A map has one kind of leaf; this makes bark another.
    """

    albedo: Array
    transmitted: Array
    cosine: Array
    cumulative: Array

    def __init__(self, reflectance: float, transmittance: float):
        self.albedo = as_scalar(reflectance + transmittance, "albedo")
        self.transmitted = as_scalar(transmittance / (reflectance + transmittance), "transmitted")
        # The distribution function of the cosine, to be inverted.
        cosine = np.linspace(-1.0, 1.0, 4097)
        middle = 0.5 * (cosine[1:] + cosine[:-1])
        share = np.append(0.0, np.cumsum(self._factor(middle, float(self.transmitted), np)))
        self.cosine, self.cumulative = jnp.asarray(cosine), jnp.asarray(share / share[-1])

    @staticmethod
    def _factor(cosine, transmitted, xp):
        beta = xp.arccos(cosine)
        return 2 / (3 * np.pi) * (xp.sin(beta) - beta * cosine) + 2 / 3 * transmitted * cosine

    def intensity_factor(self, incident, view):
        return self._factor(jnp.clip(dot(incident, view), -1.0, 1.0), self.transmitted, jnp)

    def sample(self, incident, u, v):
        cosine = jnp.interp(u, self.cumulative, self.cosine)
        return from_frame(incident, polar(cosine, 2 * np.pi * v))

    def largest_intensity_factor(self):
        return 2 / 3


def trunk() -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of an upright trunk."""
    k = np.arange(TRUNK_SIDES)
    ring = TRUNK_RADIUS * _circle(k / TRUNK_SIDES)
    low, high = (np.column_stack([ring, np.full(TRUNK_SIDES, z)]) for z in (0.0, TRUNK_HEIGHT))
    following = (k + 1) % TRUNK_SIDES
    lower = np.stack([k, following, following + TRUNK_SIDES], axis=1)
    upper = np.stack([k, following + TRUNK_SIDES, k + TRUNK_SIDES], axis=1)
    return np.concatenate([low, high]), np.concatenate([lower, upper])


def surroundings(forest: Forest) -> tuple[jl.Terrain | None, tuple[jl.MeshSurface, ...]]:
    """Return the ground where it has no end, and the meshes of a ground that has, and of trunks."""
    half = 0.5 * forest.side
    if forest.is_periodic:
        ground = jl.Terrain(
            np.zeros((2, 2)), half, origin=(-half, -half), reflectance=forest.ground, sides="periodic"
        )
        return ground, ()
    corners = [[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]]
    square = jl.MeshSurface((corners, [[0, 1, 2], [0, 2, 3]]), reflectance=forest.ground)
    copies = jl.MeshInstances(forest.clouds[0].position)
    return None, (square, jl.MeshSurface(trunk(), reflectance=forest.trunks, instances=copies))


def disc_scene(forest: Forest) -> jl.Scene:
    """Return the canopy with its discs as triangles."""
    ground, meshes = surroundings(forest)
    leaves = tuple(
        jl.MeshSurface(
            polygons(cloud.discs),
            reflectance=cloud.reflectance,
            transmittance=cloud.transmittance,
            instances=jl.MeshInstances(cloud.position),
        )
        for cloud in forest.clouds
    )
    return jl.Scene(meshes=(*leaves, *meshes), ground=ground)


def voxel_scene(forest: Forest, size: float, even: bool = False) -> jl.Scene:
    """Return the canopy with the area of its discs in voxels of a size, m, or spread evenly over crowns."""
    first, *others = forest.clouds
    bark = {"bark": 0.5 * density(others[0], forest, size, even)} if others else {}
    origin = (-0.5 * forest.side, -0.5 * forest.side, 0.0)
    voxels = jl.VoxelMap.from_lad(
        density(first, forest, size, even),
        voxel_size=size,
        origin=origin,
        leaf_angles=forest.leaf_angles,
        **bark,
    )
    canopy = jl.Canopy(
        voxels,
        leaf=jl.LeafOptics(first.reflectance, first.transmittance),
        bark=LeafScattering(others[0].reflectance, others[0].transmittance) if others else None,
        sides="periodic" if forest.is_periodic else "open",
    )
    ground, meshes = surroundings(forest)
    return jl.Scene(canopy=canopy, meshes=meshes, ground=ground)
