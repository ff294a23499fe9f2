"""Tiled scenes: a function returns the piece of a large scene that some footprints need."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import final

import numpy as np
from jaxtyping import Float

from jaxlidar._fields.checks import as_numpy, check_kind, check_range
from jaxlidar.scenes.scene import Scene


@final
@dataclasses.dataclass(frozen=True)
class SceneParts:
    """A tiled scene, which may be larger than memory: a function returns the scene within a rectangle.

    `simulate_many` groups shots by square tiles and loads the scene of one tile at a time (several at a time
    if several workers trace): to plan, to trace, and for the truth, where `truth=True`.

    **Arguments:**

    - `part`: a function of (2,) `low` and `high`, x and y in m of the corners of a rectangle, that returns
      the `Scene` there, in the coordinates of the large scene: it covers at least the rectangle, or as much
      of it as the large scene does. All rectangles of a survey have one size, and corners at multiples of a
      tenth of `tile`. The function may read a Zarr array, a memory-mapped file, or a window of a raster. It
      is pickled for the workers of an executor. It must return the same scene for the same rectangle. Meshes
      may extend beyond the rectangle. Parts whose meshes differ in their numbers of triangles, materials or
      instances have compiled programs of their own.
    - `z`: (low, high), m, between which all of the scene lies. With tilted beams, the extent of the
      rectangles depends on it.
    - `tile`: edge of the tiles in m, positive. Default 100.
    - `margin`: distance by which the rectangles extend beyond the footprints, m, 0 or more. Default None: the
      largest distance from which light returns before the record ends, so that no light is lost. With a
      smaller margin, light that scatters farther away is lost; `Waveforms.info` has "margin" and "margin of
      all light".

    **Raises:** TypeError for objects of the wrong type, ValueError for numbers outside their ranges.

    **Example:** a forest of 10 km x 10 km, of which only the tiles with shots are made.

    >>> import jax, numpy as np, jaxlidar as jl
    >>> def part(low, high):
    ...     low, high = np.floor(low), np.ceil(high)
    ...     x, y = (np.arange(a, b) + 0.5 for a, b in zip(low, high))
    ...     tall = 5.0 + 4.0 * np.sin(x / 30.0)[:, None, None] * np.cos(y / 20.0)[None, :, None]
    ...     density = np.where(np.arange(10) + 0.5 < tall, 0.4, 0.0)
    ...     voxels = jl.VoxelMap.from_lad(density, voxel_size=1.0, origin=(*low, 0.0))
    ...     leaf = jl.LeafOptics(0.45, 0.3)
    ...     return jl.Scene(canopy=jl.Canopy(voxels, leaf=leaf), ground=jl.Ground(reflectance=0.3))
    >>> forest = jl.SceneParts(part, z=(0.0, 10.0))
    >>> lidar = jl.Lidar(altitude=1000.0, divergence=2.0)
    >>> survey = jl.Survey.track(lidar, start=(500, 500), end=(9500, 500), spacing=4500.0)
    >>> many = jl.simulate_many(survey, forest, key=jax.random.key(0), rtol=0.1, max_orders=1)
    >>> print(many.reflectance.shape[0], many.info["parts"])
    3 3
    """

    part: Callable[[Float[np.ndarray, "2"], Float[np.ndarray, "2"]], Scene]
    z: Sequence[float]
    tile: float = 100.0
    margin: float | None = None

    def __post_init__(self):
        if not callable(self.part):
            raise TypeError(f"part is a {type(self.part).__name__}; admissible is a function of two corners")
        check_kind("z", self.z, Sequence | np.ndarray, "(low, high), m")
        z = tuple(as_numpy(self.z, "z").tolist())
        if len(z) != 2 or not (np.isfinite(z[0]) and np.isfinite(z[1]) and z[0] <= z[1]):
            raise ValueError(f"z = {self.z}; admissible is (low, high), finite, low not above high")
        object.__setattr__(self, "z", z)
        check_range("tile", self.tile, 0.0, low_open=True)
        if self.margin is not None:
            check_range("margin", self.margin, 0.0)

    def between(self, low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"]) -> Scene:
        """Load the scene within a rectangle.

        **Raises:** TypeError where the function does not return a `Scene`, ValueError where its voxels or
        meshes extend beyond `z`.
        """
        low, high = as_numpy(low, "low"), as_numpy(high, "high")
        call = f"part({low.tolist()}, {high.tolist()})"
        scene = self.part(low, high)
        check_kind(call, scene, Scene, "a Scene")
        for mesh in scene.meshes:
            self._check_heights(call, "meshes", mesh.bounds()[:, 0, 2].min(), mesh.bounds()[:, 1, 2].max())
        if scene.canopy is not None:
            voxels = scene.canopy.voxels
            self._check_heights(call, "voxels", float(voxels.origin[2]), float(voxels.top[2]))
        return scene

    def _check_heights(self, call: str, name: str, bottom: float, top: float) -> None:
        if bottom < self.z[0] - 1e-3 or top > self.z[1] + 1e-3:
            raise ValueError(f"{call} has {name} from {bottom:g} m to {top:g} m; admissible is z = {self.z}")
