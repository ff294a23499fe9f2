"""Unknowns of a retrieval: bounds, priors and starting values, and the way a value enters the simulation.

**Bounds.** A fit moves in the natural units of the unknowns and keeps within their bounds
(`inversion.fit.solver`).

**Scene and lidar.** `bind_unknowns` locates every `Unknown` in a scene or a lidar and gives a `BoundUnknown`,
whose `Setter` puts a value there. Setters are hashable and equal for equal unknowns, so that programs
compiled for one fit serve the next.
"""

import difflib
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from inversion.fit.priors import LogNormal, MarkovField, Smooth
from jaxlidar import Lidar, Scene
from jaxlidar.extend import as_array, check_kind, check_range

# (mean, standard deviation), or one of the named priors.
Prior = tuple[Float[Array, "..."], Float[Array, "..."]] | LogNormal | Smooth | MarkovField
# Least distance of a starting value from its bounds, over the bounds' width: at a bound, such as a
# reflectance of zero, the waveform may not depend on other unknowns.
MARGIN = 0.01
# Beginning of a path in the lidar.
_OF_LIDAR = "lidar."
# Fields of a lidar whose arrays can be unknown: those that act after the trace, and those that move rays.
# Energy and efficiency do not change the apparent reflectance.
_LATE_FIELDS = ("pulse", "jitter")
_RAY_FIELDS = ("position", "altitude", "zenith", "azimuth", "divergence", "field_of_view")


def _as_bounds(x: Any) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    try:
        low, high = x
    except (TypeError, ValueError):
        raise ValueError(f"bounds = {x!r} is not a pair (low, high)") from None
    return as_array(low, "lower of bounds"), as_array(high, "upper of bounds")


def _as_optional_prior(x: Any) -> Prior | None:
    if x is None or isinstance(x, LogNormal | Smooth | MarkovField):
        return x
    try:
        mean, std = x
    except (TypeError, ValueError):
        raise ValueError(
            f"prior = {x!r} is no LogNormal, no Smooth, no MarkovField and no pair (mean, standard deviation)"
        ) from None
    return as_array(mean, "prior mean"), as_array(std, "prior standard deviation")


def _as_optional_start(x: ArrayLike | None) -> Float[Array, "..."] | None:
    return None if x is None else as_array(x, "start")


@final
class Unknown(eqx.Module):
    """An unknown of a retrieval: an array of the scene or the lidar, or a value that changes several arrays.

    A start on a bound, or closer to it than 1 % of the bounds' width, is moved to that distance.

    **Arguments:**

    - `where`: path of one array in the scene, of any shape, such as "canopy.leaf.Cab" or "plates[0].height",
      or a function that picks the array, as for `equinox.tree_at`. An element of an array, or a property, is
      not such an array: use `apply`. A path that begins with "lidar." is one of the lidar, for the retrieval
      of one record: "lidar.position", "lidar.zenith", "lidar.azimuth", "lidar.altitude", "lidar.divergence",
      "lidar.field_of_view", "lidar.jitter", or an array of the pulse, such as "lidar.pulse.fwhm". Default
      None.
    - `bounds`: (low, high) in the unknown's own unit, finite, low below high, numbers or arrays that
      broadcast to the value.
    - `name`: key of the result; needed with `apply`. Default None: the path of `where`.
    - `prior`: (mean, standard deviation) of a normal prior, numbers or arrays, a `LogNormal`, which needs
      bounds of 0 or above, a `Smooth`, for profiles: arrays of two values or more along one axis, or, for
      `retrieve_scene`, a `MarkovField`, for maps. Default None: no prior.
    - `start`: starting value within the bounds; needed with `apply`. Default None: the scene's value.
    - `apply`: a function `apply(scene, value) -> scene`, given instead of `where`, for values that change
      several arrays at once. It must be differentiable and keep the tree structure of the scene. Unknowns are
      applied in the order in which they are listed. Define the function once, outside of loops: a new
      function compiles the simulation again. Default None.

    An unknown given by a path can be pickled and sent to other processes. One given by a function can be
    pickled if the function can; a lambda cannot.

    **Raises:** ValueError for bounds that are not finite and increasing, for a standard deviation that is not
    positive, unless exactly one of `where` and `apply` is given, and for an `apply` without `name` and
    `start`. TypeError for a `where` or `apply` of another kind. `retrieve` raises ValueError for a start
    outside the bounds, and for a `where` that is no array of the scene, with the paths nearest to it.

    **Example:**

    >>> import jaxlidar as jl
    >>> import inversion
    >>> import equinox as eqx
    >>> Cab = inversion.Unknown("canopy.leaf.Cab", bounds=(5.0, 100.0), name="Cab")
    >>> def scale_leaf_area(scene, factor):
    ...     return eqx.tree_at(lambda s: s.canopy.voxels.leaf, scene, replace_fn=lambda leaf: factor * leaf)
    >>> area = inversion.Unknown(apply=scale_leaf_area, name="leaf area", bounds=(0.1, 10.0), start=1.0)
    >>> Cab.name, area.name
    ('Cab', 'leaf area')
    """

    where: str | Callable[[Any], Any] | None = eqx.field(static=True, default=None)
    bounds: tuple[Float[Array, "..."], Float[Array, "..."]] = eqx.field(converter=_as_bounds, kw_only=True)
    name: str | None = eqx.field(static=True, default=None, kw_only=True)
    prior: Prior | None = eqx.field(converter=_as_optional_prior, default=None, kw_only=True)
    start: Float[Array, "..."] | None = eqx.field(converter=_as_optional_start, default=None, kw_only=True)
    apply: Callable[[Scene, Array], Scene] | None = eqx.field(static=True, default=None, kw_only=True)

    def __check_init__(self):
        label = _label(self.name)
        if (self.where is None) == (self.apply is None):
            raise ValueError(f"{label}: give either where = ... or apply = ..., and not both")
        if not (self.where is None or isinstance(self.where, str) or callable(self.where)):
            raise TypeError(f"{label}: where = {self.where!r} is no path and no function")
        if not (self.apply is None or callable(self.apply)):
            raise TypeError(f"{label}: apply = {self.apply!r} is no function")
        if self.apply is not None and (self.name is None or self.start is None):
            raise ValueError(f"{label}: with apply = ..., a name and a start are needed")
        low, high = self.bounds
        check_range(f"{label}: bounds", low)
        check_range(f"{label}: bounds", high)
        if not np.all(np.asarray(low) < np.asarray(high)):
            raise ValueError(f"{label}: bounds = ({low}, {high}) are not low < high")
        if isinstance(self.prior, LogNormal):
            # Zero is admissible: a fit keeps off its bounds.
            check_range(f"{label}: lower bound, with a log-normal prior,", low, 0.0)
        elif isinstance(self.prior, tuple):
            check_range(f"{label}: prior mean", self.prior[0])
            check_range(f"{label}: prior standard deviation", self.prior[1], 0.0, low_open=True)


def _label(name: str | None) -> str:
    """Subject of error messages."""
    return "an unknown" if name is None else f"unknown {name!r}"


# Means by which an unknown acts on the simulation: the optics alone, extinction alone, or the paths of light.
Dependence = Literal["optical", "extinction", "geometric"]


class Setter(NamedTuple):
    """The way in which a value enters the simulation: hashable, and equal for equal unknowns.

    - `array_index`: index of the array, among the pytree leaves of the scene or of the lidar, that the value
      replaces, or None with `apply`.
    - `apply`: function that puts the value into the scene, or None with `array_index`. Both are None for
      unknowns that are not of the scene, such as the receiver's.
    - `dependence`: means by which the value acts on the simulation. "optical": it only weights the traced
      histories of light; "extinction": it changes the weights of paths of light; "geometric": it changes the
      paths.
    - `of_lidar`: True if the array is one of the lidar. Default False.
    """

    array_index: int | None
    apply: Callable[[Scene, Array], Scene] | None
    dependence: Dependence
    of_lidar: bool = False

    @property
    def changes_response(self) -> bool:
        """True if the response depends on the value, so that photons have to be traced again."""
        return self.dependence != "optical"


class BoundUnknown(NamedTuple):
    """An unknown bound to a scene. Arrays have the value's shape, in double precision (`start`: JAX's).

    - `prior`: mean and standard deviation, of the logarithm if `is_log_prior`; None without such a prior.
    - `smooth`: a smoothness prior, or None. `field`: the prior of a map, or None.
    - `smooth_level`: mean of the common level of a smoothness prior without mean. Default None: that of the
      start.
    """

    name: str
    setter: Setter
    start: Array
    low: np.ndarray
    high: np.ndarray
    prior: tuple[np.ndarray, np.ndarray] | None
    is_log_prior: bool = False
    smooth: Smooth | None = None
    smooth_level: float | None = None
    field: MarkovField | None = None

    @property
    def prior_level(self) -> float:
        """Mean of the common level of a smoothness prior without mean."""
        return float(np.mean(self.start)) if self.smooth_level is None else self.smooth_level


def bind_unknowns(
    unknowns: Sequence[Unknown], scene: Scene, lidar: Lidar | None = None, *, of_maps: bool = False
) -> list[BoundUnknown]:
    """Locate the unknowns in the scene and the lidar.

    `lidar`: None where its arrays cannot be unknown. `of_maps`: True for a fit of many records, which takes a
    `MarkovField` and no `Smooth`.

    **Raises:** ValueError for unknowns that cannot be retrieved.
    """
    check_kind("scene", scene, Scene, "a Scene")
    check_kind("unknowns", unknowns, Sequence, "a sequence of Unknown")
    for i, unknown in enumerate(unknowns):
        check_kind(f"unknowns[{i}]", unknown, Unknown, "an Unknown")
    if len(unknowns) == 0:
        raise ValueError("unknowns is empty; admissible is one unknown or more")
    for unknown in unknowns:
        _check_prior_kind(unknown, of_maps)
    arrays_by_dependence: list[tuple[Dependence, frozenset[int]]] = [
        ("optical", optical_arrays(scene)),
        ("extinction", extinction_arrays(scene)),
    ]
    bound = [_bind(u, scene, lidar, arrays_by_dependence) for u in unknowns]
    names = [u.name for u in bound]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"name = {name!r} is given to {names.count(name)} unknowns; each needs its own")
    # Two values for one array: the second would overwrite the first. Not so with `apply`, which may scale
    # what another unknown has set.
    places = [(u.setter.of_lidar, u.setter.array_index) for u in bound]
    for u, place in zip(bound, places):
        if u.setter.array_index is not None and places.count(place) > 1:
            raise ValueError(f"unknown {u.name!r} picks an array that another one picks as well")
    return bound


def _check_prior_kind(unknown: Unknown, of_maps: bool) -> None:
    """Refuse the prior of a map in a fit of profiles, and that of a profile in one of maps."""
    refused, admissible = (Smooth, MarkovField) if of_maps else (MarkovField, Smooth)
    if isinstance(unknown.prior, refused):
        raise ValueError(
            f"{_label(unknown.name)}: prior is a {refused.__name__}; admissible here is a "
            f"{admissible.__name__}, a LogNormal or a pair (mean, standard deviation)"
        )


def _bind(
    u: Unknown,
    scene: Scene,
    lidar: Lidar | None,
    arrays_by_dependence: list[tuple[Dependence, frozenset[int]]],
) -> BoundUnknown:
    """Locate one unknown in the scene or the lidar.

    1. Find the arrays that it changes, its name and its start.
    2. Broadcast bounds and prior to the shape of the start.
    3. Classify it by the arrays that it changes.
    """
    array_index, name, start, of_lidar = None, u.name, u.start, False
    if u.where is None:
        changed_arrays = _changed_arrays(u, scene)
    else:
        of_lidar = isinstance(u.where, str) and u.where.startswith(_OF_LIDAR)
        if of_lidar:
            array_index, path, initial = _locate_in_lidar(str(u.where), lidar, u.name)
        else:
            array_index, path = _locate(u.where, scene, u.name)
            initial = jax.tree.leaves(scene)[array_index]
        changed_arrays = frozenset([array_index])
        name = path if name is None else name
        # Integers have no derivative.
        if not eqx.is_inexact_array(initial):
            raise ValueError(
                f"unknown {name!r} is {initial!r}; admissible is a floating-point array of the scene"
            )
        start = as_array(initial) if start is None else _broadcast(name, "start", start, initial.shape)
    assert name is not None
    assert start is not None
    low, high = (np.asarray(_broadcast(name, "bounds", b, start.shape), float) for b in u.bounds)
    prior, is_log_prior, smooth = None, isinstance(u.prior, LogNormal), None
    if isinstance(u.prior, Smooth):
        smooth = u.prior
        if not (start.size > 1 and max(start.shape) == start.size):
            raise ValueError(
                f"unknown {name!r} has the shape {start.shape}; admissible with a Smooth prior are two "
                "values or more along one axis"
            )
        if smooth.mean is not None:
            _broadcast(name, "mean", smooth.mean, start.shape)
    elif isinstance(u.prior, MarkovField):
        if u.prior.difference.ndim and u.prior.difference.size != start.ndim:
            raise ValueError(
                f"unknown {name!r}: difference has {u.prior.difference.size} values; admissible is one, or "
                f"one for each of its {start.ndim} axes"
            )
        if u.prior.mean is not None:
            check_range(f"{_label(name)}: lower bound, with the mean of an exponential prior,", low, 0.0)
    elif u.prior is not None:
        mean_and_std = (u.prior.median, u.prior.spread) if isinstance(u.prior, LogNormal) else u.prior
        mean, std = (np.asarray(_broadcast(name, "prior", p, start.shape), float) for p in mean_and_std)
        prior = (np.log(mean) if is_log_prior else mean), std
    # The first kind that covers all changed arrays; a mixture is geometric.
    matches: list[Dependence] = [kind for kind, arrays in arrays_by_dependence if changed_arrays <= arrays]
    if of_lidar:
        matches = ["optical"] if _field_of_lidar(str(u.where)) in _LATE_FIELDS else []
    setter = Setter(array_index, u.apply, matches[0] if matches else "geometric", of_lidar)
    field = u.prior if isinstance(u.prior, MarkovField) else None
    bound = BoundUnknown(name, setter, start, low, high, prior, is_log_prior, smooth, field=field)
    return with_start(bound, start)


def unknown_outside_scene(
    name: str, bounds: tuple[float, float], shape: tuple[int, ...] = (), start: float | None = None
) -> BoundUnknown:
    """Return an unknown that changes no part of the scene; it starts from the middle of its bounds (None)."""
    low, high = (np.full(shape, bound, float) for bound in bounds)
    values = jnp.asarray(0.5 * (low + high) if start is None else np.full(shape, start))
    return with_start(BoundUnknown(name, Setter(None, None, "optical"), values, low, high, None), values)


def with_start(unknown: BoundUnknown, start: Array) -> BoundUnknown:
    """Return the unknown with another start, kept at `MARGIN` from its bounds.

    **Raises:** ValueError for a start outside the bounds.
    """
    value, low, high = np.asarray(start, float), unknown.low, unknown.high
    # Written so that NaN counts as outside.
    is_outside = ~((value >= low) & (value <= high))
    if np.any(is_outside):
        raise ValueError(
            f"unknown {unknown.name!r} starts from {value[is_outside].flat[0]:g}, which is outside its "
            f"bounds [{low[is_outside].flat[0]:g}, {high[is_outside].flat[0]:g}]"
        )
    margin = MARGIN * (high - low)
    return unknown._replace(start=jnp.asarray(np.clip(value, low + margin, high - margin), start.dtype))


def _broadcast(name: str, field: str, x: Array, shape: tuple[int, ...]) -> Array:
    try:
        return jnp.broadcast_to(x, shape)
    except ValueError:
        raise ValueError(
            f"unknown {name!r}: {field} has the shape {x.shape}, which does not broadcast to {shape}"
        ) from None


def _locate(where: str | Callable, scene: Scene, name: str | None) -> tuple[int, str]:
    """Return the index and path of the array at `where` among the scene's pytree leaves."""
    leaves = jax.tree_util.tree_leaves_with_path(scene)
    paths = [jax.tree_util.keystr(path).lstrip(".") for path, _ in leaves]
    label = _label(name)
    if isinstance(where, str):
        if where in paths:
            return paths.index(where), where
        # A cutoff of 0: some suggestion is better than none.
        nearest = difflib.get_close_matches(where, paths, n=3, cutoff=0.0)
        raise ValueError(
            f"{label}: where = {where!r} is no array of this scene; the nearest are "
            f"{', '.join(map(repr, nearest))}"
        )
    # `where` is called on a scene of unique markers: values of arrays may be equal, markers are not.
    markers = [object() for _ in paths]
    try:
        picked = where(jax.tree.unflatten(jax.tree.structure(scene), markers))
    except (AttributeError, IndexError, KeyError, TypeError) as error:
        raise ValueError(f"{label}: where picks nothing in this scene ({error}); see `apply`") from error
    for i, marker in enumerate(markers):
        if picked is marker:
            return i, paths[i]
    kind = "nothing (None)" if picked is None else f"a {type(picked).__name__}"
    raise ValueError(f"{label}: where picks {kind}; admissible is one array of the scene")


def _field_of_lidar(where: str) -> str:
    """Return the name of the lidar's field in a path such as "lidar.pulse.fwhm"."""
    return where.removeprefix(_OF_LIDAR).split(".")[0]


def _locate_in_lidar(where: str, lidar: Lidar | None, name: str | None) -> tuple[int, str, Array]:
    """Return the index among the lidar's pytree leaves, the path and the value of an array of the lidar."""
    label = _label(name)
    if lidar is None:
        raise ValueError(f"{label}: where = {where!r}; admissible here are arrays of the scene")
    index, value = locate_lidar_array(
        where, lidar, (*_RAY_FIELDS, *_LATE_FIELDS), argument=f"{label}: where", prefix=_OF_LIDAR
    )
    # Positions are kept in double precision.
    return index, where, as_array(value)


def locate_lidar_array(
    path: str, lidar: Lidar, fields: Sequence[str], *, argument: str, prefix: str = ""
) -> tuple[int, Array | np.ndarray]:
    """Return the index among the lidar's pytree leaves, and the value, of an array of one of some fields.

    `argument`: that gave the path, for messages. `prefix`: with which paths begin.

    **Raises:** ValueError for a path that is no such array, with those that are.
    """
    leaves = jax.tree_util.tree_leaves_with_path(lidar)
    paths = [prefix + jax.tree_util.keystr(path).lstrip(".") for path, _ in leaves]
    admissible = [p for p in paths if p.removeprefix(prefix).split(".")[0] in fields]
    if path not in admissible:
        raise ValueError(f"{argument} = {path!r}; admissible are {', '.join(map(repr, admissible))}")
    index = paths.index(path)
    return index, leaves[index][1]


def _changed_arrays(u: Unknown, scene: Scene) -> frozenset[int]:
    """Return the indices of the scene's pytree leaves that `apply` changes."""
    before, structure = jax.tree.flatten(scene)
    changed: list[int] = []

    def probe(value):
        assert u.apply is not None
        after = u.apply(scene, value)
        if jax.tree.structure(after) != structure:
            raise ValueError(
                f"unknown {u.name!r}: apply returns a scene with other parts, or none; admissible is one "
                "of the same tree structure"
            )
        # An array that `apply` does not touch is the same object.
        changed.extend(i for i, (a, b) in enumerate(zip(before, jax.tree.leaves(after))) if a is not b)

    # Shapes suffice: nothing is computed.
    jax.eval_shape(probe, u.start)
    if not changed:
        raise ValueError(f"unknown {u.name!r}: apply changes nothing in the scene")
    return frozenset(changed)


def optical_arrays(scene: Scene) -> frozenset[int]:
    """Return the indices of the scene's pytree leaves that act after the trace.

    These are leaf and bark optics, reflectances and the atmosphere. The response does not depend on them if
    the plan keeps scattering histories apart from optics (`inversion.fit.model`).
    """
    # With straight transmission, the transmittance of leaves scales extinction.
    is_straight = scene.canopy is not None and scene.canopy.transmission == "straight"

    def acts_after_trace(path: tuple[Any, ...]) -> bool:
        match [getattr(key, "name", None) for key in path]:
            case ["canopy", "leaf", *_]:
                return not is_straight
            case ["ground", "reflectance", *_]:
                # A reflectance that varies with position is applied while light is traced.
                return scene.ground is None or scene.ground.pattern is None
            case ["canopy", "bark", *_] | ["atmosphere", *_]:
                return True
            case ["plates" | "meshes", _, "reflectance" | "transmittance", *_]:
                return True
        return False

    leaves = jax.tree_util.tree_leaves_with_path(scene)
    return frozenset(i for i, (path, _) in enumerate(leaves) if acts_after_trace(path))


def extinction_arrays(scene: Scene) -> frozenset[int]:
    """Return the indices of the scene's pytree leaves that change the extinction of leaf or bark only."""
    # Not the leaf angles of a map: they determine the directions into which leaves scatter as well.
    leaves = jax.tree_util.tree_leaves_with_path(scene)
    paths = [[getattr(key, "name", None) for key in path] for path, _ in leaves]
    extinction_paths = (["canopy", "voxels", "leaf"], ["canopy", "voxels", "bark"])
    return frozenset(i for i, path in enumerate(paths) if path in extinction_paths)


def set_values(scene: Scene, setters: tuple[Setter, ...], values: tuple[Array, ...]) -> Scene:
    """Return the scene with the values of its unknowns, applied in their order."""
    for setter, value in zip(setters, values):
        if setter.apply is not None:
            scene = setter.apply(scene, value)
        elif not setter.of_lidar:
            # Flattened for each value: an earlier `apply` may have replaced arrays.
            scene = _with_array(scene, setter, value)
    return scene


def set_lidar_values(lidar: Lidar, setters: tuple[Setter, ...], values: tuple[Array, ...]) -> Lidar:
    """Return the lidar with the values of its unknowns."""
    for setter, value in zip(setters, values):
        if setter.of_lidar:
            lidar = _with_array(lidar, setter, value)
    return lidar


def _with_array(tree: Any, setter: Setter, value: Array) -> Any:
    """Return a scene or a lidar with one array replaced."""
    assert setter.array_index is not None
    leaves, structure = jax.tree.flatten(tree)
    leaves[setter.array_index] = value
    return jax.tree.unflatten(structure, leaves)


# -- flattened unknowns: one vector of all values, in the order of the unknowns


def flat_start(unknowns: Sequence[BoundUnknown]) -> Float[np.ndarray, " n"]:
    """Return the starting values as one vector."""
    return np.concatenate([np.ravel(np.asarray(u.start, float)) for u in unknowns])


def flat_bounds(
    unknowns: Sequence[BoundUnknown],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the lower and upper bounds as two vectors."""
    low = np.concatenate([np.ravel(u.low) for u in unknowns])
    return low, np.concatenate([np.ravel(u.high) for u in unknowns])


def split_values(flat: Array, shapes: tuple[tuple[int, ...], ...]) -> tuple[Array, ...]:
    """Return the values of each shape, (..., *shape), from vectors (..., n). It takes tracers."""
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
    pieces = jnp.split(flat, ends[:-1], axis=-1)
    return tuple(piece.reshape(*flat.shape[:-1], *shape) for piece, shape in zip(pieces, shapes))


def split_by_name(flat: np.ndarray, unknowns: Sequence[BoundUnknown]) -> dict[str, np.ndarray]:
    """Return values by name, (..., *shape), from vectors (..., n)."""
    pieces = np.split(flat, np.cumsum([u.start.size for u in unknowns])[:-1], axis=-1)
    return {u.name: p.reshape((*flat.shape[:-1], *u.start.shape)) for u, p in zip(unknowns, pieces)}


def bounds_by_name(unknowns: Sequence[BoundUnknown]) -> dict[str, np.ndarray]:
    """Return lower and upper bounds by name, (2, ...)."""
    return {u.name: np.stack([u.low, u.high]) for u in unknowns}


def smooth_names(unknowns: Sequence[BoundUnknown]) -> list[str]:
    """Return the names of the unknowns with smoothness priors."""
    return [u.name for u in unknowns if u.smooth is not None]


def flat_labels(unknowns: Sequence[BoundUnknown]) -> tuple[str, ...]:
    """Return the names of the flattened values, with an index for those of arrays."""
    return tuple(
        u.name + ("" if u.start.ndim == 0 else str(list(map(int, np.unravel_index(i, u.start.shape)))))
        for u in unknowns
        for i in range(u.start.size)
    )
