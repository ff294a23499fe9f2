"""Geolocation: the horizontal shift of a survey, from its records and a scene that is known.

**Model.** Beams are Gaussian and parallel. The waveform of a footprint is linear in its irradiance, and a
Gaussian of covariance S is the convolution of one of covariance S_n with one of covariance S - S_n. So

    W(p) = sum over nodes n of  d^2 g(p - x_n) W_n,    g = normal density of covariance S - S_n,

where W_n are the waveforms of narrow beams at the nodes x_n of a grid with the spacing d. The sum over nodes
stands for an integral; with the beams chosen here its error is 2e-4 of the waveform or less (the terms of
Poisson's summation formula beyond the first). The nodes are simulated once, with all that the tracer knows.
Derivatives with respect to the position p are those of g, exact for this sum.

**Fit.** Record i is a_i W(p_i + D_i theta) and noise, with a free factor a_i, the shift theta, and D_i = 1;
with drift, the shift varies linearly along the survey. The factors are eliminated (variable projection, Golub
and Pereyra 1973): chi-squared is first evaluated on a grid of shifts, then Gauss-Newton steps, damped by
Levenberg and Marquardt, start from its lowest minima.

**Covariance.** Residuals have noise and errors of the scene, which are correlated within a record. With the
score vectors s_i = J_i^T r_i of the records and the information F = sum of J_i^T J_i, the covariance is

    F^-1 (n / (n - p) sum of s_i s_i^T) F^-1    (clusters are the records; Liang and Zeger 1986),

but in no direction less than F^-1, which it is where there is nothing but the stated noise. Where records are
fewer than `_MIN_CLUSTERS`, it is F^-1, times the reduced chi-squared if that exceeds one.

**Source:** Golub and Pereyra (1973), SIAM J. Numer. Anal. 10, 413; Liang and Zeger (1986), Biometrika 73, 13;
for GEDI's footprints over airborne clouds, Hancock et al. (2019), Earth Space Sci. 6, 294.
"""

import dataclasses
import warnings
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float, Int, PRNGKeyArray

from jaxlidar import SPEED_OF_LIGHT, OffMapWarning, Scene, Survey, Terrain, Waveforms, simulate_many
from jaxlidar.extend import (
    as_numpy,
    check_integer,
    check_key,
    check_kind,
    check_kinds,
    check_number,
    check_numbers,
    check_range,
)

# Beams of nodes have this fraction of the footprint's covariance. With a half, nodes may lie farthest apart.
_NODE_COVARIANCE = 0.5
# Distance of nodes over the standard deviation of the footprint. The largest term that the sum over nodes
# adds to the integral has the factor exp(-(2 pi / 0.7)^2 / 8) = 4e-5.
_NODE_SPACING = 0.7
# Standard deviations of g within which nodes count: 3e-4 of its integral lie beyond.
_REACH = 4.0
# Distance of the shifts that are tried first, over the standard deviation of the footprint: the minimum of
# chi-squared is about as wide as the footprint.
_COARSE_SPACING = 0.35
# Minima from which Gauss-Newton steps start, and how many coarse steps lie between them.
_STARTS, _APART = 3, 3.0
# Most trial steps from a start; the largest step, in standard errors and in m, that counts as converged.
_MAX_STEPS, _SMALL_STEP, _SMALLEST_STEP = 40, 0.01, 1e-4
# Fewest records for which the scatter of their scores is taken for their covariance.
_MIN_CLUSTERS = 6
# Least information, 1/m2, of which the covariance is the inverse.
_LEAST_INFORMATION = 1e-12


class Geolocation(NamedTuple):
    """The place of a survey over a scene, by `geolocate`.

    - `shift`: (2,) m east and north, to be added to the survey's positions. With drift, that of the middle of
      the survey.
    - `covariance`: (2, 2) m2, of `shift`.
    - `drift`: (2,) m east and north, by which the shift changes from the first shot to the last; None where
      it was not fitted. `drift_covariance`: (2, 2) m2, or None.
    - `height_offset`: m, to be added to the heights of the records; 0 where it was not fitted.
    - `position`: (shots, 2) m, positions with the shift.
    - `scale`: (shots,) factor by which the simulated waveform is multiplied.
    - `fitted`: (shots, samples), or (shots, wavelengths, samples) as the records: simulated times `scale`.
    - `chi_squared`: of the fit, over its degrees of freedom. One if there is only the stated noise.
    - `status`: "converged", or the reason why the result is not to be used.

    **Example:** 95 % limits of the shift.

    >>> import inversion, numpy as np
    >>> place = inversion.Geolocation(
    ...     np.array([8.0, -3.0]), np.diag([0.04, 0.01]), None, None, 0.0, np.zeros((1, 2)), np.ones(1),
    ...     np.zeros((1, 9)), 1.0, "converged",
    ... )
    >>> margin = 2.0 * np.sqrt(np.diag(place.covariance))
    >>> print((place.shift - margin).tolist(), (place.shift + margin).tolist())
    [7.6, -3.2] [8.4, -2.8]
    """

    shift: Float[np.ndarray, "2"]
    covariance: Float[np.ndarray, "2 2"]
    drift: Float[np.ndarray, "2"] | None
    drift_covariance: Float[np.ndarray, "2 2"] | None
    height_offset: float
    position: Float[np.ndarray, "shots 2"]
    scale: Float[np.ndarray, " shots"]
    fitted: Float[np.ndarray, "shots ..."]
    chi_squared: float
    status: str


def geolocate(
    records: Waveforms | ArrayLike | Sequence,
    survey: Survey,
    scene: Scene,
    *,
    noise: ArrayLike | Sequence,
    key: PRNGKeyArray,
    height: ArrayLike | Sequence | None = None,
    search_radius: float = 20.0,
    drift: bool = False,
    height_error: float = 0.0,
    max_orders: int = 1,
    rtol: float = 0.05,
) -> Geolocation:
    """Find where the footprints of a survey fell, over a canopy and terrain that are known.

    All records are shifted together. The shift is searched within a radius, then refined by Gauss-Newton
    steps. Waveforms are compared up to a factor each, so that neither the gain nor the reflectance of a
    record need be known, only the ratio of that of leaves to that of the ground. Beams must be Gaussian and
    have one direction, as GEDI's along an orbit.

    **Arguments:**

    - `records`: a `Waveforms`, whose `reflectance` is used, or an array (shots, samples) of recorded power,
      without its background, in any unit. At least two shots.
    - `survey`: the `Survey` with the nominal positions, its lidar with the pulse and the divergence.
    - `scene`: the scene, such as that of `jaxlidar.canopy_from_points`.
    - `noise`: one standard deviation of `records`, in (0, inf], anything that broadcasts to them. Infinity
      leaves a sample out.
    - `key`: a JAX random key for the simulation.
    - `height`: (shots, samples) or (samples,) m, heights of the samples in the scene's coordinates, evenly or
      unevenly spaced. Required with an array, and refused with `Waveforms`, which have heights. Default None.
    - `search_radius`: m, largest shift that is looked for, positive. Default 20.
    - `drift`: True for a shift that varies linearly from the first shot to the last. Default False.
    - `height_error`: m, standard deviation of an offset that the heights of all records have in common, 0 or
      more. It is fitted unless it is 0. Over a slope, an offset that is not fitted looks like a shift.
      Default 0.
    - `max_orders`: orders of scattering that are simulated, at least 1. Default 1.
    - `rtol`: relative error of the simulation at each node, in (0, 1); that of a footprint, a sum over some
      thirty nodes, is smaller. Default 0.05.

    **Returns:** a `Geolocation`.

    **Raises:** ValueError for inadmissible arguments, shots with more than one direction, a lidar with a
    top-hat beam, without divergence or with a field of view, and positions of which all footprints within the
    radius lie off the terrain; TypeError for arguments of the wrong type.

    **Source:** Hancock et al. (2019), Earth and Space Science 6, 294, section 3.4, match footprints to clouds
    likewise, by correlation.

    **Example:** four footprints over a ridge, 6 m west of where they are said to be.

    >>> import jax, numpy as np, jaxlidar as jl, inversion
    >>> x = np.arange(-60.0, 61.0, 20.0)
    >>> heights = 6.0 * np.cos(x / 15)[:, None] * np.cos(x / 25)
    >>> ridge = jl.Terrain(heights, spacing=20.0, origin=(-60.0, -60.0))
    >>> lidar = jl.Lidar(altitude=4e5, divergence=0.05, pulse=jl.GaussianPulse(15.0))
    >>> nominal = np.array([(-15.0, -15.0), (15.0, -15.0), (-15.0, 15.0), (15.0, 15.0)])
    >>> scene, true = jl.Scene(ground=ridge), jl.Survey(lidar, nominal - [6.0, 0.0])
    >>> waves = jl.simulate_many(true, scene, key=jax.random.key(0), max_orders=1)
    >>> place = inversion.geolocate(
    ...     waves, jl.Survey(lidar, nominal), scene, noise=1e-4, key=jax.random.key(1), search_radius=10.0
    ... )
    >>> print(np.abs(place.shift - [-6.0, 0.0]).max() < 0.3)
    True
    """
    check_kind("survey", survey, Survey, "a Survey, as in Survey(lidar, position=...)")
    check_kinds(survey.lidar, scene)
    check_key(key)
    check_number("search_radius", search_radius, 0.0, low_open=True)
    check_kind("drift", drift, bool | np.bool_, "True or False")
    check_number("height_error", height_error, 0.0)
    footprint = _footprint_covariance(survey)
    observed = _observed_records(records, height, noise, survey)
    nodes = _simulate_nodes(
        survey, scene, footprint, float(search_radius), key, check_integer("max_orders", max_orders), rtol
    )
    radius = float(search_radius)
    model = _SurveyModel(
        observed, nodes, survey.position, radius, drift=bool(drift), height_error=float(height_error)
    )
    best = None
    for start in _coarse_minima(model, float(search_radius), float(np.sqrt(footprint[0, 0]))):
        descent = _descend(model, start)
        if best is None or descent.fit.objective < best.fit.objective:
            best = descent
    assert best is not None
    return _geolocation(model, best, float(search_radius), records)


# -- records -----------------------------------------------------------------------------------------------


class _Records(NamedTuple):
    """Records with their noise: (shots, wavelengths, samples) each, and their (shots, samples) heights, m."""

    power: np.ndarray
    noise: np.ndarray
    height: np.ndarray


def _observed_records(
    records: Waveforms | ArrayLike | Sequence,
    height: ArrayLike | Sequence | None,
    noise: ArrayLike | Sequence,
    survey: Survey,
) -> _Records:
    """Check records, heights and noise, and give them their common shapes. **Raises:** as `geolocate`."""
    if isinstance(records, Waveforms):
        if height is not None:
            raise ValueError("height is given with Waveforms, which have heights; admissible is None")
        power = np.asarray(records.reflectance, float)
        # Times of a waveform are relative to the two-way travel time to the reference plane.
        cosines = np.cos(np.deg2rad(survey.zenith))
        heights = _heights_of(records.time, cosines[:, None])
        if power.shape[1] != survey.lidar.wavelength.size:
            raise ValueError(
                f"records have {power.shape[1]} wavelengths; admissible are as many as the lidar's, "
                f"{survey.lidar.wavelength.size}"
            )
    else:
        if height is None:
            raise ValueError("height = None, but records are an array: give the heights of its samples")
        check_range("records", records)
        check_range("height", height)
        power = as_numpy(records, "records")
        if power.ndim != 2:
            raise ValueError(f"records has shape {power.shape}; admissible is (shots, samples)")
        if survey.lidar.wavelength.size != 1:
            raise ValueError(
                f"survey.lidar has {survey.lidar.wavelength.size} wavelengths; admissible with an array "
                "(shots, samples) is one"
            )
        heights = _broadcast("height", as_numpy(height, "height"), power.shape)
        power = power[:, None]
    if len(power) != len(survey) or len(power) < 2:
        raise ValueError(
            f"records have {len(power)} shots and survey {len(survey)}; admissible are as many, at least 2"
        )
    check_numbers("noise", noise)
    sigma = as_numpy(noise, "noise")
    if not np.all(sigma > 0):
        raise ValueError(f"noise = {np.min(sigma):g} is outside the admissible range (0, inf]")
    shape = power.shape if isinstance(records, Waveforms) else power[:, 0].shape
    sigma = _broadcast("noise", sigma, shape).reshape(power.shape)
    if not np.all(np.isfinite(sigma).any(axis=2)):
        raise ValueError("noise is infinite in all samples of a record; admissible are finite ones in each")
    return _Records(power, sigma, heights)


def _heights_of(time: np.ndarray, cosine: np.ndarray | float) -> np.ndarray:
    """Return the heights, m, from which light of the first order arrives at the times, ns."""
    return -0.5 * SPEED_OF_LIGHT * np.asarray(time, float) * cosine


def _broadcast(field: str, values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    try:
        return np.broadcast_to(values, shape)
    except ValueError:
        raise ValueError(
            f"{field} has shape {values.shape}, which does not broadcast to that of records, {shape}"
        ) from None


# -- nodes -------------------------------------------------------------------------------------------------


def _footprint_covariance(survey: Survey) -> Float[np.ndarray, "2 2"]:
    """Return the covariance, m2, of the irradiance on the reference plane. **Raises:** as `geolocate`."""
    lidar = survey.lidar
    for name, angles in (("zenith", survey.zenith), ("azimuth", survey.azimuth)):
        if name == "azimuth" and not np.any(survey.zenith):
            continue
        if np.ptp(angles) > 0:
            raise ValueError(
                f"survey has {name} from {angles.min():g} to {angles.max():g} degrees; "
                "admissible is one direction of all shots"
            )
    if lidar.profile != "gaussian":
        raise ValueError(f"survey.lidar.profile = {lidar.profile!r}; admissible is 'gaussian'")
    if lidar.field_of_view is not None:
        raise ValueError("survey.lidar.field_of_view is given; admissible is None")
    check_number("survey.lidar.divergence", lidar.divergence, 0.0, low_open=True)
    # The radius of a beam, at 1/e^2 of the irradiance, is two standard deviations.
    sigma = 0.5 * float(survey.footprint_radius[0])
    zenith, azimuth = np.deg2rad(survey.zenith[0]), np.deg2rad(survey.azimuth[0])
    along = np.array([np.sin(azimuth), np.cos(azimuth)])
    # On the plane the footprint of an oblique beam is longer along its azimuth.
    return sigma**2 * (np.eye(2) + (1.0 / np.cos(zenith) ** 2 - 1.0) * np.outer(along, along))


class _Nodes(NamedTuple):
    """Waveforms of narrow beams at the nodes of a grid.

    - `position`: (nodes, 2) m. - `waveform`: (nodes, wavelengths, times). - `height`: (times,) m, decreasing.
    - `precision`: (2, 2) 1/m2, inverse covariance of g, the density that makes a footprint of the nodes.
    - `reach`: m, distance from a footprint within which nodes count. - `spacing`: of the grid, m.
    """

    position: Float[np.ndarray, "nodes 2"]
    waveform: Float[np.ndarray, "nodes wavelengths times"]
    height: Float[np.ndarray, " times"]
    precision: Float[np.ndarray, "2 2"]
    reach: float
    spacing: float


def _simulate_nodes(
    survey: Survey,
    scene: Scene,
    footprint: Float[np.ndarray, "2 2"],
    search_radius: float,
    key: PRNGKeyArray,
    max_orders: int,
    rtol: float,
) -> _Nodes:
    """Simulate narrow beams at all nodes that a footprint within the search radius may need."""
    sigma = float(np.sqrt(np.linalg.eigvalsh(footprint)[0]))
    spacing = _NODE_SPACING * sigma
    between = (1.0 - _NODE_COVARIANCE) * footprint
    reach = _REACH * float(np.sqrt(np.linalg.eigvalsh(between)[-1]))
    position = _grid_about(survey.position, search_radius + reach, spacing)
    narrow = dataclasses.replace(
        survey.lidar, divergence=survey.lidar.divergence * jnp.sqrt(jnp.asarray(_NODE_COVARIANCE))
    )
    if isinstance(scene.ground, Terrain) and scene.ground.sides == "open":
        low, high = _lit_rectangle(scene.ground, 2.0 * float(np.sqrt(_NODE_COVARIANCE * footprint.max())))
        position = position[np.all((position >= low) & (position <= high), axis=1)]
    if len(position) == 0:
        raise ValueError("position: all footprints within the search radius lie off the terrain")
    node_survey = Survey(narrow, position, survey.zenith[0], survey.azimuth[0])
    with warnings.catch_warnings():
        # Beams at the edge of the map are expected: shifts towards it are tried, too.
        warnings.simplefilter("ignore", OffMapWarning)
        waves = simulate_many(node_survey, scene, key=key, rtol=rtol, max_orders=max_orders)
    height = _heights_of(waves.time, np.cos(np.deg2rad(survey.zenith[0])))
    waveform = np.asarray(waves.reflectance, float)
    return _Nodes(position, waveform, height, np.linalg.inv(between), reach, spacing)


def _lit_rectangle(terrain: Terrain, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the south-west and north-east corners, m, of where beams of a radius return light.

    Beams must lie on the terrain, and are dark where it has no reflectance, as beyond a cloud.
    """
    # A plan wants terrain below two radii of a beam, and rounding leaves a little less.
    margin = 2.05 * radius
    low, spacing = np.asarray(terrain.origin, float), np.asarray(terrain.spacing, float)
    lowest, highest = low + margin, terrain.end - margin
    if terrain.pattern is None:
        return lowest, highest
    bright = np.argwhere(np.asarray(terrain.reflectance) > 0)
    if not len(bright):
        return lowest, highest
    first, last = low + spacing * bright.min(axis=0), low + spacing * bright.max(axis=0)
    return np.maximum(lowest, first - radius), np.minimum(highest, last + radius)


def _grid_about(
    centre: Float[np.ndarray, "shots 2"], radius: float, spacing: float
) -> Float[np.ndarray, "nodes 2"]:
    """Return the nodes of a grid, at multiples of the spacing, that lie within a radius of any centre."""
    half = int(np.ceil(radius / spacing)) + 1
    steps = np.arange(-half, half + 1)
    offsets = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    # Shot by shot, so that the memory does not grow with all pairs of shots and nodes.
    nodes: set[tuple[int, int]] = set()
    for place in centre:
        index = np.round(place / spacing).astype(int) + offsets
        is_near = np.hypot(*(index * spacing - place).T) <= radius
        nodes.update(map(tuple, index[is_near].tolist()))
    return np.array(sorted(nodes), float).reshape(-1, 2) * spacing


# -- model -------------------------------------------------------------------------------------------------


class _ShotData(NamedTuple):
    """A record divided by its noise, and the nodes within reach of its footprint.

    - `power`, `inverse_noise`: (wavelengths, samples); zero where a sample is left out.
    - `row`: (samples,) place of the samples among the times of nodes, in steps of these.
    - `nodes`: numbers of the nodes. - `place`: (2,) m, nominal position. - `weight`: of the drift, -1/2 to
      1/2.
    """

    power: np.ndarray
    inverse_noise: np.ndarray
    nodes: Int[np.ndarray, " nodes"]
    place: Float[np.ndarray, "2"]
    weight: float
    row: Float[np.ndarray, " samples"]


class _Fit(NamedTuple):
    """The fit at some parameters.

    - `objective`: chi-squared and the prior. - `information`: (parameters, parameters), J^T J and the prior.
    - `gradient`: (parameters,), J^T r and the prior's. - `scores`: (shots, parameters), s_i of the module.
    - `scale`: (shots,) factors a_i.
    """

    objective: float
    information: np.ndarray
    gradient: np.ndarray
    scores: np.ndarray
    scale: np.ndarray


class _SurveyModel:
    """Simulated waveforms of all shots as a function of the parameters.

    These are the shift (2), the drift (2) if it is fitted, and the height offset if it is.
    """

    def __init__(
        self,
        records: _Records,
        nodes: _Nodes,
        position: Float[np.ndarray, "shots 2"],
        search_radius: float,
        *,
        drift: bool,
        height_error: float,
    ):
        self.nodes, self.drift, self.height_error = nodes, drift, height_error
        self.position = position
        self.count = 2 + 2 * drift + (height_error > 0)
        weights = np.linspace(-0.5, 0.5, len(position))
        self.shots = [
            self._shot(records, shot, float(weights[shot]), search_radius) for shot in range(len(position))
        ]

    def _shot(self, records: _Records, shot: int, weight: float, search_radius: float) -> _ShotData:
        place, nodes = self.position[shot], self.nodes
        near = np.flatnonzero(np.hypot(*(nodes.position - place).T) <= search_radius + nodes.reach)
        if not near.size:
            raise ValueError(f"position: the footprints of shot {shot} all lie off the terrain")
        inverse_noise = 1.0 / records.noise[shot]
        step = (nodes.height[-1] - nodes.height[0]) / max(nodes.height.size - 1, 1)
        row = (records.height[shot] - nodes.height[0]) / step
        power = records.power[shot] * inverse_noise
        return _ShotData(power, inverse_noise, near, place, weight, row)

    def shift_of(self, shot: _ShotData, parameters: np.ndarray) -> np.ndarray:
        """Return the shift, m, of a shot."""
        return parameters[:2] + (shot.weight * parameters[2:4] if self.drift else 0.0)

    def _at_rows(self, row: np.ndarray, waveform: np.ndarray) -> np.ndarray:
        """Interpolate waveforms (..., times) of the nodes' times at rows (samples,); zero beyond them."""
        last = self.nodes.height.size - 1
        index = np.clip(np.floor(row).astype(int), 0, last - 1)
        low, high = waveform[..., index], waveform[..., index + 1]
        inside = (row >= 0) & (row <= last)
        return np.where(inside, low + (row - index) * (high - low), 0.0)

    def simulated(self, shot: _ShotData, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the waveform of a shot, (wavelengths, samples), and its derivatives, (parameters, ...)."""
        nodes = self.nodes
        offset = shot.place + self.shift_of(shot, parameters) - nodes.position[shot.nodes]
        slope = offset @ nodes.precision
        g = self._density(offset)
        # g and its derivatives east and north, of all nodes: one product with their waveforms.
        rows = np.stack([g, -slope[:, 0] * g, -slope[:, 1] * g])
        at_times = np.tensordot(rows, nodes.waveform[shot.nodes], 1)
        step = (nodes.height[-1] - nodes.height[0]) / (nodes.height.size - 1)
        # A record whose heights are too low by z shows at h the scene at h + z.
        row = shot.row + (parameters[-1] / step if self.height_error > 0 else 0.0)
        waveform, *by_position = self._at_rows(row, at_times)
        columns = list(by_position)
        if self.drift:
            columns += [shot.weight * column for column in by_position]
        if self.height_error > 0:
            columns.append(self._at_rows(row, np.gradient(at_times[0], axis=-1) / step))
        return waveform, np.stack(columns)

    def _density(self, offset: np.ndarray) -> np.ndarray:
        """Return g times the area of a node, at offsets (..., 2) in m."""
        norm = self.nodes.spacing**2 * np.sqrt(np.linalg.det(self.nodes.precision)) / (2.0 * np.pi)
        return norm * np.exp(-0.5 * np.einsum("...i,ij,...j", offset, self.nodes.precision, offset))

    def fit(self, parameters: np.ndarray) -> _Fit:
        """Evaluate the fit, with the factors at their least-squares values."""
        n = self.count
        information, gradient, objective = np.zeros((n, n)), np.zeros(n), 0.0
        scores, scales = [], []
        for shot in self.shots:
            waveform, columns = self.simulated(shot, parameters)
            model, columns = waveform * shot.inverse_noise, columns * shot.inverse_noise
            square = max(float(np.sum(model * model)), 1e-300)
            scale = max(float(np.sum(model * shot.power)) / square, 0.0)
            residual = shot.power - scale * model
            # Derivatives less their projection on the model, which the factor takes up (Kaufman 1975).
            columns = columns.reshape(n, -1)
            columns = scale * (columns - np.outer(columns @ model.ravel() / square, model.ravel()))
            score = columns @ residual.ravel()
            objective += float(np.sum(residual**2))
            information += columns @ columns.T
            gradient += score
            scores.append(score)
            scales.append(scale)
        if self.height_error > 0:
            precision = self.height_error**-2
            objective += precision * parameters[-1] ** 2
            information[-1, -1] += precision
            gradient[-1] -= precision * parameters[-1]
        return _Fit(objective, information, gradient, np.array(scores), np.array(scales))

    def chi_squared_of_shifts(self, shifts: Float[np.ndarray, "shifts 2"]) -> Float[np.ndarray, " shifts"]:
        """Return chi-squared for many shifts, without drift and height offset."""
        total = np.zeros(len(shifts))
        for shot in self.shots:
            offset = shot.place + shifts[:, None] - self.nodes.position[shot.nodes]
            at_times = np.tensordot(self._density(offset), self.nodes.waveform[shot.nodes], 1)
            model = (self._at_rows(shot.row, at_times) * shot.inverse_noise).reshape(len(shifts), -1)
            square = np.maximum(np.sum(model * model, axis=1), 1e-300)
            overlap = np.maximum(model @ shot.power.ravel(), 0.0)
            total += np.sum(shot.power**2) - overlap**2 / square
        return total


# -- fit ---------------------------------------------------------------------------------------------------


def _coarse_minima(model: _SurveyModel, search_radius: float, sigma: float) -> Iterator[np.ndarray]:
    """Yield the parameters of the lowest minima of chi-squared on a grid of shifts, the lowest first."""
    step = min(_COARSE_SPACING * sigma, 0.5 * search_radius)
    shifts = _grid_about(np.zeros((1, 2)), search_radius, step)
    chi_squared = model.chi_squared_of_shifts(shifts)
    remaining = np.ones(len(shifts), bool)
    for _ in range(_STARTS):
        if not remaining.any():
            return
        lowest = int(np.argmin(np.where(remaining, chi_squared, np.inf)))
        remaining &= np.hypot(*(shifts - shifts[lowest]).T) > _APART * step
        yield np.concatenate([shifts[lowest], np.zeros(model.count - 2)])


class _Descent(NamedTuple):
    """The end of a descent: parameters, the fit there, and whether it converged."""

    parameters: np.ndarray
    fit: _Fit
    converged: bool


def _descend(model: _SurveyModel, parameters: np.ndarray) -> _Descent:
    """Minimise the objective by Gauss-Newton steps, damped by Levenberg and Marquardt."""
    fit, damping = model.fit(parameters), 1e-3
    for _ in range(_MAX_STEPS):
        diagonal = np.diag(fit.information) + 1e-30
        step = np.linalg.solve(fit.information + damping * np.diag(diagonal), fit.gradient)
        trial = model.fit(parameters + step)
        if trial.objective <= fit.objective:
            parameters, fit, damping = parameters + step, trial, 0.1 * damping
            if np.all(np.abs(step) < np.maximum(_SMALL_STEP / np.sqrt(diagonal), _SMALLEST_STEP)):
                return _Descent(parameters, fit, True)
        else:
            damping *= 10.0
    return _Descent(parameters, fit, False)


def _robust_covariance(information: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """Return the covariance by the scatter of the records' scores, and nowhere less than by their noise.

    With few records the scatter is often too small by chance. In coordinates in which the information is the
    unit matrix, its eigenvalues would be one if there were only the stated noise; smaller ones are raised.
    """
    shots, n = scores.shape
    eigenvalues, axes = np.linalg.eigh(information)
    root = axes / np.sqrt(np.maximum(eigenvalues, _LEAST_INFORMATION))
    scatter = shots / (shots - n) * root.T @ scores.T @ scores @ root
    ratios, directions = np.linalg.eigh(scatter)
    root = root @ directions
    return root @ np.diag(np.maximum(ratios, 1.0)) @ root.T


def _geolocation(
    model: _SurveyModel, descent: _Descent, search_radius: float, records: object
) -> Geolocation:
    """Return the result of the best descent, with the covariance of its parameters."""
    parameters, fit, converged = descent
    shots, n = fit.scores.shape
    samples = sum(int(np.sum(shot.inverse_noise > 0)) for shot in model.shots)
    chi_squared = fit.objective / max(samples - shots - n, 1)
    # A scene that looks the same everywhere tells nothing: the floor keeps its covariance finite, and huge.
    eigenvalues, axes = np.linalg.eigh(fit.information)
    inverse = axes @ np.diag(1.0 / np.maximum(eigenvalues, _LEAST_INFORMATION)) @ axes.T
    is_determined = eigenvalues[0] * search_radius**2 > 1.0
    if is_determined and shots >= max(_MIN_CLUSTERS, 2 * n):
        covariance = _robust_covariance(fit.information, fit.scores)
    else:
        covariance = max(chi_squared, 1.0) * inverse
    status = "converged" if converged else f"no convergence in {_MAX_STEPS} steps"
    if np.hypot(*parameters[:2]) > search_radius:
        status = "the shift lies beyond the search radius"
    if not is_determined:
        status = "the records do not determine the shift"
    shifts = np.stack([model.shift_of(shot, parameters) for shot in model.shots])
    fitted = np.stack([a * model.simulated(shot, parameters)[0] for a, shot in zip(fit.scale, model.shots)])
    return Geolocation(
        shift=parameters[:2],
        covariance=covariance[:2, :2],
        drift=parameters[2:4] if model.drift else None,
        drift_covariance=covariance[2:4, 2:4] if model.drift else None,
        height_offset=float(parameters[-1]) if model.height_error > 0 else 0.0,
        position=model.position + shifts,
        scale=fit.scale,
        fitted=fitted if isinstance(records, Waveforms) else fitted[:, 0],
        chi_squared=chi_squared,
        status=status,
    )
