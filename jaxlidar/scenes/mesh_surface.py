"""Surfaces of triangles: meshes that stop light, and their instances.

A mesh has materials by group of faces. Each is one surface of a scene, with a channel of its own; their
triangles lie in one tree, so that a ray is followed through all of them at once.

An instance places a copy of the mesh: a vertex v goes to s R v + d, with the scale s, the rotation R and the
shift d. The rotation is given as a vector (Rodrigues): its direction is the axis, its length the angle.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxlidar._fields.checks import (
    as_array,
    as_numpy,
    as_scalar,
    check_flag,
    check_kind,
    check_numbers,
    check_range,
    check_shape,
    concrete,
    concrete_array,
    fixed_array,
    has_tracers,
    kind_of,
)
from jaxlidar._fields.crs import crs_name
from jaxlidar._fields.ranges import DEGREES, FINITE, POSITIVE, SUM_OF_FRACTIONS, check_ranges, quantity
from jaxlidar._jax.products import einsum, matmul
from jaxlidar._vectors import FAR, Scalar, Vec, along, dot, vec
from jaxlidar.optics.laws import AbstractLaw, AbstractMirror, Lambertian
from jaxlidar.optics.spectra import Spectrum
from jaxlidar.scenes.shapes import AbstractShape
from jaxlidar.scenes.surfaces import AbstractSheet, Reflectance, as_reflectance, check_reflectance, check_sum
from jaxlidar.scenes.triangle_tree import (
    ROW,
    TriangleTree,
    instance_order,
    nearest_triangle,
    tree_order,
    tree_rows,
    triangle_plane,
    triangle_rows,
)

# Rows of the table, twice as many as triangles, are numbered by integers of 32 bits.
MAX_TRIANGLES = 1 << 28
# Largest number of an instance: integers up to it are floats of single precision, as in extra bytes of LAS.
_MAX_INSTANCE = 1 << 24
# Slack of the boxes of instances, in units of the floating-point precision and of their coordinates: rays are
# transformed to coordinates of the mesh with rounding.
_INSTANCE_ROUNDING = 16.0
# Largest rounding of a corner, in units of the longest edge of its triangle, and m that it may have anyway.
_EDGE_ROUNDING, _LEAST_ROUNDING = 0.01, 1e-4
# A mesh this far from its origin, m, and in units of its own size, lies there in coordinates of a map.
_FAR_FROM_ORIGIN, _FAR_IN_SIZES = 1e3, 10.0
# Rounding of a point on a triangle, in units of the floating-point precision and of its coordinates.
_POSITION_ROUNDING = 8.0
# Periods by which copies of an instance that crosses sides of a cell lie away from it.
_COPIES = ((0, 0), (1, 0), (0, 1), (1, 1))
# Squared angle, rad2, below which the coefficients of a rotation are their series.
_SMALL_ANGLE = 1e-4


def _coordinates(field: str, x: Any, columns: int) -> Array | np.ndarray:
    """Convert rows of numbers: a NumPy array of float64 unless they are traced."""
    check_numbers(field, x)
    value = concrete(x)
    rows = as_array(x, field) if value is None else value
    if rows.ndim != 2 or rows.shape[1] != columns or not len(rows):
        raise ValueError(f"{field} has shape {rows.shape}; admissible is (n, {columns}), n at least 1")
    return rows


def instance_numbers(x: Any, count: int) -> Int[np.ndarray, " n"] | None:
    """Convert the numbers of copies, or those of triangles; None stays None."""
    if x is None:
        return None
    numbers = np.asarray(x)
    if numbers.dtype.kind not in "iu":
        raise TypeError(f"instance is an array of {numbers.dtype}; admissible are integers")
    check_shape("instance", numbers, (count,))
    check_range("instance", numbers, 0, _MAX_INSTANCE)
    return numbers.astype(np.int32)


@final
class MeshInstances(eqx.Module):
    """Places of copies of a mesh: each is scaled and rotated about the mesh's own origin, then shifted.

    The origin is the point (0, 0, 0) of the mesh's coordinates. A `MeshSurface` refuses to rotate or scale a
    mesh in coordinates of a map about their distant origin.

    **Arguments:**

    - `shift`: (n, 3) displacement of each copy, m. It is kept in double precision.
    - `rotation`: (n,) angles about the vertical, degrees, clockwise as seen from above; or (n, 3) rotation
      vectors: the direction is the axis, the length the angle in degrees, anticlockwise as seen against the
      axis. Default None: not rotated.
    - `scale`: (n,) factors of all lengths, positive. Default None: 1.
    - `instance`: (n,) number of each copy, such as that of its tree, by which `DiscreteReturns.labelled`
      labels what hits it: integers, 0 or more. Default None: those of the triangles, or none stated.

    **Raises:** ValueError for arrays of other shapes, a scale that is not positive, a negative number of a
    copy, and values that are not finite; TypeError for numbers of copies that are no integers.

    **Example:** two copies, the second turned by a quarter and twice as large.

    >>> import jaxlidar as jl
    >>> instances = jl.MeshInstances(shift=[[0, 0, 0], [10, 0, 0]], rotation=[0, 90], scale=[1, 2])
    >>> instances.matrices().round(3)[1].tolist()
    [[0.0, 2.0, 0.0], [-2.0, 0.0, 0.0], [0.0, 0.0, 2.0]]
    """

    shift: Float[Array | np.ndarray, "n 3"] = quantity(unit="m")
    rotation: Float[Array, "n 3"] = quantity(unit=DEGREES)
    scale: Float[Array, " n"] = quantity(range=POSITIVE)
    instance: Int[np.ndarray, " n"] | None

    def __init__(
        self,
        shift: ArrayLike | Sequence,
        rotation: ArrayLike | Sequence | None = None,
        scale: Any = None,
        instance: Int[ArrayLike, " n"] | Sequence | None = None,
    ):
        self.shift = _coordinates("shift", shift, 3)
        count = len(self.shift)
        rotation = as_array(np.zeros((count, 3)) if rotation is None else rotation, "rotation")
        check_shape("rotation", rotation, (count,), (count, 3))
        if rotation.ndim == 1:
            # Clockwise from above is anticlockwise about the axis that points down.
            rotation = jnp.stack([jnp.zeros_like(rotation), jnp.zeros_like(rotation), -rotation], axis=1)
        self.rotation = rotation
        self.scale = as_array(np.ones(count) if scale is None else scale, "scale")
        check_shape("scale", self.scale, (count,))
        self.instance = instance_numbers(instance, count)

    def __check_init__(self):
        check_ranges(self)

    def __len__(self) -> int:
        return len(self.shift)

    def matrices(self) -> Float[Array, "n 3 3"]:
        """Return the products s R of scale and rotation."""
        return _matrices(self.rotation, self.scale, jnp)


def _matrices(rotation: Any, scale: Any, xp: Any) -> Any:
    """Return s R by the formula of Rodrigues, 1 + a K + b K^2 with K the cross product with the vector.

    With the angle t, a = sin(t) / t and b = (1 - cos(t)) / t^2, which have derivatives at t = 0.
    """
    v = xp.deg2rad(rotation)
    square = xp.sum(v * v, axis=1)
    is_small = square < _SMALL_ANGLE
    angle = xp.sqrt(xp.where(is_small, 1.0, square))
    a = xp.where(is_small, 1.0 - square / 6.0, xp.sin(angle) / angle)
    b = xp.where(is_small, 0.5 - square / 24.0, (1.0 - xp.cos(angle)) / (angle * angle))
    x, y, z = (v[:, k] for k in range(3))
    zero = xp.zeros_like(x)
    k = xp.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    turned = xp.eye(3, dtype=v.dtype)[None] + a[:, None, None] * k + b[:, None, None] * (k @ k)
    return scale[:, None, None] * turned


@final
class MeshSurface(eqx.Module):
    """A surface of triangles that stops light: roofs, trunks, wires, leaves, whole trees.

    Light is reflected by `law` on the side that it meets, and transmitted by the cosine law to the other.
    Light of all orders meets the triangles exactly, in their exact order with voxels, plates and ground.

    Derivatives with respect to optics, vertices, shifts, rotations and scales are exact where the return is
    smooth in them. They leave out that light comes to meet outlines and edges of the mesh or to miss them; an
    `OutlineWarning` says so.

    **Arguments:**

    - `mesh`: a `Mesh`, a `trimesh.Trimesh`, another object with `vertices` (m, 3) and `faces` (n, 3), or a
      tuple of these two arrays: positions in m, and indices of the corners of each triangle, which are
      anticlockwise as seen from the front side. A `Mesh` has materials by group of faces. Where a trimesh
      declares its `units`, its positions are converted to m.
    - `reflectance`: one number, one per wavelength, or a `Spectrum`, in [0, 1], for all triangles; or a dict
      of such, by name of material. Default 0.3.
    - `transmittance`: the same. The sum of reflectance and transmittance is at most 1. Default 0: opaque.
    - `law`: the scattering law: `Lambertian()` or another `AbstractLaw`, but no mirror. Default
      `Lambertian()`.
    - `two_sided`: False if light meets triangles from their front side only, and passes them from behind.
      Default True.
    - `instances`: `MeshInstances`, which place copies of the mesh. Default None: the mesh as it is.
    - `crs`: coordinate reference system in which the mesh, or its copies, are placed, as that of `Terrain`.
      Default None: not known.

    Its name in `Waveform.components` is "mesh", or "mesh:NAME" of each material where optics are a dict.
    Arrays of indices are part of a scene: differentiate with `equinox.filter_grad`, or by a number from which
    you make the scene.

    **Raises:** ValueError for arrays of other shapes, no triangle with an area, more than 2^28 triangles,
    positions that are not finite, triangles so small and so far from the middle of their mesh that their
    corners are rounded by more than 1 % of their edges and 0.1 mm, indices of vertices that do not exist,
    instances that rotate or scale a mesh about a distant origin, optics outside [0, 1], names that the mesh
    does not have, unknown units, and a mirror; TypeError for objects of another kind and for vertices that
    JAX is tracing: make the surface outside, and replace its `vertices` by `equinox.tree_at`.

    **Example:** a roof over ground.

    >>> import jax, jaxlidar as jl
    >>> corners = [[-5, -5, 6], [5, -5, 6], [5, 5, 6], [-5, 5, 6]]
    >>> roof = jl.MeshSurface((corners, [[0, 1, 2], [0, 2, 3]]), reflectance=0.4)
    >>> scene = jl.Scene(meshes=(roof,), ground=jl.Ground(reflectance=0.3))
    >>> wave = jl.simulate(jl.Lidar(divergence=1.0), scene, key=jax.random.key(0), max_orders=1)
    >>> print({name: round(float(wave.components[name].sum()), 3) for name in ("mesh", "ground")})
    {'mesh': 0.4, 'ground': 0.0}
    """

    vertices: Float[Array, "m 3"]
    faces: Int[np.ndarray, "leaves 3"]
    group: Int[np.ndarray, " leaves"]
    instance: Int[np.ndarray, " leaves"] | None
    origin: Float[np.ndarray, "3"]
    reflectance: Any | Mapping[str, Any]
    transmittance: Any | Mapping[str, Any]
    law: AbstractLaw
    instances: MeshInstances
    materials: tuple[str, ...] = eqx.field(static=True)
    two_sided: bool = eqx.field(static=True)
    n_triangles: int = eqx.field(static=True)
    crs: str | None = eqx.field(static=True)
    # That of a scene with periodic sides, where what repeats is left out of a simulation; else None.
    period: Float[Array, "2"] | None

    ranges: ClassVar = {"vertices": FINITE, "optics": SUM_OF_FRACTIONS}

    def __init__(
        self,
        mesh: Any,
        reflectance: float | Sequence[float] | ArrayLike | Spectrum | Mapping[str, Any] = 0.3,
        transmittance: float | Sequence[float] | ArrayLike | Spectrum | Mapping[str, Any] = 0.0,
        law: AbstractLaw = Lambertian(),  # noqa: B008 - laws are immutable
        two_sided: bool = True,
        instances: MeshInstances | None = None,
        crs: str | int | None = None,
    ):
        self.crs = crs_name(crs)
        vertices, faces, group, names, instance = _mesh_arrays(mesh)
        check_kind("law", law, AbstractLaw, "a law of reflection, such as Lambertian()")
        if isinstance(law, AbstractMirror):
            raise ValueError(
                "law is a mirror; admissible on a mesh is another law (a Ground or a Plate may be a mirror)"
            )
        check_flag("two_sided", two_sided)
        check_kind("instances", instances, MeshInstances | None, "MeshInstances or None")
        by_material = isinstance(reflectance, Mapping) or isinstance(transmittance, Mapping)
        self.materials = tuple(names[number] for number in np.unique(group)) if by_material else ()
        self.reflectance = _optics_by_material("reflectance", reflectance, self.materials)
        self.transmittance = _optics_by_material("transmittance", transmittance, self.materials, missing=0.0)
        for name in self.materials or (None,):
            r, t = (a if name is None else a[name] for a in (self.reflectance, self.transmittance))
            of_material = "" if name is None else f"[{name!r}]"
            check_reflectance(f"reflectance{of_material}", r)
            check_reflectance(f"transmittance{of_material}", t)
            check_sum(f"reflectance + transmittance{' of ' + name if name else ''}", r, t)
        self.law, self.two_sided, self.n_triangles = law, bool(two_sided), len(faces)
        # Relative to their middle, coordinates of millions of metres lose nothing in single precision.
        self.origin = np.round(0.5 * (vertices.min(axis=0) + vertices.max(axis=0)))
        self.vertices = as_array(vertices - self.origin)
        order = tree_order(vertices[faces])
        self.faces = faces[order].astype(np.int32)
        numbers = np.searchsorted(np.unique(group), group) if by_material else np.zeros(len(faces), int)
        self.group = numbers[order].astype(np.int32)
        self.instance = None if instance is None else instance[order]
        self.instances = MeshInstances(np.zeros((1, 3))) if instances is None else instances
        known_scale = concrete(self.instances.scale)
        scale = 1.0 if known_scale is None else float(known_scale.max())
        _check_rounding(vertices - self.origin, faces, float(jnp.finfo(self.vertices.dtype).eps), scale)
        _check_origin(vertices, self.instances)
        self.period = None

    @property
    def optics(self) -> Float[Array, " values"]:
        """Reflectances, transmittances and their sums of all materials, but for those of a `Spectrum`."""
        values = [jnp.zeros(1)]
        for surface in self.surfaces:
            r, t = surface.reflectance, surface.transmittance
            numbers = [jnp.ravel(a) for a in (r, t) if not isinstance(a, Spectrum)]
            values += numbers if len(numbers) < 2 else [*numbers, numbers[0] + numbers[1]]
        return jnp.concatenate(values)

    @property
    def surfaces(self) -> tuple["MeshMaterial", ...]:
        """The surfaces of the mesh, one of each material."""
        optics = {"mesh": (self.reflectance, self.transmittance)}
        if self.materials:
            optics = {f"mesh:{n}": (self.reflectance[n], self.transmittance[n]) for n in self.materials}
        return tuple(
            MeshMaterial(reflectance=r, transmittance=t, law=self.law, mesh=self, label=name)  # pyright: ignore[reportArgumentType]
            for name, (r, t) in optics.items()
        )

    def moved(self, by: Float[np.ndarray, "2"]) -> "MeshSurface":
        """Move all instances horizontally by `by`, m, in double precision where they are concrete."""
        arrays = [concrete(a) for a in (self.instances.shift, self.instances.rotation, self.instances.scale)]
        by = np.append(as_numpy(by, "by"), 0.0)
        if any(a is None for a in arrays):
            offset = matmul(self.instances.matrices(), jnp.asarray(self.origin, float))
            shift = jnp.asarray(self.instances.shift, float) + offset + jnp.asarray(by, float)[None]
        else:
            shift = arrays[0] + _matrices(arrays[1], arrays[2], np) @ self.origin + by
        # The origin of the mesh is part of the shift from here on.
        return eqx.tree_at(lambda s: (s.origin, s.instances.shift), self, (np.zeros_like(self.origin), shift))

    def corners(self) -> Float[np.ndarray, "triangles 3 3"]:
        """Return the corners of the triangles of all instances, m, one instance after the other.

        **Raises:** ValueError where JAX is tracing the mesh or its instances.
        """
        faces = np.unique(np.asarray(self.faces), axis=0)
        places = self.instances
        matrices = _matrices(concrete_array(places.rotation), concrete_array(places.scale), np)
        vertices = concrete_array(self.vertices) + np.asarray(self.origin, float)
        placed = np.einsum("nij,vj->nvi", matrices, vertices) + concrete_array(places.shift)[:, None]
        return placed[:, faces].reshape(-1, 3, 3)

    def some_corners(self, count: int) -> Float[np.ndarray, "triangles 3 3"]:
        """Return the corners of some triangles, m, evenly among those of all instances, at most `count`."""
        places, n_all = self.instances, len(self.faces) * len(self.instances)
        instance, face = np.divmod(np.linspace(0, n_all - 1, min(count, n_all)).astype(int), len(self.faces))
        matrices = _matrices(concrete_array(places.rotation), concrete_array(places.scale), np)[instance]
        local = concrete_array(self.vertices)[self.faces[face]] + np.asarray(self.origin, float)
        return np.einsum("tij,tkj->tki", matrices, local) + concrete_array(places.shift)[instance, None]

    def local_corners(self) -> Float[np.ndarray, "triangles 3 3"]:
        """Return the corners of the triangles in coordinates of the mesh, m, before copies are placed."""
        return (concrete_array(self.vertices) + np.asarray(self.origin, float))[np.unique(self.faces, axis=0)]

    def to_local(self, point: Float[np.ndarray, "3"], instance: int) -> tuple[Float[np.ndarray, "3"], float]:
        """Return a point in coordinates of the mesh, as an instance sees it, and the scale of that."""
        places = self.instances
        rotation, scale = (
            concrete_array(a)[instance : instance + 1] for a in (places.rotation, places.scale)
        )
        matrix = _matrices(rotation, scale, np)[0]
        local = np.linalg.solve(matrix, point - concrete_array(places.shift)[instance])
        return local, float(scale[0])

    def gap_to_plane(self, normal: Float[np.ndarray, "3"], foot: Float[np.ndarray, "3"]) -> float:
        """Return the distance, m, of the triangle that is nearest to a plane with all of its corners."""
        corners, boxes, nearest = self.local_corners(), self.bounds(), np.inf
        for instance, (low, high) in enumerate(boxes):
            reach = 0.5 * (high - low) @ np.abs(normal) + 1.0
            if abs((0.5 * (low + high) - foot) @ normal) > reach:
                continue
            # The plane in coordinates of the mesh, so that no copy of the corners is made.
            origin, scale = self.to_local(foot, instance)
            direction = self.to_local(foot + normal, instance)[0] - origin
            distance = np.abs((corners - origin) @ (direction * scale)) * scale
            nearest = min(nearest, float(distance.max(axis=1).min()))
        return nearest

    def bounds(self, xp: Any = np) -> Any:
        """Return the lowest and the highest corner, m, of a box around each instance, (instances, 2, 3).

        `xp`: numpy or jax.numpy, with whose functions to compute. Default numpy.

        **Raises:** ValueError where JAX is tracing the mesh or its instances, and `xp` is numpy.
        """
        vertices = fixed_array(self.vertices, xp)
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        places = self.instances
        matrices = _matrices(fixed_array(places.rotation, xp), fixed_array(places.scale, xp), xp)
        # Products and sums in place of `@`, which some devices evaluate in half precision.
        middle = (matrices * (0.5 * (low + high) + xp.asarray(self.origin, float))).sum(axis=2)
        middle = middle + fixed_array(places.shift, xp)
        half = (xp.abs(matrices) * (0.5 * (high - low))).sum(axis=2)
        return xp.stack([middle - half, middle + half], axis=1)


def _mesh_arrays(
    mesh: Any,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[str, ...], np.ndarray | None]:
    """Return vertices, faces, the group of each face, names of groups, and instances, of any kind of mesh."""
    group, names, instance = None, ("mesh",), None
    if isinstance(mesh, tuple | list) and len(mesh) == 2:
        vertices, faces = mesh
    elif not isinstance(mesh, tuple | list) and hasattr(mesh, "vertices") and hasattr(mesh, "faces"):
        if getattr(mesh, "units", None) is not None and hasattr(mesh, "convert_units"):
            # A `trimesh.Trimesh`.
            mesh = mesh.copy()
            mesh.convert_units("meters")
        vertices, faces = mesh.vertices, mesh.faces
        if hasattr(mesh, "materials") and hasattr(mesh, "material"):
            # A `Mesh`, whose package stands above this one.
            group, names, instance = mesh.material, tuple(mesh.materials), mesh.instance
    else:
        raise TypeError(
            f"mesh is {kind_of(mesh)}; admissible is a Mesh, a trimesh.Trimesh, or a tuple (vertices, faces)"
        )
    if has_tracers((vertices, faces)):
        raise TypeError(
            "mesh is being traced by a JAX transformation; make the MeshSurface outside, and replace its "
            "vertices within by equinox.tree_at"
        )
    vertices = as_numpy(vertices, "vertices")
    faces = np.asarray(faces)
    if faces.dtype.kind not in "iu":
        raise TypeError(f"faces is an array of {faces.dtype}; admissible are integers")
    check_shape("vertices", vertices, (len(vertices), 3))
    check_shape("faces", faces, (len(faces), 3))
    if not 1 <= len(faces) <= MAX_TRIANGLES:
        raise ValueError(f"mesh has {len(faces)} triangles; admissible are 1 to {MAX_TRIANGLES}")
    check_range("vertices", vertices)
    check_range("faces", faces, 0, len(vertices) - 1)
    group = np.zeros(len(faces), int) if group is None else np.asarray(group)
    # Triangles without area, which modelling programs leave in their files, meet no light.
    first, second, third = (vertices[faces[:, k]] for k in range(3))
    has_area = np.any(np.cross(second - first, third - first) != 0.0, axis=1)
    if not has_area.any():
        raise ValueError("mesh has no triangle with an area; admissible is one or more")
    instance = None if instance is None else instance[has_area]
    return vertices, faces[has_area], group[has_area], names, instance


def _check_origin(vertices: Float[np.ndarray, "m 3"], instances: MeshInstances) -> None:
    """Refuse instances that rotate or scale a mesh in coordinates of a map about their distant origin.

    With m the middle of the mesh, rotation and scale displace it by e = s R m - m, and the shift d by d more.
    A user who rotates about another point p has d = p - s R p, which takes most of e back.

    **Raises:** ValueError with the place of the mesh and the displacement.
    """
    rotation, scale, shift = (concrete(a) for a in (instances.rotation, instances.scale, instances.shift))
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    middle, size = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    if np.linalg.norm(middle) < max(_FAR_FROM_ORIGIN, _FAR_IN_SIZES * size):
        return
    if rotation is None or scale is None or shift is None:
        return
    displacement = _matrices(np.asarray(rotation, float), np.asarray(scale, float), np) @ middle - middle
    distance = np.linalg.norm(displacement, axis=1)
    is_wrong = (distance > size) & (np.linalg.norm(displacement + shift, axis=1) > 0.5 * distance)
    if is_wrong.any():
        first = int(np.argmax(is_wrong))
        raise ValueError(
            f"instances: number {first} is rotated or scaled about the origin of the mesh, (0, 0, 0), which "
            f"moves it by {distance[first]:.4g} m from {middle.round(1).tolist()}; subtract a point of the "
            "mesh from its vertices, and add it to `shift`"
        )


def _check_rounding(
    vertices: Float[np.ndarray, "m 3"], faces: Int[np.ndarray, "n 3"], eps: float, scale: float
) -> None:
    """Refuse triangles whose corners are rounded by more than `_EDGE_ROUNDING` of their longest edge.

    Corners are kept in single precision, unless JAX is configured otherwise, from the middle of the mesh.
    Instances multiply their rounding by `scale`, at most.

    **Raises:** ValueError with the triangle, its edge, its distance and the rounding, in units of the mesh.
    """
    distance = np.abs(vertices).max(axis=1)[faces].max(axis=1)
    suspects = np.flatnonzero(0.5 * eps * scale * distance > _LEAST_ROUNDING)
    corners = vertices[faces[suspects]]
    edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    rounding = 0.5 * eps * distance[suspects]
    too_short = np.flatnonzero(rounding > _EDGE_ROUNDING * edge)
    if len(too_short):
        worst = too_short[np.argmin(edge[too_short])]
        raise ValueError(
            f"mesh: {len(too_short)} triangles are rounded, as one with an edge of {edge[worst]:.3g} m "
            f"that is {distance[suspects[worst]]:.6g} m from the middle of the mesh, by "
            f"{rounding[worst]:.2g} m; admissible is {100 * _EDGE_ROUNDING:g} % of the edge: split the mesh "
            "into several MeshSurfaces, each around what it holds"
        )


def _optics_by_material(field: str, value: Any, materials: tuple[str, ...], missing: Any = None) -> Any:
    """Convert a reflectance or transmittance, or a dict of such by name of material."""
    if not isinstance(value, Mapping):
        converted = as_reflectance(value, field)
        return dict.fromkeys(materials, converted) if materials else converted
    for name in value:
        if name not in materials:
            raise ValueError(f"{field}: {name!r} is no material of the mesh; it has {', '.join(materials)}")
    for name in materials:
        if name not in value and missing is None:
            raise ValueError(f"{field} has no {name!r}; admissible is a value for each material of the mesh")
    return {name: as_reflectance(value.get(name, missing), f"{field}[{name!r}]") for name in materials}


@final
class MeshMaterial(AbstractSheet):
    """The triangles of one material of a mesh, as a surface of a scene."""

    reflectance: Reflectance
    transmittance: Reflectance
    law: AbstractLaw
    mesh: MeshSurface
    label: str = eqx.field(static=True)
    transmission: str = eqx.field(static=True, default="diffuse")
    coverage: Float[Array, ""] = eqx.field(converter=as_scalar, default=1.0)

    @property
    def name(self) -> str:
        return self.label

    @property
    def shape(self) -> "TriangleMesh":
        return TriangleMesh((self.mesh,), jnp.zeros(3))


class MeshHit(eqx.Module):
    """The triangles that rays meet first.

    - `distance`: m; FAR where none is met. - `normal`: unit normal of the front side.
    - `material`: number of the material, those of all meshes in order.
    """

    distance: Float[Array, "*s"]
    normal: Vec
    material: Int[Array, "*s"]


class MeshTree(eqx.Module):
    """The tree of the triangles of some meshes (`build_mesh_tree`).

    - `tree`: the tree, relative to `offset`, m. - `material`: that of the triangle in each row of the table;
      None where all have one material. - `longest_side`: of all triangles, m.
    - `copy`: number of the copy in each leaf of the upper tree, those of all meshes in order.
    """

    tree: TriangleTree
    offset: Float[Array, "3"]
    material: Int[Array, "rows"] | None
    longest_side: Float[Array, ""]
    copy: Int[Array, "leaves"]

    def moved(self, by: Float[Array, "3"]) -> "MeshTree":
        """Move all meshes."""
        return dataclasses.replace(self, offset=self.offset + by)

    def meet(self, x: Vec, w: Vec) -> MeshHit:
        """Find the triangles that rays meet first."""
        return self.meet_row(x, w)[0]

    def meet_row(self, x: Vec, w: Vec) -> tuple[MeshHit, Int[Array, "*s"], Int[Array, "*s"]]:
        """Find the triangles that rays meet first, their rows in the table, and the numbers of the copies."""
        x = vec(a - b for a, b in zip(x, self.offset))
        hit = nearest_triangle(self.tree, x, w)
        distance, normal = triangle_plane(self.tree, hit, x, w)
        material = jnp.zeros_like(hit.row) if self.material is None else self.material[hit.row]
        return MeshHit(distance, normal, material), hit.row, self.copy[hit.leaf]

    def is_met(self, x: Vec, w: Vec, active: Any = None, before: Scalar | None = None) -> Array:
        """Return True for rays that meet any triangle; with `before`, within this distance, m."""
        x = vec(a - b for a, b in zip(x, self.offset))
        if before is None:
            return nearest_triangle(self.tree, x, w, active, any_hit=True).distance < FAR
        # Any triangle may be one beyond the distance: the nearest one decides.
        return nearest_triangle(self.tree, x, w, active).distance < before

    def rounding(self, x: Vec) -> Scalar:
        """Return a bound, m, on the rounding of a point `x` on a triangle."""
        # The plane of a triangle is as uncertain as its corners.
        size = self.longest_side
        for position, offset in zip(x, self.offset):
            size = size + jnp.abs(position) + jnp.abs(offset)
        return _POSITION_ROUNDING * float(jnp.finfo(size.dtype).eps) * size


def build_mesh_tree(meshes: Sequence[MeshSurface], period: Float[Array, "2"] | None = None) -> MeshTree:
    """Build the tree of all instances of some meshes: an upper tree over them, and one of each mesh.

    `period`: those of a scene that repeats along x and y, m; None for one that does not.

    1. The lower trees, each with the box of its root.
    2. The boxes of instances. Where the scene repeats: in one cell of it, from 0 to the period, and copies of
       those that cross its sides.
    3. The order of instances along a curve.
    4. The upper tree, before the lower ones in one table.
    """
    lower, boxes, numbers, longest_sides = [], [], [], []
    transforms, shifts = [], []
    n_copies = 1 if period is None else len(_COPIES)
    n_instances = n_copies * sum(len(mesh.instances) for mesh in meshes)
    n_leaves = 1 << (n_instances - 1).bit_length()
    first_row = 2 * n_leaves
    materials, first_material = [jnp.zeros(first_row, jnp.int32)], 0
    for mesh in meshes:
        corners = mesh.vertices[mesh.faces]
        group = jnp.asarray(mesh.group) + first_material
        rows, box = triangle_rows(corners, group)
        longest = jnp.max(jnp.abs(corners - jnp.roll(corners, 1, axis=1)))
        longest_sides.append(longest * jnp.max(mesh.instances.scale))
        matrices = mesh.instances.matrices()
        offset = matmul(matrices, jnp.asarray(mesh.origin, matrices.dtype))
        transforms.append(matrices)
        shifts.append(jnp.asarray(mesh.instances.shift, matrices.dtype) + offset)
        boxes.append(jnp.broadcast_to(box, (len(matrices), 2, 3)))
        numbers += [(first_row, len(mesh.faces), int(not mesh.two_sided))] * len(matrices)
        lower.append(rows)
        materials.append(jnp.concatenate([jnp.zeros(len(rows) - len(group), jnp.int32), group]))
        first_row, first_material = first_row + len(rows), first_material + len(mesh.surfaces)
    matrix, shift, box = (jnp.concatenate(a) for a in (transforms, shifts, boxes))
    middle = einsum("nij,nj->ni", matrix, 0.5 * (box[:, 0] + box[:, 1])) + shift
    half = einsum("nij,nj->ni", jnp.abs(matrix), 0.5 * (box[:, 1] - box[:, 0]))
    is_real = jnp.ones(len(shift), bool)
    if period is not None:
        move, is_real = _copies_in_cell(middle, half, period)
        matrix, half = (jnp.tile(a, (n_copies, *[1] * (a.ndim - 1))) for a in (matrix, half))
        middle, shift = (jnp.tile(a, (n_copies, 1)) + move for a in (middle, shift))
        numbers = numbers * n_copies
    extent = lax.stop_gradient(jnp.max(jnp.abs(middle) + half))
    half = half + _INSTANCE_ROUNDING * float(jnp.finfo(half.dtype).eps) * extent
    n_spare = n_leaves - n_instances

    def fill(a: Array, value: float) -> Array:
        return jnp.concatenate([a, jnp.full((n_spare, *a.shape[1:]), value, a.dtype)])

    # The inverse of s R is its transpose over s^2.
    scale = jnp.tile(jnp.concatenate([mesh.instances.scale for mesh in meshes]), n_copies)
    inverse = jnp.swapaxes(matrix, 1, 2) / (scale * scale)[:, None, None]
    leaf_rows = fill(jnp.concatenate([inverse.reshape(-1, 9), shift], axis=1), 0.0)
    assert leaf_rows.shape[1] == ROW
    order = instance_order(fill(middle, 0.0), fill(is_real, 0))
    low, high = (
        fill(jnp.where(is_real[:, None], middle + sign * half, -sign * FAR), -sign * FAR) for sign in (-1, 1)
    )
    upper, box = tree_rows(leaf_rows[order], low[order], high[order])
    instances = fill(jnp.asarray(numbers, jnp.int32), 0)[order]
    uniform = numbers[0] if len(set(numbers)) == 1 else None
    rows = jnp.concatenate([upper, *lower])
    tree = TriangleTree(rows, instances, box, uniform, period, several_materials=first_material > 1)
    copy = fill(jnp.arange(n_instances, dtype=jnp.int32) % (n_instances // n_copies), 0)[order]
    return MeshTree(
        tree,
        jnp.zeros_like(shift[0]),
        jnp.concatenate(materials) if first_material > 1 else None,
        lax.stop_gradient(jnp.max(jnp.stack(longest_sides))),
        copy,
    )


def _copies_in_cell(
    middle: Float[Array, "n 3"], half: Float[Array, "n 3"], period: Float[Array, "2"]
) -> tuple[Float[Array, "copies 3"], Bool[Array, "copies"]]:
    """Return displacements of copies of instances into the cell from 0 to the period, and which are needed.

    An instance is moved by whole periods until its lowest corner lies in the cell. No instance is wider than
    a period, so that it crosses at most the far sides; it enters by the near ones as a copy.
    """
    low, high = middle[:, :2] - half[:, :2], middle[:, :2] + half[:, :2]
    period = period[None]
    number = lax.stop_gradient(jnp.floor(low / period))
    crosses = high - number * period > period
    moves, is_needed = [], []
    for copy in _COPIES:
        moves.append(jnp.pad(-(number + np.array([copy])) * period, ((0, 0), (0, 1))))
        is_needed.append(jnp.all(crosses | ~np.array([copy], bool), axis=1))
    return jnp.concatenate(moves), jnp.concatenate(is_needed)


@final
class TriangleMesh(AbstractShape):
    """The shape of meshes, for planning; the tracer follows rays through the tree of all meshes of a scene.

    **Arguments:** `meshes`: of which the shape consists. `offset`: (3,) their displacement, m.
    """

    meshes: tuple[MeshSurface, ...]
    offset: Float[Array, "3"]

    @property
    def lights_itself(self) -> bool:
        return True

    def moved(self, by: Float[Array, "3"]) -> "TriangleMesh":
        return TriangleMesh(self.meshes, self.offset + by)

    def distance(self, x: Vec, w: Vec) -> Scalar:
        return build_mesh_tree(self.meshes).moved(self.offset).meet(x, w).distance

    def tangent(self, x: Vec) -> tuple[Vec, Scalar]:
        # The triangle at a point of the surface is the nearest one that lines along the axes meet.
        tree = build_mesh_tree(self.meshes).moved(self.offset)
        step = tree.rounding(x)
        nearest, normal = jnp.full(x[0].shape, FAR), vec(jnp.zeros_like(x[0]) for _ in range(3))
        for axis in np.concatenate([np.eye(3), -np.eye(3)]):
            w = vec(jnp.full_like(x[0], a) for a in axis)
            hit = tree.meet(along(x, w, -step), w)
            is_nearer = hit.distance < nearest
            nearest = jnp.where(is_nearer, hit.distance, nearest)
            normal = vec(jnp.where(is_nearer, a, b) for a, b in zip(hit.normal, normal))
        return normal, dot(normal, x)

    def crossing(
        self, points: Float[np.ndarray | Array, "n 3"], directions: Float[np.ndarray | Array, "n 3"]
    ) -> tuple[Float[np.ndarray | Array, " n"], Float[np.ndarray | Array, " n"]]:
        boxes = np.concatenate([mesh.bounds() for mesh in self.meshes]) + concrete_array(self.offset)
        low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
        ahead = ((0.5 * (low + high) - points) * directions).sum(axis=1)
        reach = (0.5 * (high - low) * np.abs(directions)).sum(axis=1)
        return ahead + np.where(np.arange(len(points)) % 2, reach, -reach), np.full(len(points), -1.0)
