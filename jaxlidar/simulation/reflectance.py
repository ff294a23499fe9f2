r"""Reflectance factors of a scene under sunlight, from the same tracer as waveforms.

The bidirectional reflectance factor is pi L / E, the radiance L towards the sensor over that of a white
Lambertian plane under the irradiance E of the sun on a horizontal plane (Nicodemus et al. 1977;
Schaepman-Strub et al. 2006). The scene stands alone: there is no sky light and no atmosphere.

Light paths are followed backwards, from the sensor to the sun, which changes nothing (reciprocity): photons
enter along parallel rays over the area in view, and each collision deposits the light that goes on to the
sun,

    weight * V(w -> sun) * exp(-tau(x -> sun)),

as it deposits the return of a lidar (`trace.photons.higher_orders`). With the energy 1 spread over the area
A of a horizontal plane, the sum is pi times the radiant intensity I towards the sun. A white plane has I =
cos(theta) / pi, theta the zenith angle of the sun, so that

    reflectance factor = sum / cos(theta).

Deposits are kept by scattering history: one trace serves all wavelengths.

**Hot spot.** Leaves of a voxel map have no size, so that the paths of light to and from a leaf are
independent unless they are one and the same: a canopy with `hotspot=True` returns exp(-tau) of the first
order in the exact direction of the sun, and exp(-tau_in - tau_out) in every other.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from jaxlidar._fields.checks import (
    check_integer,
    check_key,
    check_kind,
    check_numbers,
    check_range,
    check_shape,
    concrete,
    concrete_array,
    concrete_number,
    has_tracers,
    is_traced,
)
from jaxlidar._jax.products import matmul
from jaxlidar._jax.programs import Program
from jaxlidar._jax.threads import side_by_side
from jaxlidar._vectors import Vec, vec
from jaxlidar.planning.path_lengths import PathLengths
from jaxlidar.planning.plan import MIN_BATCHES, Plan
from jaxlidar.planning.plan import plan as make_plan
from jaxlidar.planning.plan_check import check_plan
from jaxlidar.planning.setup import make_setup
from jaxlidar.planning.size_buckets import size_bucket
from jaxlidar.sampling.adaptive import MeanEstimate
from jaxlidar.sampling.moments import RunningMoments
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.terrain import Terrain
from jaxlidar.sensors.lidar import Lidar
from jaxlidar.spectral.apply_optics import setup_optics
from jaxlidar.trace.device_scene import DeviceScene, build_device_scene
from jaxlidar.trace.first.footprint import bistatic_beam
from jaxlidar.trace.photons.histories import Histories
from jaxlidar.trace.response import trace_first, trace_higher

# Light is followed over paths that take light up to this time, ns.
_LONGEST_PATH_TIME = 2000.0
# The sensor is so high, m, that no scene reaches up to it.
_ALTITUDE = 1e6
# Largest zenith angle of sun and sensor, degrees.
_MAX_ZENITH = 85.0
# Relative accuracy for which orders of scattering are chosen.
_RTOL = 1e-3

Angles = Sequence[Any]
# Photons of all batches together.
_DEFAULT_PHOTONS = 131_072


@final
class ReflectanceFactor(eqx.Module):
    """Bidirectional reflectance factors of a scene under sunlight, as `reflectance_factor` returns them.

    Where an array is expected, it stands for its `reflectance`.

    - `reflectance`: (wavelengths,) reflectance factor, 1 of a white Lambertian plane.
    - `stderr`: (wavelengths,) one standard error of it.
    - `unfollowed`: (wavelengths,) fraction of the light that was still within the scene after the last
      order, or after a path of 600 m.

    **Example:**

    >>> import jax, jaxlidar as jl
    >>> import numpy as np
    >>> scene = jl.Scene(ground=jl.Ground(reflectance=0.4))
    >>> factor = jl.reflectance_factor(
    ...     scene, sun=(30.0, 120.0), view=(0.0, 0.0), wavelengths=[660.0, 865.0], key=jax.random.key(0)
    ... )
    >>> print(np.round(factor, 3), factor.stderr.max() < 1e-6)
    [0.4 0.4] True
    """

    reflectance: Float[Array, " wavelengths"]
    stderr: Float[Array, " wavelengths"]
    unfollowed: Float[Array, " wavelengths"]

    def __array__(self, *args: Any, **kwargs: Any) -> np.ndarray:
        return np.array(self.reflectance, *args, **kwargs)

    def __jax_array__(self) -> Array:
        return self.reflectance


def reflectance_factor(
    scene: Scene,
    *,
    sun: Angles,
    view: Angles,
    wavelengths: ArrayLike | Sequence[ArrayLike],
    key: PRNGKeyArray,
    n_photons: int | None = None,
    max_orders: int | None = None,
    area: ArrayLike | Sequence | None = None,
    plan: Plan | None = None,
) -> ReflectanceFactor:
    """Simulate the bidirectional reflectance factor of a scene under sunlight, at the top of the canopy.

    The same scene gives waveforms and reflectance factors, so that both can be fitted together. An
    atmosphere of the scene is not used. One trace serves all wavelengths; derivatives are those of
    `simulate`. Within a JAX transformation of the scene, make the `plan` outside by `plan_reflectance`.

    **Arguments:**

    - `scene`: a `Scene`.
    - `sun`, `view`: (zenith, azimuth) in degrees: directions in which the sun and the sensor stand, the
      zenith angle from the vertical, in [0, 85], the azimuth clockwise from north. Where the two are the
      same, a canopy with `hotspot=True` returns its hot spot.
    - `wavelengths`: nm, one number or several that increase strictly.
    - `key`: a JAX random key.
    - `n_photons`: photons of all eight batches together, at least 8. Default None: 131072.
    - `max_orders`: follow light for this many scatterings. Default None: as many as the albedos call for, to
      0.1 %.
    - `area`: (2, 2) the corners (x, y) of the area in view, m, on the plane z = 0. Default None: the extent
      of the voxel map, or else of the terrain.
    - `plan`: a `Plan` of `plan_reflectance`. Cannot be combined with `n_photons` and `max_orders`. Default
      None: made here.

    **Returns:** a `ReflectanceFactor`, with standard errors.

    **Raises:** ValueError for inadmissible arguments, for surfaces that are mirrors, for a plan that does not
    fit scene and view, and where the geometry is traced by a JAX transformation without a plan. TypeError for
    arguments of another kind.

    **Source:** Nicodemus et al. (1977), NBS Monograph 160; Schaepman-Strub et al. (2006), Remote Sens.
    Environ. 103, 27.

    **Example:** a spectrum of a canopy.

    >>> import jax, jaxlidar as jl
    >>> import numpy as np
    >>> voxels = jl.VoxelMap.from_lad(np.full((1, 1, 4), 0.3), voxel_size=1.0)
    >>> canopy = jl.Canopy(voxels, leaf=jl.Prospect(), sides="periodic")
    >>> scene = jl.Scene(canopy=canopy, ground=jl.Ground(reflectance=0.2))
    >>> angles = {"sun": (40.0, 180.0), "view": (0.0, 0.0)}
    >>> factor = jl.reflectance_factor(
    ...     scene, **angles, wavelengths=[560.0, 660.0, 865.0], key=jax.random.key(0), n_photons=4096
    ... )
    >>> red, infrared = factor.reflectance[1:]
    >>> print(bool(infrared > 3 * red))
    True
    """
    check_kind("scene", scene, Scene, "a Scene")
    check_key(key)
    scene = dataclasses.replace(scene, atmosphere=None)
    sun_angles, view_angles = _checked_angles("sun", sun), _checked_angles("view", view)
    centre, extent = _area_in_view(scene, area)
    lidar = _sensor(view_angles, wavelengths, centre)
    if plan is None:
        count = _DEFAULT_PHOTONS if n_photons is None else n_photons
        plan = _make_plan(lidar, scene, sun_angles, count, max_orders, extent)
    else:
        check_kind("plan", plan, Plan, "a Plan that jaxlidar.plan_reflectance made")
        if max_orders is not None:
            raise ValueError("plan is given together with max_orders; admissible is either")
        if n_photons is not None:
            raise ValueError("plan is given together with n_photons; admissible is either")
        sun_zenith = concrete(sun_angles[0])
        if plan.config.vertical and (sun_zenith is None or float(sun_zenith) != 0):
            raise ValueError("plan is for a sun in the zenith; make one for this sun")
        # What is traced is checked by value (`make_setup`).
        if not has_tracers((lidar, scene, plan)):
            check_plan(plan, lidar, scene)
    if any(plan.config.mirrors):
        raise ValueError("a surface of the scene is a smooth mirror; admissible is any other law")
    setup = make_setup(lidar, scene, plan)
    is_hot_spot = _is_same_direction(sun_angles, view_angles) if plan.config.hotspot else False
    corner, size = _rectangle(setup.scene, area, centre)
    is_transformed = has_tracers((setup, sun_angles, key))
    common = {
        # Built here: a program that took the setup would be compiled for every number of voxels.
        "scene": build_device_scene(setup, derivatives="all" if is_transformed else "none"),
        "optics": setup_optics(setup),
        "lidar": setup.lidar,
        "sun": _unit_vector(sun_angles),
        "corner": corner,
        "size": size,
        "is_hot_spot": is_hot_spot,
    }
    keys = jax.random.split(key, MIN_BATCHES)
    if is_transformed:

        def trace_batch(batch_key: PRNGKeyArray) -> tuple[Array, Array]:
            if isinstance(is_hot_spot, bool):
                return _trace_batch(key=batch_key, **common)
            # Traced angles: only their values tell whether sun and sensor stand in one direction.
            traces = [
                functools.partial(_trace_batch, key=batch_key, **{**common, "is_hot_spot": is_hot})
                for is_hot in (True, False)
            ]
            return jax.lax.cond(is_hot_spot, *traces)

        moments = RunningMoments.of_batches(jax.lax.map(trace_batch, keys))
    else:
        run_batch = _compiled_batch.bind(**common)
        with side_by_side() as run:
            estimate = MeanEstimate(lambda numbers: run(lambda n: run_batch(key=keys[n]), numbers))
            estimate.add_batches(range(MIN_BATCHES))
        moments = estimate.moments
    reflectance, unfollowed = map(jnp.asarray, moments.mean)
    return ReflectanceFactor(
        reflectance=reflectance * setup.nan_unless_covered(),
        # Standard errors have no derivatives: they would be those of the noise.
        stderr=jnp.asarray(moments._replace(squares=jax.lax.stop_gradient(moments.squares)).stderr[0]),
        unfollowed=unfollowed,
    )


def plan_reflectance(
    scene: Scene,
    *,
    sun: Angles,
    view: Angles,
    wavelengths: ArrayLike | Sequence[ArrayLike],
    n_photons: int = _DEFAULT_PHOTONS,
    max_orders: int | None = None,
    area: ArrayLike | Sequence | None = None,
) -> Plan:
    """Make the plan of `reflectance_factor`, for scenes that a JAX transformation traces.

    The plan serves other values of the same scene whose canopy and surfaces reach no higher, and other
    directions no farther from the zenith. Others are refused, as far as they concern the view, and within a
    JAX transformation the reflectance factor is NaN; the sun is not checked.

    **Arguments:** `scene`, `sun`, `view`, `wavelengths`, `n_photons`, `max_orders`, `area`: as for
    `reflectance_factor`.

    **Returns:** a `Plan`.

    **Raises:** ValueError for inadmissible arguments, and where the geometry is traced by a JAX
    transformation.

    **Example:** the derivative of a reflectance factor.

    >>> import jax, jaxlidar as jl
    >>> def scene_of(reflectance):
    ...     return jl.Scene(ground=jl.Ground(reflectance=reflectance))
    >>> options = {"sun": (30.0, 0.0), "view": (10.0, 90.0), "wavelengths": 865.0}
    >>> plan = jl.plan_reflectance(scene_of(0.3), **options)
    >>> def factor(reflectance):
    ...     result = jl.reflectance_factor(scene_of(reflectance), plan=plan, key=jax.random.key(0), **options)
    ...     return result.reflectance[0]
    >>> print(f"{float(jax.grad(factor)(0.3)):.3f}")
    1.000
    """
    check_kind("scene", scene, Scene, "a Scene")
    scene = dataclasses.replace(scene, atmosphere=None)
    sun_angles, view_angles = _checked_angles("sun", sun), _checked_angles("view", view)
    centre, extent = _area_in_view(scene, area)
    return _make_plan(
        _sensor(view_angles, wavelengths, centre), scene, sun_angles, n_photons, max_orders, extent
    )


def _checked_angles(name: str, angles: Any) -> tuple[Any, Any]:
    """Check a pair of zenith angle and azimuth. **Raises:** ValueError, TypeError."""
    try:
        zenith, azimuth = angles
    except (TypeError, ValueError):
        raise ValueError(f"{name} = {angles!r} is not a pair (zenith, azimuth)") from None
    for label, value in ((f"zenith of {name}", zenith), (f"azimuth of {name}", azimuth)):
        if not is_traced(value):
            check_numbers(label, value)
            check_shape(label, value, ())
            check_range(
                label, value, *((0.0, _MAX_ZENITH) if label.startswith("zenith") else (-np.inf, np.inf))
            )
    return zenith, azimuth


def _unit_vector(angles: tuple[Any, Any]) -> Vec:
    """Return the direction in which sun or sensor stand, as seen from the scene."""
    zenith, azimuth = (jnp.deg2rad(jnp.asarray(angle, float)) for angle in angles)
    horizontal = jnp.sin(zenith)
    return vec((horizontal * jnp.sin(azimuth), horizontal * jnp.cos(azimuth), jnp.cos(zenith)))


def _is_same_direction(sun: tuple[Any, Any], view: tuple[Any, Any]) -> Any:
    """Return whether two directions are one: a bool, or a traced truth value where an angle is traced."""
    sun_zenith, sun_azimuth, view_zenith, view_azimuth = (
        angle if (value := concrete(angle)) is None else value.astype(jnp.zeros(()).dtype)
        for angle in (*sun, *view)
    )
    is_same_azimuth = (sun_azimuth - view_azimuth) % 360.0 == 0.0
    is_same = (sun_zenith == view_zenith) & ((sun_zenith == 0.0) | is_same_azimuth)
    return is_same if is_traced(is_same) else bool(is_same)


def _sensor(view: tuple[Any, Any], wavelengths: Any, centre: np.ndarray) -> Lidar:
    """Return a lidar in the place of the sensor."""
    # Light travels from the sensor, against the direction in which that stands.
    return parallel_lidar(wavelengths, view[0], view[1] + 180.0, centre)


def parallel_lidar(wavelengths: Any, zenith: Any, azimuth: Any, centre: Any) -> Lidar:
    """Return a lidar for plans of parallel light: its pulse and sampling collect all light in a few bins."""
    return Lidar(
        wavelength=wavelengths,
        altitude=_ALTITUDE,
        zenith=zenith,
        azimuth=azimuth,
        divergence=0.0,
        position=centre,
        sampling_interval=_LONGEST_PATH_TIME,
    )


def distance_above(lidar: Lidar, scene: Scene, size: np.ndarray) -> float:
    """Return the distance before the reference plane, m, at which parallel light starts above a rectangle."""
    # A footprint whose rim, as plans see it, encloses the rectangle.
    radius, zenith = 0.5 * float(np.linalg.norm(size)), math.radians(concrete_number(lidar.zenith))
    beam = dataclasses.replace(lidar, divergence=1e3 * radius / _ALTITUDE)
    vertical = dataclasses.replace(beam, zenith=0.0)
    # Straight down, the heights of what stands above the rectangle count. Along the beam, an inclined plane
    # rises without end; rims lie across the beam, and the rectangle lies level.
    above = PathLengths(vertical, scene).start_distance / math.cos(zenith)
    return max(above, PathLengths(beam, scene).start_distance + radius * math.tan(zenith))


def _area_in_view(scene: Scene, area: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return centre and size, m, of the area in view, as numbers; zero sizes where geometry is traced."""
    if area is not None:
        corners = concrete_array(area)
        check_shape("area", corners, (2, 2))
        check_range("area", corners)
        if not np.all(corners[1] > corners[0]):
            raise ValueError(
                f"area = {corners.tolist()} is not ((x0, y0), (x1, y1)) with x0 < x1 and y0 < y1"
            )
        return corners.mean(axis=0), corners[1] - corners[0]
    if scene.canopy is not None:
        origin, edge = (concrete(a) for a in (scene.canopy.voxels.origin, scene.canopy.voxels.voxel_size))
        if origin is None or edge is None:
            return np.zeros(2), np.zeros(2)
        extent = np.asarray(edge, float)[:2] * scene.canopy.voxels.shape[:2]
        return np.asarray(origin, float)[:2] + 0.5 * extent, extent
    if isinstance(scene.ground, Terrain):
        low, high = concrete_array(scene.ground.origin), scene.ground.end
        return 0.5 * (low + high), high - low
    return np.zeros(2), np.ones(2)


def _rectangle(scene: Scene, area: Any, centre: np.ndarray) -> tuple[Array, Array]:
    """Return corner and size of the area in view, about the centre; they move with the voxels of a map.

    `scene`: of a setup, which has been moved so that the centre is its origin.
    """
    if area is None and scene.canopy is not None:
        voxels = scene.canopy.voxels
        return jnp.asarray(voxels.origin)[:2], voxels.voxel_size[:2] * jnp.asarray(voxels.shape[:2], float)
    moved_centre, extent = _area_in_view(scene, area)
    if area is not None:
        moved_centre = moved_centre - centre
    return jnp.asarray(moved_centre - 0.5 * extent, float), jnp.asarray(extent, float)


def _make_plan(
    lidar: Lidar,
    scene: Scene,
    sun: tuple[Any, Any],
    n_photons: int,
    max_orders: int | None,
    extent: np.ndarray,
) -> Plan:
    """Plan a reflectance factor.

    1. Plan a lidar in the place of the sensor, whose record takes in all light.
    2. Let rays start above everything within the area in view, not only about its centre.
    3. Have loops long enough for the path to the sun.
    """
    n_photons = check_integer("n_photons", n_photons, MIN_BATCHES)
    half_time = 0.5 * _LONGEST_PATH_TIME
    plan = make_plan(
        lidar,
        scene,
        rtol=_RTOL,
        max_orders=max_orders,
        n_photons=n_photons,
        window=(half_time - 100.0, half_time - 99.0),
        bin_width=0.25 * _LONGEST_PATH_TIME,
        describe=False,
    )
    sun_zenith = concrete(sun[0])
    is_vertical = sun_zenith is not None and float(sun_zenith) == 0.0
    # A sun that is being traced may stand anywhere.
    sun_cosine = np.cos(np.deg2rad(_MAX_ZENITH if sun_zenith is None else float(sun_zenith)))
    limits, max_faces, start = plan.limits, plan.config.max_faces, distance_above(lidar, scene, extent)
    max_flight = limits.max_flight
    if scene.canopy is not None:
        lengths = PathLengths(lidar, scene)
        height, longest = lengths.size[2] * lengths.shape[2], limits.max_path + start
        max_flight = max(max_flight, lengths.longest_flight(longest))
        max_faces = max(max_faces, size_bucket(lengths.voxels_along(height / sun_cosine)))
        max_faces = max(max_faces, size_bucket(lengths.max_faces(longest)))
        if scene.canopy.sides == "periodic":
            # A wide area under a low sensor has rays that start farther above the canopy than flights may be
            # long.
            max_flight += start
            max_faces = max(max_faces, size_bucket(lengths.voxels_along(max_flight)))
    # Light that is not followed is in the result, whatever the albedo.
    plan = dataclasses.replace(plan, scope=dataclasses.replace(plan.scope, albedo=1.0))
    plan = plan.with_limits(start_distance=start, max_flight=max_flight)
    return plan.with_config(vertical=is_vertical, max_faces=max_faces)


def _trace_batch(
    *,
    scene: DeviceScene,
    optics: Float[Array, "channels wavelengths"],
    lidar: Lidar,
    sun: Vec,
    corner: Float[Array, "2"],
    size: Float[Array, "2"],
    is_hot_spot: bool,
    key: PRNGKeyArray,
) -> tuple[Float[Array, " wavelengths"], Float[Array, " wavelengths"]]:
    """Trace one batch.

    **Returns:** the reflectance factor, and the fraction of the light that was not followed to its end.
    """
    scene = dataclasses.replace(scene, beam=bistatic_beam(lidar, None if is_hot_spot else sun, corner, size))
    higher = trace_higher(scene, key)

    def of_wavelengths(weights: Float[Array, "traces *materials histories"], table: Histories) -> Array:
        """Apply optics to weights by trace and history, and sum over materials."""
        by_trace = jnp.sum(weights.reshape(len(weights), -1, weights.shape[-1]), axis=1)
        if scene.optics is not None:
            # Optics have been applied already: traces are wavelengths, with a single history.
            return by_trace[:, 0]
        monomials = table.monomials(optics)
        if scene.straight_transmittance is not None:
            # Traces are wavelengths, as extinction depends on them.
            return jnp.sum(by_trace.T * monomials, axis=0)
        return matmul(by_trace[0], monomials)

    returned = of_wavelengths(jnp.sum(higher.weights, axis=-1) + higher.outside, scene.histories)
    if is_hot_spot:
        # The first order knows its own path back.
        weights, outside = trace_first(scene, key)
        returned += of_wavelengths(jnp.sum(weights, axis=-1) + outside, scene.first_histories)
    unfollowed = of_wavelengths(higher.flown_outside + higher.unfollowed, scene.histories)
    return returned / sun[2], unfollowed


# One core each: batches run side by side on threads.
_compiled_batch = Program(_trace_batch, one_core=True)
