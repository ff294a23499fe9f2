"""Leaves as triangles: random realisations of the turbid media that voxels and leaf clumps stand for.

A voxel of volume V and leaf area density LAD holds a Poisson number of leaves of one-sided area a, with the
mean LAD V / a. Their centres are uniform within it, their inclinations have the leaf angle distribution,
and their azimuths are uniform, as are turns about their normals. The number of leaves that a thin beam of the
direction w meets along a path s is then Poisson, too, with the mean tau = G(w) LAD s, so that the mean of
many realisations is the law of Beer and Lambert,

    P(gap) = exp(-tau),    E[first-order return per m] = R f G LAD exp(-tau),

whatever the size and the outline of leaves; f is the intensity factor of the leaves' backscatter (2/3 for
spherical ones). The way back is the gap of the way there: the transmittance is exp(-tau), not exp(-2 tau),
as `Canopy(hotspot=True)` has it. Leaves reach out of the voxels of their centres by half their length.

Source: Nilson (1971), Agric. Meteorol. 8, 25 (Poisson model); Kuusk (1985), Kosmicheskie issledovaniya 23,
548 (hot spot).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from jaxlidar._fields.checks import (
    check_choice,
    check_key,
    check_kind,
    check_number,
    concrete_array,
    has_tracers,
    is_within_program,
    kind_of,
)
from jaxlidar._jax.memory import format_bytes, machine_memory
from jaxlidar.optics.leaf import LeafOptics
from jaxlidar.optics.leaf_angles import ANGLE_CELLS, LeafAngles
from jaxlidar.optics.phase import AbstractPhase
from jaxlidar.optics.prospect import Prospect
from jaxlidar.optics.spectra import Spectrum
from jaxlidar.plants.meshes import LEAF_OUTLINES, Mesh, leaf_corners, leaf_faces, points_in_clumps
from jaxlidar.plants.point_canopy import PointCanopy
from jaxlidar.plants.stand import Stand
from jaxlidar.plants.tree import Tree
from jaxlidar.scenes.mesh_surface import MeshInstances, MeshSurface
from jaxlidar.scenes.voxels import VoxelMap

# Wavelengths, nm, at which a leaf model is tabulated, as a mesh has spectra: those of PROSPECT.
_WAVELENGTHS = np.arange(400.0, 2501.0)
# Bytes that a triangle takes while its surface is made and its tree built (measured), and the largest share
# of the memory of the machine for them.
_TRIANGLE_BYTES, _MEMORY_SHARE = 450.0, 0.75
# Copies of an individual share leaves if their proportions and leaf areas agree to so many digits.
_DIGITS = 6


def leaf_mesh(
    voxels_or_tree: VoxelMap | PointCanopy | Tree | Stand,
    leaf_area: float = 0.005,
    *,
    key: Array,
    shape: str = "rhombus",
    leaf: Callable | None = None,
    leaf_angles: str | LeafAngles | None = None,
    clump_leaf_area: float | None = None,
) -> MeshSurface | tuple[MeshSurface, ...]:
    """Make leaves as triangles, at random places, which light hits or misses.

    A voxel returns the expected light of its leaves, so that almost every beam has a return from every crown.
    Over leaves, a beam passes with the gap probability of Beer and Lambert, and the mean waveform is that of
    the voxels. Use leaves for point clouds and gap fractions, voxels for waveforms and retrieval.

    The number of leaves of each voxel, or leaf clump, is Poisson; places are uniform within it. Wood is left
    out: keep the bark of voxels as `dataclasses.replace(voxels, leaf=None)`, or take `mesh_of(tree,
    leaves=0)`.

    **Arguments:**

    - `voxels_or_tree`: a `VoxelMap`; what `canopy_from_points` returns; a `Tree`; or a `Stand`, of which
      copies of one individual with the same proportions and leaf area per squared size share leaves, as
      instances. Copies that share with no other are put into one mesh.
    - `leaf_area`: one-sided area of a leaf, m2, positive. In a stand it is the mean over the copies that
      share leaves, which are scaled with their tree. Default 0.005.
    - `key`: JAX random key.
    - `shape`: outline of a leaf: "rhombus" of two triangles, half as wide as long; "ellipse", an octagon of
      six; "needle", a triangle 17 times as long as wide. Default "rhombus".
    - `leaf`: leaf optics: a `LeafOptics`, a `Prospect`, or any function of the wavelengths in nm that returns
      (reflectance, transmittance), which is tabulated from 400 to 2500 nm. Default None:
      `Prospect()`.
    - `leaf_angles`: distribution of leaf inclination, a name or a `LeafAngles`, as for `VoxelMap.from_lad`.
      Default None: that of the voxel map; of trees spherical.
    - `clump_leaf_area`: one-sided leaf area of each leaf clump of a tree, m2, positive. Default None: that of
      the stand; without one `leaf_area`, a leaf for each clump.

    **Returns:** a `MeshSurface` of the material "leaf", two-sided; of a stand a tuple of them, one or more of
    each individual, for `Scene(meshes=)`. Its copies are numbered as the trees of the stand, from 1, for
    `DiscreteReturns.labelled`.

    **Raises:** ValueError for numbers outside their ranges, an unknown shape or name of a distribution, a
    canopy without leaf, `clump_leaf_area` for voxels, and more leaves than memory holds, with their number;
    TypeError for objects of another kind.

    **Example:** a crown of 51 m2 of leaves.

    >>> import jax, numpy as np, jaxlidar as jl
    >>> voxels = jl.VoxelMap.from_lad(np.full((4, 4, 4), 0.8), voxel_size=1.0, origin=(0, 0, 2))
    >>> leaves = jl.leaf_mesh(voxels, leaf_area=0.01, key=jax.random.key(0))
    >>> scene = jl.Scene(meshes=[leaves], ground=jl.Ground(reflectance=0.3))
    >>> print(f"{0.01 * leaves.n_triangles / 2:.0f} m2 of leaves")
    51 m2 of leaves
    """
    kinds = VoxelMap | PointCanopy | Tree | Stand
    check_kind("voxels_or_tree", voxels_or_tree, kinds, "a VoxelMap, a PointCanopy, a Tree or a Stand")
    check_number("leaf_area", leaf_area, 0.0, low_open=True)
    check_key(key)
    if is_within_program() or has_tracers((voxels_or_tree, leaf, key)):
        raise TypeError(
            "leaves are made within a JAX transformation; admissible is to make them outside, and to replace "
            "the optics or the vertices of the surface within"
        )
    check_choice("shape", shape, tuple(LEAF_OUTLINES))
    check_kind("leaf_angles", leaf_angles, str | LeafAngles | None, "a name, a LeafAngles or None")
    if clump_leaf_area is not None:
        check_number("clump_leaf_area", clump_leaf_area, 0.0, low_open=True)
    angles = LeafAngles.named(leaf_angles) if isinstance(leaf_angles, str) else leaf_angles
    optics = _optics(Prospect() if leaf is None else leaf)
    random = np.random.default_rng(np.asarray(jax.random.bits(key, (8,), np.uint32)))
    voxels = voxels_or_tree.voxels if isinstance(voxels_or_tree, PointCanopy) else voxels_or_tree
    if isinstance(voxels, VoxelMap):
        if clump_leaf_area is not None:
            raise ValueError(f"clump_leaf_area = {clump_leaf_area:g}, but voxels have no leaf clumps")
        clouds = [_in_voxels(voxels, leaf_area, shape, random)]
        angles = voxels.leaf_angles if angles is None else angles
    elif isinstance(voxels, Tree):
        area = leaf_area if clump_leaf_area is None else clump_leaf_area
        counts = _counts(np.full(len(voxels.bud_radius), area), leaf_area, shape, random)
        clouds = [_Leaves(points_in_clumps(voxels, counts, random), leaf_area)]
    else:
        clouds = _in_stand(voxels, leaf_area, clump_leaf_area, shape, random)
    angles = LeafAngles.named("spherical") if angles is None else angles
    crs = None if isinstance(voxels, Tree) else voxels.crs
    surfaces = tuple(_surface(leaves, shape, angles, optics, random, crs) for leaves in clouds)
    return surfaces if isinstance(voxels, Stand) else surfaces[0]


class _Leaves(NamedTuple):
    """Leaves of one mesh: their centres, m, the one-sided area of each, m2, and the places of its copies.

    `instance`: number of the tree of each leaf, where the mesh is that of several trees.
    """

    centre: Float[np.ndarray, "leaves 3"]
    leaf_area: float
    instances: MeshInstances | None = None
    instance: Int[np.ndarray, " leaves"] | None = None


def _optics(leaf: Any) -> tuple[Any, Any]:
    """Return reflectance and transmittance of leaf optics, as a `MeshSurface` takes them."""
    if isinstance(leaf, LeafOptics):
        return leaf.reflectance, leaf.transmittance
    if not callable(leaf) or isinstance(leaf, type | Spectrum | AbstractPhase):
        raise TypeError(
            f"leaf is {kind_of(leaf)}; admissible are leaf optics, such as LeafOptics(reflectance=0.4, "
            "transmittance=0.3)"
        )
    optics = leaf(_WAVELENGTHS)
    if not isinstance(optics, tuple) or len(optics) != 2:
        raise TypeError(f"leaf returns {kind_of(optics)}; admissible is (reflectance, transmittance)")
    return Spectrum(_WAVELENGTHS, optics[0]), Spectrum(_WAVELENGTHS, optics[1])


def _counts(
    area: Float[np.ndarray, "n"], leaf_area: float, shape: str, random: np.random.Generator
) -> Int[np.ndarray, "n"]:
    """Draw Poisson numbers of leaves for volumes with one-sided leaf areas `area`, m2.

    **Raises:** ValueError where there is no leaf, and for more leaves than memory holds.
    """
    expected, n_triangles = float(area.sum()) / leaf_area, LEAF_OUTLINES[shape][0] - 2
    if expected == 0.0:
        raise ValueError("voxels_or_tree has no leaf area; admissible is a canopy with leaf")
    size, limit = expected * n_triangles * _TRIANGLE_BYTES, _MEMORY_SHARE * machine_memory()
    if size > limit:
        raise ValueError(
            f"leaf_area = {leaf_area:g} m2 makes about {expected:,.0f} leaves of {area.sum():,.0f} m2, for "
            f"which {format_bytes(size)} of memory are needed; admissible on this machine are "
            f"{limit / n_triangles / _TRIANGLE_BYTES:,.0f}: larger leaves, a part of the map, or a Stand, "
            "whose copies of a tree share leaves"
        )
    counts = random.poisson(area / leaf_area)
    if not counts.any():
        raise ValueError(
            f"leaf_area = {leaf_area:g} m2, but the canopy has {area.sum():.3g} m2 of leaves, of which none "
            "was drawn; admissible is a smaller area"
        )
    return counts


def _in_voxels(voxels: VoxelMap, leaf_area: float, shape: str, random: np.random.Generator) -> _Leaves:
    """Draw leaves in the voxels of a map, whose extinction of leaf is half the leaf area density."""
    size, origin = concrete_array(voxels.voxel_size), concrete_array(voxels.origin)
    density = np.zeros(1) if voxels.leaf is None else 2.0 * concrete_array(voxels.leaf)
    counts = _counts(density.ravel() * size.prod(), leaf_area, shape, random)
    index = np.repeat(np.arange(counts.size), counts)
    corner = np.stack(np.unravel_index(index, voxels.shape), axis=1)
    return _Leaves(origin + size * (corner + random.uniform(size=corner.shape)), leaf_area)


def _in_stand(
    stand: Stand, leaf_area: float, clump_area: float | None, shape: str, random: np.random.Generator
) -> list[_Leaves]:
    """Draw leaves in the clumps of a stand, once for all copies that are alike.

    A mesh is scaled as a whole: with the horizontal scale h of a copy, its leaves and their sum by h^2, its
    heights by h. Copies of an individual are alike if v / h and A / h^2 agree, with the vertical scale v and
    the leaf area of a clump A. Those that are like no other are placed and put into one mesh.
    """
    horizontal, vertical = stand.scale[:, 0], stand.scale[:, 1]
    stated = stand.leaf_area if clump_area is None else np.full(len(stand), clump_area)
    area = np.full(len(stand), leaf_area) if stated is None else stated
    n_clumps = np.array([len(tree.bud_radius) for tree in stand.individuals])[stand.individual]
    (leafy,) = np.nonzero((area > 0) & (n_clumps > 0))
    if not len(leafy):
        raise ValueError("voxels_or_tree has no leaf area; admissible is a stand with leaf")
    ratios = np.log([vertical / horizontal, np.where(area > 0, area, 1.0) / horizontal**2])
    kinds = np.stack([stand.individual, *ratios.round(_DIGITS)])[:, leafy]
    _, kind, count = np.unique(kinds, axis=1, return_inverse=True, return_counts=True)
    groups = [leafy[kind.ravel() == k] for k in np.flatnonzero(count > 1)]
    meshes = []
    for copies in groups:
        first, h = copies[0], horizontal[copies]
        tree = stand.individuals[stand.individual[first]]
        tree = tree.scaled((1.0, float(vertical[first] / horizontal[first]), 1.0))
        leaf = leaf_area / float(np.mean(h**2))
        counts = _counts(np.full(n_clumps[first], area[first] / h[0] ** 2), leaf, shape, random)
        places = MeshInstances(stand.position[copies], stand.azimuth[copies], h, copies + 1)
        meshes.append(_Leaves(points_in_clumps(tree, counts, random), leaf, places))
    single = leafy[count[kind] == 1]
    if len(single):
        trees = Tree.joined(stand[int(i)] for i in single)
        counts = _counts(np.repeat(area[single], n_clumps[single]), leaf_area, shape, random)
        number = np.repeat(np.repeat(single + 1, n_clumps[single]), counts)
        meshes.append(_Leaves(points_in_clumps(trees, counts, random), leaf_area, instance=number))
    return meshes


def _surface(
    leaves: _Leaves,
    shape: str,
    angles: LeafAngles,
    optics: tuple[Any, Any],
    random: np.random.Generator,
    crs: str | None,
) -> MeshSurface:
    """Return the surface of leaves with inclinations of a distribution, random azimuths and turns."""
    n = len(leaves.centre)
    probability = concrete_array(angles.normalised())
    # Cells are of one degree; within one, inclination is uniform.
    cell = random.choice(ANGLE_CELLS, n, p=probability / probability.sum())
    theta = np.deg2rad(cell + random.uniform(size=n))
    azimuth, turn = random.uniform(0.0, 2.0 * np.pi, (2, n))
    # Unit vectors across the normal: down the slope of the leaf, and level.
    cos, sin = np.cos(azimuth), np.sin(azimuth)
    downward = np.stack([np.cos(theta) * cos, np.cos(theta) * sin, -np.sin(theta)], axis=1)
    level = np.stack([-sin, cos, np.zeros(n)], axis=1)
    cos, sin = np.cos(turn)[:, None], np.sin(turn)[:, None]
    along, across = cos * downward + sin * level, cos * level - sin * downward
    corners = leaf_corners(leaves.centre, along, across, leaves.leaf_area, shape)
    n_corners = corners.shape[1]
    faces = np.arange(n)[:, None, None] * n_corners + leaf_faces(n_corners)
    instance = None if leaves.instance is None else np.repeat(leaves.instance, faces.shape[1])
    mesh = Mesh(corners.reshape(-1, 3), faces.reshape(-1, 3), materials=("leaf",), instance=instance)
    reflectance, transmittance = ({"leaf": a} for a in optics)
    return MeshSurface(mesh, reflectance, transmittance, instances=leaves.instances, crs=crs)
