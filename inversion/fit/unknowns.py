"""Unknowns of a retrieval: their bounds, priors and starting values, and how a value enters the scene.

A bounded value is a smooth bijection of a free parameter z, value = low + (high - low) / (1 + exp(-z)): a
solver in z never reaches the bounds.
"""

import difflib
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from inversion.fit.priors import LogNormal, Smooth
from jaxlidar import Scene
from jaxlidar.extend import as_array, check_kind, check_range

# (mean, standard deviation), or a prior with a name.
Prior = tuple[Float[Array, "..."], Float[Array, "..."]] | LogNormal | Smooth
# Least distance of a starting value from a bound, as a share of the bounds' width.
MARGIN = 0.01


def _as_pair(x: Any) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    try:
        low, high = x
    except (TypeError, ValueError):
        raise ValueError(f"bounds = {x!r} is not a pair (low, high)") from None
    return as_array(low, "lower bound"), as_array(high, "upper bound")


def _optional_prior(x: Any) -> Prior | None:
    if x is None or isinstance(x, LogNormal | Smooth):
        return x
    try:
        mean, std = x
    except (TypeError, ValueError):
        raise ValueError(
            f"prior = {x!r} is no LogNormal, no Smooth and no pair (mean, standard deviation)"
        ) from None
    return as_array(mean, "prior mean"), as_array(std, "prior standard deviation")


def _optional_array(x: ArrayLike | None) -> Float[Array, "..."] | None:
    return None if x is None else as_array(x, "start")


@final
class Unknown(eqx.Module):
    """An unknown of a retrieval: an array of the scene, or a value that a function puts into the scene.

    A start on a bound, or closer to it than 1 % of the bounds' width, is moved to that distance.

    **Arguments:**

    - `where`: the place of one array in the scene, of any shape: its path, such as "canopy.leaf.Cab" or
      "plates[0].height", or a function that picks it, as for `equinox.tree_at`. An element of an array, or a
      property, is no such array: use `apply`. Default None.
    - `bounds`: (low, high) in the unknown's own unit, finite, low below high, numbers or arrays that
      broadcast to the value.
    - `name`: key of the result; needed with `apply`. Default None: the path of `where`.
    - `prior`: (mean, standard deviation) of a normal prior, numbers or arrays, a `LogNormal`, which needs
      bounds of 0 or above, or a `Smooth`, for profiles: arrays of two values or more along one axis. Default
      None: no prior.
    - `start`: starting value within the bounds; needed with `apply`. Default None: the scene's value.
    - `apply`: a function `apply(scene, value) -> scene`, given instead of `where`, for values that change
      several arrays at once. It must be differentiable and keep the tree structure of the scene. Unknowns are
      applied in the order in which they are listed. Define the function once, outside of loops: every new one
      compiles the simulation again. Default None.

    An unknown given by a path can be pickled and sent to other processes; one given by a function can be if
    the function can, which a lambda cannot.

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
    bounds: tuple[Float[Array, "..."], Float[Array, "..."]] = eqx.field(converter=_as_pair, kw_only=True)
    name: str | None = eqx.field(static=True, default=None, kw_only=True)
    prior: Prior | None = eqx.field(converter=_optional_prior, default=None, kw_only=True)
    start: Float[Array, "..."] | None = eqx.field(converter=_optional_array, default=None, kw_only=True)
    apply: Callable[[Scene, Array], Scene] | None = eqx.field(static=True, default=None, kw_only=True)

    def __check_init__(self):
        called = "an unknown" if self.name is None else f"unknown {self.name!r}"
        if (self.where is None) == (self.apply is None):
            raise ValueError(f"{called}: give either where = ... or apply = ..., and not both")
        if not (self.where is None or isinstance(self.where, str) or callable(self.where)):
            raise TypeError(f"{called}: where = {self.where!r} is no path and no function")
        if not (self.apply is None or callable(self.apply)):
            raise TypeError(f"{called}: apply = {self.apply!r} is no function")
        if self.apply is not None and (self.name is None or self.start is None):
            raise ValueError(f"{called}: with apply = ..., a name and a start are needed")
        low, high = self.bounds
        check_range(f"{called}: bounds", low)
        check_range(f"{called}: bounds", high)
        if not np.all(np.asarray(low) < np.asarray(high)):
            raise ValueError(f"{called}: bounds = ({low}, {high}) are not low < high")
        if isinstance(self.prior, LogNormal):
            # Zero is admissible: the bijection never reaches the bounds.
            check_range(f"{called}: lower bound, with a log-normal prior,", low, 0.0)
        elif isinstance(self.prior, tuple):
            check_range(f"{called}: prior mean", self.prior[0])
            check_range(f"{called}: prior standard deviation", self.prior[1], 0.0, low_open=True)


Kind = Literal["optical", "extinction", "geometric"]


class Place(NamedTuple):
    """How a value enters the scene: hashable, and equal for equal unknowns.

    - `leaf`: number of the scene's leaf that it replaces, or None where `apply` sets it.
    - `kind`: what a change of the value changes: "optical", only what is left of light; "extinction", the
      weights of paths of light; "geometric", the paths.
    """

    leaf: int | None
    apply: Callable[[Scene, Array], Scene] | None
    kind: Kind

    @property
    def traced(self) -> bool:
        """Whether the response depends on the value."""
        return self.kind != "optical"


class Settled(NamedTuple):
    """An unknown of a given scene. Arrays have the value's shape, in double precision (`start`: JAX's).

    `prior`: mean and standard deviation, of the logarithm where `log_prior`. `smooth`: a smoothness prior.
    """

    name: str
    place: Place
    start: Array
    low: np.ndarray
    high: np.ndarray
    prior: tuple[np.ndarray, np.ndarray] | None
    log_prior: bool = False
    smooth: Smooth | None = None


def settle(unknowns: Sequence[Unknown], scene: Scene) -> list[Settled]:
    """Locate the unknowns in the scene. **Raises:** ValueError for what cannot be retrieved."""
    check_kind("scene", scene, Scene, "a Scene")
    check_kind("unknowns", unknowns, Sequence, "a sequence of Unknown")
    for i, unknown in enumerate(unknowns):
        check_kind(f"unknowns[{i}]", unknown, Unknown, "an Unknown")
    if len(unknowns) == 0:
        raise ValueError("unknowns is empty; admissible is one unknown or more")
    kinds: list[tuple[Kind, frozenset[int]]] = [
        ("optical", optical_leaves(scene)),
        ("extinction", extinction_leaves(scene)),
    ]
    found = [_settle_one(u, scene, kinds) for u in unknowns]
    names = [f.name for f in found]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"name = {name!r} is given to {names.count(name)} unknowns; each needs its own")
    leaves = [f.place.leaf for f in found if f.place.leaf is not None]
    for f in found:
        if f.place.leaf is not None and leaves.count(f.place.leaf) > 1:
            raise ValueError(f"unknown {f.name!r} picks an array of the scene that another one picks as well")
    return found


def _settle_one(u: Unknown, scene: Scene, kinds: list[tuple[Kind, frozenset[int]]]) -> Settled:
    number, name, start = None, u.name, u.start
    if u.where is None:
        touched = _touched(u, scene)
    else:
        number, path = _find(u.where, scene, u.name)
        touched = frozenset([number])
        name = path if name is None else name
        own = jax.tree.leaves(scene)[number]
        if not eqx.is_inexact_array(own):
            raise ValueError(
                f"unknown {name!r} is {own!r}; admissible is a floating-point array of the scene"
            )
        start = as_array(own) if start is None else _broadcast(name, "start", start, own.shape)
    assert name is not None
    assert start is not None
    low, high = (np.asarray(_broadcast(name, "bounds", b, start.shape), float) for b in u.bounds)
    prior, log_prior, smooth = None, isinstance(u.prior, LogNormal), None
    if isinstance(u.prior, Smooth):
        smooth = u.prior
        if not (start.size > 1 and max(start.shape) == start.size):
            raise ValueError(
                f"unknown {name!r} has the shape {start.shape}; admissible with a Smooth prior are two "
                "values or more along one axis"
            )
        if smooth.mean is not None:
            _broadcast(name, "mean", smooth.mean, start.shape)
    elif u.prior is not None:
        pair = (u.prior.median, u.prior.spread) if isinstance(u.prior, LogNormal) else u.prior
        mean, std = (np.asarray(_broadcast(name, "prior", p, start.shape), float) for p in pair)
        prior = np.log(mean) if log_prior else mean, std
    those: list[Kind] = [kind for kind, leaves in kinds if touched <= leaves]
    place = Place(number, u.apply, those[0] if those else "geometric")
    return start_from(Settled(name, place, start, low, high, prior, log_prior, smooth), start)


def start_from(unknown: Settled, start: Array) -> Settled:
    """The unknown with another start, at a margin from its bounds. **Raises:** ValueError outside them."""
    value, low, high = np.asarray(start, float), unknown.low, unknown.high
    bad = ~((value >= low) & (value <= high))
    if np.any(bad):
        raise ValueError(
            f"unknown {unknown.name!r} starts from {value[bad].flat[0]:g}, which is outside its bounds "
            f"[{low[bad].flat[0]:g}, {high[bad].flat[0]:g}]"
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


def _find(where: str | Callable, scene: Scene, name: str | None) -> tuple[int, str]:
    """Number and path of the leaf at `where`."""
    leaves = jax.tree_util.tree_leaves_with_path(scene)
    paths = [jax.tree_util.keystr(path).lstrip(".") for path, _ in leaves]
    called = "an unknown" if name is None else f"unknown {name!r}"
    if isinstance(where, str):
        if where in paths:
            return paths.index(where), where
        near = difflib.get_close_matches(where, paths, n=3, cutoff=0.0)
        raise ValueError(
            f"{called}: where = {where!r} is no array of this scene; the nearest are "
            f"{', '.join(map(repr, near))}"
        )
    marks = [object() for _ in paths]
    try:
        picked = where(jax.tree.unflatten(jax.tree.structure(scene), marks))
    except (AttributeError, IndexError, KeyError, TypeError) as error:
        raise ValueError(f"{called}: where picks nothing in this scene ({error}); see `apply`") from error
    for i, mark in enumerate(marks):
        if picked is mark:
            return i, paths[i]
    kind = "nothing (None)" if picked is None else f"a {type(picked).__name__}"
    raise ValueError(f"{called}: where picks {kind}; admissible is one array of the scene")


def _touched(u: Unknown, scene: Scene) -> frozenset[int]:
    """Numbers of the scene's leaves that `apply` changes."""
    before, structure = jax.tree.flatten(scene)
    touched: list[int] = []

    def probe(value):
        assert u.apply is not None
        after = u.apply(scene, value)
        if jax.tree.structure(after) != structure:
            raise ValueError(
                f"unknown {u.name!r}: apply returns a scene with other parts, or none; admissible is one "
                "of the same tree structure"
            )
        touched.extend(i for i, (a, b) in enumerate(zip(before, jax.tree.leaves(after))) if a is not b)

    jax.eval_shape(probe, u.start)
    if not touched:
        raise ValueError(f"unknown {u.name!r}: apply changes nothing in the scene")
    return frozenset(touched)


def optical_leaves(scene: Scene) -> frozenset[int]:
    """Numbers of the scene's leaves that act only after the trace: the response does not depend on them."""
    # Where transmitted light goes straight on, the leaves' transmittance scales extinction.
    straight = scene.canopy is not None and scene.canopy.transmission == "straight"

    def acts_later(path: tuple[Any, ...]) -> bool:
        match [getattr(key, "name", None) for key in path]:
            case ["canopy", "leaf", *_]:
                return not straight
            case ["ground", "reflectance", *_]:
                # Where it varies from place to place, light is traced with it.
                return scene.ground is None or scene.ground.pattern is None
            case ["canopy", "bark", *_] | ["atmosphere", *_]:
                return True
            case ["plates", _, "reflectance" | "transmittance", *_]:
                return True
        return False

    leaves = jax.tree_util.tree_leaves_with_path(scene)
    return frozenset(i for i, (path, _) in enumerate(leaves) if acts_later(path))


def extinction_leaves(scene: Scene) -> frozenset[int]:
    """Numbers of the scene's leaves that change the extinction of leaf or bark, and nothing else."""
    leaves = jax.tree_util.tree_leaves_with_path(scene)
    paths = [[getattr(key, "name", None) for key in path] for path, _ in leaves]
    ours = (["canopy", "voxels", "leaf"], ["canopy", "voxels", "bark"])
    return frozenset(i for i, path in enumerate(paths) if path in ours)


def put(scene: Scene, places: tuple[Place, ...], values: tuple[Array, ...]) -> Scene:
    """The scene with the values of the unknowns, applied in their order."""
    for place, value in zip(places, values):
        if place.apply is not None:
            scene = place.apply(scene, value)
        else:
            assert place.leaf is not None
            leaves, structure = jax.tree.flatten(scene)
            leaves[place.leaf] = value
            scene = jax.tree.unflatten(structure, leaves)
    return scene


def latin_hypercube(
    settled: Sequence[Settled], count: int, key: PRNGKeyArray
) -> Float[np.ndarray, "count unknowns"]:
    """Starting points spread over the bounds: each unknown has one in each of `count` equal intervals.

    **Source:** McKay, Beckman and Conover (1979), Technometrics 21, 239.
    """
    low = np.concatenate([np.ravel(s.low) for s in settled])
    high = np.concatenate([np.ravel(s.high) for s in settled])
    order_key, place_key = jax.random.split(key)
    order = jax.vmap(lambda k: jax.random.permutation(k, count))(jax.random.split(order_key, low.size))
    share = (
        np.asarray(order).T + np.asarray(jax.random.uniform(place_key, (count, low.size)), float)
    ) / count
    return low + (high - low) * np.clip(share, MARGIN, 1.0 - MARGIN)
