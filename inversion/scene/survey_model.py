r"""Forward model of a fit of many records: waveforms of all shots, and products with their Jacobian.

The simulated record of shot i is

    m_i(x) = s_i w_i(x) + o_i,

with the waveform w_i of a scene of unknowns x, and the gain s_i and offset o_i of the shot's group. With
hundreds of shots and a hundred thousand unknowns the Jacobian J of all m_i is never formed. A fit needs its
products with vectors:

- J^T c, by reverse mode: with respect to extinction by replay of the paths
  (`jaxlidar.trace.derivatives.replay`), at the cost of three waveforms however many voxels there
  are. With c = (m - y) / sigma^2 it is the gradient of half of chi-squared.
- J^T J v, the Gauss-Newton product, by forward mode and reverse mode in turn.

**Chunks.** Shots are sorted by place and cut into chunks of one size; a compiled program traces the shots of
a chunk one after the other, and chunks run side by side on all cores. The cotangents of each shot are summed
over a complete voxel map: for narrow beams this would take most of the time. At first order
over a map with open sides, a chunk gets a window of the map, as large as its beams need.

**Common random numbers.** The rays and photons of a shot follow from its number and the key. So m is a
deterministic function of x, smooth but for small jumps where rays cross surfaces, and a fit can use methods
for such functions. Its own error is not averaged away by iterations: it is small where rays and photons are
many enough.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from inversion.fit.model import check_position
from inversion.fit.planning import corner_cases
from inversion.fit.unknowns import BoundUnknown, Setter, set_values, split_by_name
from jaxlidar import Lidar, Plan, Scene, Survey, VoxelMap, make_setup
from jaxlidar.extend import Program, side_by_side
from jaxlidar.spectral.apply_optics import make_waveform_model, total_samples
from jaxlidar.survey.per_shot import ShotGeometry, SurveyContext, shot_geometry
from jaxlidar.trace.device_scene import build_device_scene
from jaxlidar.trace.response import trace_device_scene

Values = tuple[Array, ...]
# Shots of a chunk, of first order alone and of more.
_CHUNK_FIRST_ORDER, _CHUNK_HIGHER_ORDERS = 128, 16
# Radii of a Gaussian beam within which its rays lie: those of lattices of up to 1e7 rays.
_BEAM_RADII = 2.9


class SurveyInputs(eqx.Module):
    """Inputs of a simulation of shots, except the values of the unknowns.

    - `lidar`: that of the survey's middle. - `window_shape`: voxels of a window along x and y; None: no
      windows.
    """

    lidar: Lidar
    scene: Scene
    key: PRNGKeyArray
    plan: Plan
    setters: tuple[Setter, ...] = eqx.field(static=True)
    window_shape: tuple[int, int] | None = eqx.field(static=True)


class ShotChunk(NamedTuple):
    """Shots that one program traces; axis 0 is theirs.

    - `geometry`: their places and directions. - `observed`, `weight`: (shots, wavelengths, samples) records,
      and one over their standard deviation; 0 for what is not fitted. - `window`: first voxel of the chunk's
      window along x and y.
    """

    geometry: ShotGeometry
    observed: Float[Array, "shots wavelengths samples"]
    weight: Float[Array, "shots wavelengths samples"]
    window: Int[Array, "2"]


def _waveforms(
    inputs: SurveyInputs, values: Values, shots: ShotChunk
) -> Float[Array, "shots wavelengths samples"]:
    """Simulate the shots of a chunk, one after the other."""
    scene = set_values(inputs.scene, inputs.setters, values)
    # After the values are set: derivatives then go through the slice, and cotangents outside of it are zero.
    if inputs.window_shape is not None:
        scene = _windowed(scene, shots.window, inputs.window_shape)
    setup = make_setup(inputs.lidar, scene, inputs.plan)
    # What does not depend on the shot is computed once for the chunk, outside of the loop over its shots.
    device_scene = build_device_scene(setup, derivatives="all")
    context = SurveyContext(device_scene, make_waveform_model(setup), scene.atmosphere)

    def waveform(shot: ShotGeometry) -> Float[Array, "wavelengths samples"]:
        aimed = context.aim(shot, inputs.key)
        return total_samples(trace_device_scene(aimed.scene, aimed.key), aimed.model)

    # One after the other: a loop keeps the temporaries of one shot, where vmap would keep those of all.
    return lax.map(waveform, shots.geometry)


def _windowed(scene: Scene, window: Int[Array, "2"], shape: tuple[int, int]) -> Scene:
    """Return the scene with a part of its voxel map: what no beam of the chunk meets is left out."""
    assert scene.canopy is not None
    voxels = scene.canopy.voxels
    nz, corner = voxels.shape[2], jnp.append(window, 0)

    def cut(a: Array | None) -> Array | None:
        return None if a is None else lax.dynamic_slice(a, corner, (*shape, nz))

    # The window stays where it lies in the scene, so that shots keep their coordinates.
    origin = jnp.asarray(voxels.origin) + voxels.voxel_size * corner
    return eqx.tree_at(
        lambda s: (s.canopy.voxels.leaf, s.canopy.voxels.bark, s.canopy.voxels.origin),
        scene,
        (cut(voxels.leaf), cut(voxels.bark), origin),
        is_leaf=lambda x: x is None,
    )


def _pull_back(
    inputs: SurveyInputs,
    values: Values,
    shots: ShotChunk,
    gain: Float[Array, " shots"],
    offset: Float[Array, " shots"],
    cotangent: Float[Array, "shots wavelengths samples"],
    is_gradient: Float[Array, ""],
) -> tuple[Array, Array, Values]:
    """Return waveforms w, the cotangents c of the records, and J^T c for the unknowns of the scene.

    c is `cotangent`, or that of half of chi-squared where `is_gradient` is 1: one program serves both.
    """
    waveforms, pull = jax.vjp(lambda values: _waveforms(inputs, values, shots), values)
    per_shot = (..., None, None)
    residual = (gain[per_shot] * waveforms + offset[per_shot] - shots.observed) * shots.weight
    # Chosen by a value and not by a Python condition: a second program would compile as long as the first.
    c = jnp.where(is_gradient > 0, residual * shots.weight, cotangent)
    # The gain is not an argument of `pull`: its own product with c is summed by group, on the host.
    return waveforms, c, pull(gain[per_shot] * c)[0]


def _gauss_newton_product(
    inputs: SurveyInputs,
    values: Values,
    shots: ShotChunk,
    gain: Float[Array, " shots"],
    tangents: Values,
    gain_tangent: Float[Array, " shots"],
    offset_tangent: Float[Array, " shots"],
) -> tuple[Array, Array, Values]:
    """Return waveforms w, c = J v over sigma^2, and J^T c for the unknowns of the scene."""

    def simulate(values: Values) -> Array:
        return _waveforms(inputs, values, shots)

    # Two traces of one key: both see the same paths, so that J^T J is symmetric.
    pushed = jax.jvp(simulate, (values,), (tangents,))[1]
    waveforms, pull = jax.vjp(simulate, values)
    per_shot = (..., None, None)
    # Product rule of s w + o.
    change = gain[per_shot] * pushed + gain_tangent[per_shot] * waveforms + offset_tangent[per_shot]
    c = change * shots.weight**2
    return waveforms, c, pull(gain[per_shot] * c)[0]


# Threads run chunks side by side; a program that took all cores would wait for the others.
_compiled_pull_back = Program(_pull_back, one_core=True)
_compiled_product = Program(_gauss_newton_product, one_core=True)


class ShotGroups(NamedTuple):
    """Gains and offsets of groups of shots.

    - `group`: (shots,) number of each shot's group. - `gain`, `offset`: the unknowns, or None where gains are
      1 and offsets 0.
    """

    group: Int[np.ndarray, " shots"]
    gain: BoundUnknown | None
    offset: BoundUnknown | None

    @property
    def unknowns(self) -> list[BoundUnknown]:
        """The unknowns, gain first."""
        return [u for u in (self.gain, self.offset) if u is not None]


class Pulled(NamedTuple):
    """A product with J^T, at some values of the unknowns.

    - `waveforms`: (shots, wavelengths, samples) w of the module. - `records`: m. - `gradient`: J^T c.
    """

    waveforms: np.ndarray
    records: np.ndarray
    gradient: Float[np.ndarray, " n"]


class SurveyModel:
    """Simulated records of all shots, and products with their Jacobian.

    **Arguments:**

    - `survey`, `scene`, `plan`, `key`: of the simulation.
    - `unknowns`: of the scene. - `groups`: of shots.
    - `observed`, `weight`: (shots, wavelengths, samples) records, and one over their standard deviation; 0
      for what is not fitted.
    """

    def __init__(
        self,
        survey: Survey,
        scene: Scene,
        plan: Plan,
        unknowns: Sequence[BoundUnknown],
        groups: ShotGroups,
        observed: Float[np.ndarray, "shots wavelengths samples"],
        weight: Float[np.ndarray, "shots wavelengths samples"],
        key: PRNGKeyArray,
    ):
        self.unknowns, self.groups, self.weight = list(unknowns), groups, weight
        self.all_unknowns = [*unknowns, *groups.unknowns]
        self.sizes = [u.start.size for u in self.all_unknowns]
        # Within a program nothing is moved to the origin: coordinates are those of the scene.
        middle = survey.middle
        check_position(middle)
        # Eight chunks at least, where there are shots enough: they keep all cores busy until the end.
        largest = _CHUNK_HIGHER_ORDERS if plan.orders > 1 else _CHUNK_FIRST_ORDER
        n_chunks = -(-len(survey) // min(largest, max(1, len(survey) // 8)))
        self.chunks = _chunks_of_neighbours(survey, n_chunks)
        scenes = [case_scene for _, case_scene in corner_cases(middle, scene, self.unknowns)]
        windows, window_shape = _windows(survey, scenes, plan, self.chunks)
        setters = tuple(u.setter for u in unknowns)
        self.inputs = SurveyInputs(middle, scene, key, plan, setters, window_shape)
        # A chunk that is not full has copies of its last shot, with weights of zero.
        size = max(len(chunk) for chunk in self.chunks)
        self.rows = [np.concatenate([c, np.repeat(c[-1:], size - len(c))]) for c in self.chunks]
        self.shots = []
        for chunk, rows, window in zip(self.chunks, self.rows, windows):
            # Random numbers follow from a shot's number in the survey, not from that in its chunk.
            geometry = shot_geometry(survey.subset(rows), 0, size)._replace(number=rows.astype(np.int32))
            is_copy = (np.arange(size) >= len(chunk))[:, None, None]
            self.shots.append(
                ShotChunk(
                    jax.tree.map(jnp.asarray, geometry.in_precision()),
                    jnp.asarray(observed[rows], float),
                    jnp.asarray(np.where(is_copy, 0.0, weight[rows]), float),
                    jnp.asarray(window, jnp.int32),
                )
            )
        # All chunks have this shape. It is an argument also where the program does not look at it.
        self.zero_cotangent = jnp.zeros_like(self.shots[0].observed)

    def split(self, flat: Float[np.ndarray, " n"]) -> tuple[Values, np.ndarray, np.ndarray]:
        """Return values of the scene's unknowns, gains and offsets of all shots, from one vector."""
        by_name, group = split_by_name(flat, self.all_unknowns), self.groups.group
        values = tuple(jnp.asarray(by_name[u.name], u.start.dtype) for u in self.unknowns)
        gain = np.ones(len(group)) if self.groups.gain is None else by_name["gain"][group]
        offset = np.zeros(len(group)) if self.groups.offset is None else by_name["offset"][group]
        return values, gain, offset

    def scene_at(self, flat: Float[np.ndarray, " n"]) -> Scene:
        """Return the scene with these values."""
        return set_values(self.inputs.scene, self.inputs.setters, self.split(flat)[0])

    def gradient(self, flat: Float[np.ndarray, " n"]) -> Pulled:
        """Return the records, and the gradient of half of chi-squared."""
        return self._pull(flat, None)

    def pull_back(
        self, flat: Float[np.ndarray, " n"], cotangent: Float[np.ndarray, "shots wavelengths samples"]
    ) -> Float[np.ndarray, " n"]:
        """Return J^T c."""
        return self._pull(flat, cotangent).gradient

    def _pull(self, flat: np.ndarray, cotangent: np.ndarray | None) -> Pulled:
        values, gain, offset = self.split(flat)
        is_gradient = jnp.asarray(float(cotangent is None))

        def pull(number: int) -> Any:
            rows = self.rows[number]
            c = self.zero_cotangent
            if cotangent is not None:
                # Copies that fill up a chunk count nothing.
                is_copy = np.arange(len(rows)) >= len(self.chunks[number])
                c = jnp.asarray(np.where(is_copy[:, None, None], 0.0, cotangent[rows]), c.dtype)
            at_shots = (jnp.asarray(gain[rows], float), jnp.asarray(offset[rows], float))
            return _compiled_pull_back(self.inputs, values, self.shots[number], *at_shots, c, is_gradient)

        waveforms, gradient = self._sum_chunks(pull)
        records = gain[:, None, None] * waveforms + offset[:, None, None]
        return Pulled(waveforms, records, gradient)

    def gauss_newton_product(
        self, flat: Float[np.ndarray, " n"], v: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        """Return J^T J v, of records over their standard deviations."""
        values, gain, _ = self.split(flat)
        tangents, gain_tangent, offset_tangent = self.split(v)
        if self.groups.gain is None:
            # Fixed gains have the value 1, which as a tangent would be a change.
            gain_tangent = np.zeros_like(gain)

        def product(number: int) -> Any:
            rows = self.rows[number]
            g, dg, do = (jnp.asarray(a[rows], float) for a in (gain, gain_tangent, offset_tangent))
            return _compiled_product(self.inputs, values, self.shots[number], g, tangents, dg, do)

        return self._sum_chunks(product)[1]

    def _sum_chunks(self, run: Any) -> tuple[np.ndarray, np.ndarray]:
        """Run a program over all chunks; return waveforms of all shots, and the sum of products with J^T."""
        shots, groups = len(self.groups.group), self.groups
        # Sums over thousands of shots are in double precision, whatever that of the programs.
        waveforms = np.zeros((shots, *self.zero_cotangent.shape[1:]))
        totals = [np.zeros(u.start.shape) for u in self.all_unknowns]
        with side_by_side() as run_on_threads:
            for number, (w, c, pulled) in enumerate(run_on_threads(run, range(len(self.rows)))):
                rows, n = self.chunks[number], len(self.chunks[number])
                # Without the copies that fill up the chunk.
                w, c = np.asarray(w, float)[:n], np.asarray(c, float)[:n]
                waveforms[rows] = w
                for total, cotangent in zip(totals, pulled):
                    total += np.asarray(cotangent, float)
                of_groups = iter(totals[len(self.unknowns) :])
                # d record / d gain is w, and d record / d offset is one.
                if groups.gain is not None:
                    np.add.at(next(of_groups), groups.group[rows], np.sum(c * w, axis=(1, 2)))
                if groups.offset is not None:
                    np.add.at(next(of_groups), groups.group[rows], np.sum(c, axis=(1, 2)))
        return waveforms, np.concatenate([total.ravel() for total in totals])


def _chunks_of_neighbours(survey: Survey, n_chunks: int) -> list[Int[np.ndarray, " shots"]]:
    """Cut the shots into chunks of about one size, each of shots that are near one another.

    Strips along x have as many shots each; they are cut along y.
    """
    x, y = survey.position[:, 0], survey.position[:, 1]
    extent = np.maximum([np.ptp(x), np.ptp(y)], 1e-9)
    # As many strips as make chunks about square: their windows are smallest then.
    n_strips = int(np.clip(np.round(np.sqrt(n_chunks * extent[0] / extent[1])), 1, n_chunks))
    strips = np.array_split(np.argsort(x, kind="stable"), n_strips)
    chunks = []
    for number, strip in enumerate(strips):
        # The remainder of the division goes to the first strips, one chunk each.
        of_strip = n_chunks // n_strips + (number < n_chunks % n_strips)
        chunks += np.array_split(
            strip[np.argsort(y[strip], kind="stable")], max(1, min(of_strip, len(strip)))
        )
    return [np.sort(chunk) for chunk in chunks if len(chunk)]


def _windows(
    survey: Survey, scenes: Sequence[Scene], plan: Plan, chunks: Sequence[np.ndarray]
) -> tuple[Int[np.ndarray, "chunks 2"], tuple[int, int] | None]:
    """Return the first voxel of each chunk's window, and the shape of windows, along x and y.

    The shape is None where chunks have the complete map: where light of higher orders goes anywhere, and
    where windows save little.

    `scenes`: with the unknowns at their start and at their bounds, which may move the map.
    """
    none = np.zeros((len(chunks), 2), int), None
    canopy = scenes[0].canopy
    if canopy is None or plan.orders > 1 or survey.has_sensor_position or canopy.sides != "open":
        return none
    shape = np.array(canopy.voxels.shape[:2])
    ranges = [_voxels_of_beams(survey, scene.canopy.voxels) for scene in scenes if scene.canopy is not None]
    low, high = np.min([low for low, _ in ranges], axis=0), np.max([high for _, high in ranges], axis=0)
    # One shape for all windows, that of the largest: chunks share a compiled program.
    first = np.array([low[chunk].min(axis=0) for chunk in chunks])
    last = np.array([high[chunk].max(axis=0) for chunk in chunks])
    first, last = np.clip(first, 0, shape - 1), np.clip(last, 1, shape)
    window_shape = np.minimum(np.max(last - first, axis=0), shape)
    # Cutting costs a copy of the window in each product.
    if np.prod(window_shape) > 0.5 * np.prod(shape):
        return none
    # A window at the rim is moved inward, so that it has its full size.
    return np.clip(first, 0, shape - window_shape), (int(window_shape[0]), int(window_shape[1]))


def _voxels_of_beams(
    survey: Survey, voxels: VoxelMap
) -> tuple[Int[np.ndarray, "shots 2"], Int[np.ndarray, "shots 2"]]:
    """Return the first voxel that each beam may meet along x and y, and the first one after the last."""
    origin, size = np.asarray(voxels.origin, float), np.asarray(voxels.voxel_size, float)
    heights = np.array([origin[2], origin[2] + size[2] * voxels.shape[2]])
    # Beam axes at the bottom and at the top of the map, and the radius of beams there.
    direction = survey.direction
    slope = direction[:, :2] / direction[:, 2:]
    axes = survey.position[:, None] + heights[:, None] * slope[:, None]
    widening = 1.0 + np.max(np.abs(heights)) / survey.slant_range
    # Off nadir a footprint is longer by 1 / cos of the zenith.
    radius = _BEAM_RADII * survey.footprint_radius * widening / np.abs(direction[:, 2])
    # Another voxel on either side: rounding may put a ray on a face.
    low = np.floor((axes.min(axis=1) - radius[:, None] - origin[:2]) / size[:2]).astype(int) - 1
    high = np.floor((axes.max(axis=1) + radius[:, None] - origin[:2]) / size[:2]).astype(int) + 2
    return low, high
