"""Geolocation: the horizontal shift of a survey, from its records and a scene that is known.

**Model.** Beams are Gaussian and parallel. The waveform of a footprint is linear in its irradiance, and a
Gaussian of covariance S is the convolution of one of covariance S_n with one of covariance S - S_n. So

    W(p) = sum over nodes n of  d^2 g(p - x_n) W_n,    g = normal density of covariance S - S_n,

where W_n are the waveforms of narrow beams at the nodes x_n of a grid with the spacing d. The sum over nodes
stands for an integral; with the beams chosen here its error is 2e-4 of the waveform or less (the terms of
Poisson's summation formula beyond the first). The nodes are simulated once, with all that the tracer knows.
Derivatives with respect to the position p are those of g, exact for this sum.

**Fit.** Record i is a_i (b P + R)(p_i + D_i theta), its misfit and noise. P is the first-order light from
plants and R all other, a_i a free factor of the record, b one of the survey (the reflectance of plants over
that of the ground, relative to the scene's; its logarithm has a normal prior), theta the shift, and D_i = 1;
with drift, the shift varies linearly along the survey. The factors a_i are eliminated (variable projection,
Golub and Pereyra 1973).

**Misfit.** A scene does not explain records to their noise: columns of the canopy are brighter or darker than
it says. This changes whole layers of a record at once. The misfit of record i is therefore a_i W_i(h) c
f_i(h), where f_i is a Gaussian process of the height h with unit variance and the correlation exp(-(h - h')^2
/ (2 l^2)), independent from record to record. In

    C_i = diag(noise^2) + c^2 a_i^2 W_i(h) W_i(h') exp(-(h - h')^2 / (2 l^2))

the relative misfit c and the correlation length l, common to all records, have their most likely values, by
the restricted likelihood. As sums of Gaussians have Gaussian correlation, the second term has low rank, and
records are whitened by the eigenvectors of a small matrix.

1. Chi-squared of noise alone is evaluated on a grid of shifts.
2. Gauss-Newton steps, damped by Levenberg and Marquardt, start from its lowest minima.
3. From each end, c and l are found, and the steps go on with the C_i; so twice. The most likely end is the
   result.

**Covariance.** With whitened residuals r_i and derivatives J_i, scores s_i = J_i^T r_i and the information F,
the sum of F_i = J_i^T J_i and of the priors, leaving record i out changes the parameters by d_i = (F -
F_i)^-1 s_i to first order. The covariance is that of the jackknife over n records,

    (n - 1) / n sum of d_i d_i^T    (CR3; Bell and McCaffrey 2002),

but in no direction less than F^-1, which it would be if the misfit were as modelled. It contains noise, and
every error of the scene that is independent from record to record, whatever its shape. It does not contain
errors that all records share, such as a cloud that is itself displaced. Where records are fewer than
`_MIN_CLUSTERS`, or than twice the parameters, it is F^-1, times the chi-squared of the whitened residuals
over its degrees of freedom if that exceeds one.

**Source:** Golub and Pereyra (1973), SIAM J. Numer. Anal. 10, 413; Rasmussen and Williams (2006), Gaussian
Processes for Machine Learning, chapters 2 and 5; Patterson and Thompson (1971), Biometrika 58, 545
(restricted likelihood); Bell and McCaffrey (2002), Survey Methodology 28, 169; for GEDI's footprints over
airborne clouds, Hancock et al. (2019), Earth Space Sci. 6, 294.
"""

import dataclasses
import warnings
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float, Int, PRNGKeyArray

from inversion.fit.data import as_positive_noise
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
# Materials whose reflectance is the plants'.
_PLANTS = ("leaf", "bark")
# Standard deviations of g within which nodes count: 3e-4 of its integral lie beyond.
_REACH = 4.0
# Distance of the shifts that are tried first, over the standard deviation of the footprint: the minimum of
# chi-squared is about as wide as the footprint.
_COARSE_SPACING = 0.35
# Minima from which Gauss-Newton steps start, and how many coarse steps lie between them.
_STARTS, _START_DISTANCE = 3, 3.0
# Most trial steps from a start; the largest step, in standard errors and in m, that counts as converged.
_MAX_STEPS, _SMALL_STEP, _SMALLEST_STEP = 40, 0.01, 1e-4
# Fewest records for which the covariance is that of the jackknife over them.
_MIN_CLUSTERS = 6
# Squares of the relative misfit, and correlation lengths, m, whose likelihoods are compared. One step of the
# first, a third, is less than 8 records tell; lengths a factor of 1.4 apart differ little, too.
_MISFIT_SQUARES = np.concatenate([[0.0], np.logspace(-4.0, 0.5, 28)])
_MISFIT_LENGTHS = 0.5 * 2.0 ** (0.5 * np.arange(9))
# Number of estimates of the misfit, each followed by a fit; and the signal, over its maximum, below which
# samples have no misfit.
_MISFIT_ROUNDS, _LEAST_SIGNAL = 2, 1e-3
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
    - `chi_squared`: of a fit with the stated noise alone and the priors, with factors of its own, over its
      degrees of freedom. One if there is only noise.
    - `status`: "converged", or the reason why the result is not to be used.
    - `reflectance_ratio`: factor by which plants are brighter, relative to the ground, than in the scene, in
      the first order and at all wavelengths; 1 where it was not fitted.
    - `misfit`: what the scene does not explain of a record, one standard deviation over the fitted waveform.
    - `misfit_length`: m of height, over which the misfit is correlated, from 0.5 to 8; without meaning where
      `misfit` is 0.

    **Example:** 95 % limits of the shift.

    >>> import inversion, numpy as np
    >>> from inversion.scene.geolocation import Geolocation
    >>> place = Geolocation(
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
    reflectance_ratio: float = 1.0
    misfit: float = 0.0
    misfit_length: float = 0.0


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
    ratio_error: float = 0.5,
    max_orders: int = 1,
    rtol: float = 0.1,
) -> Geolocation:
    """Find where the footprints of a survey fell, over a canopy and terrain that are known.

    All records are shifted together. The shift is searched within a radius, then refined by Gauss-Newton
    steps. Waveforms are compared up to a factor each, so that the gain of a record need not be known, and up
    to the ratio of the reflectance of plants to that of the ground, one for all. What else the scene does not
    explain counts as a relative error of the waveform, correlated over height, whose size is found from the
    records. Beams must be Gaussian and have one direction, as GEDI's along an orbit.

    Standard errors contain noise and those errors of the scene that are independent from record to record,
    not those that all records share. With fewer than 6 records, or than twice the unknowns, they take errors
    of the scene to be as modelled.

    Over canopies from two airborne clouds, with 36 and 35 footprints by the GEDI simulator and a ratio of
    signal to noise of 20, the shift is within 0.5 m of the truth on each axis. Over random subsets of 8
    footprints, two standard errors hold in some nine of ten. If noise alone is drawn anew, the error from
    the scene is the same in every draw, and two standard errors may hold in all draws, or in half of them.

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
    - `ratio_error`: standard deviation of the natural logarithm of the ratio of the reflectance of plants to
      that of the ground, about the scene's, 0 or more. It is fitted unless it is 0. Default 0.5.
    - `max_orders`: follow light for this many scatterings, at least 1. Records of bright canopies call for
      more than one: light scattered several times returns from below the ground, where one order has
      nothing. Default 1.
    - `rtol`: relative error of the simulation at each node, in (0, 1); that of a footprint, a sum over some
      thirty nodes, is smaller. Default 0.1.

    **Returns:** a `Geolocation`.

    **Raises:** ValueError for inadmissible arguments, shots with more than one direction or altitude, or that
    are placed by their sensors, a lidar with a top-hat beam, without divergence or with a field of view, and
    positions of which all footprints within the radius lie off the terrain; TypeError for arguments of the
    wrong type.

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
    check_number("ratio_error", ratio_error, 0.0)
    footprint = _footprint_covariance(survey)
    observed = _observed_records(records, height, noise, survey)
    nodes = _simulate_nodes(
        survey, scene, footprint, float(search_radius), key, check_integer("max_orders", max_orders), rtol
    )
    radius = float(search_radius)
    model = _SurveyModel(
        observed,
        nodes,
        survey.position,
        radius,
        drift=bool(drift),
        height_error=float(height_error),
        ratio_error=float(ratio_error),
    )
    ends = [
        _descend_with_misfit(model, start)
        for start in _coarse_minima(model, radius, float(np.sqrt(footprint[0, 0])))
    ]
    return _geolocation(min(ends, key=lambda end: end.fit.deviance), model, radius, records)


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
        heights = as_numpy(height, "height")
        if heights.shape not in (power.shape, power.shape[1:]):
            raise ValueError(
                f"height has shape {heights.shape}; admissible is that of records, {power.shape}, or of one"
            )
        heights = np.broadcast_to(heights, power.shape)
        power = power[:, None]
    if len(power) != len(survey) or len(power) < 2:
        raise ValueError(
            f"records have {len(power)} shots and survey {len(survey)}; admissible are as many, at least 2"
        )
    check_numbers("noise", noise)
    shape = power.shape if isinstance(records, Waveforms) else power[:, 0].shape
    sigma = as_positive_noise(noise, shape).reshape(power.shape)
    if not np.all(np.isfinite(sigma).any(axis=2)):
        raise ValueError("noise is infinite in all samples of a record; admissible are finite ones in each")
    return _Records(power, sigma, heights)


def _heights_of(time: np.ndarray, cosine: np.ndarray | float) -> np.ndarray:
    """Return the heights, m, from which light of the first order arrives at the times, ns."""
    return -0.5 * SPEED_OF_LIGHT * np.asarray(time, float) * cosine


# -- nodes -------------------------------------------------------------------------------------------------


def _footprint_covariance(survey: Survey) -> Float[np.ndarray, "2 2"]:
    """Return the covariance, m2, of the irradiance on the reference plane. **Raises:** as `geolocate`."""
    lidar = survey.lidar
    if survey.altitude is None or np.ptp(survey.altitude) > 0:
        placed = "by their sensors" if survey.altitude is None else "at several altitudes"
        raise ValueError(f"survey: its shots are placed {placed}; admissible is one altitude of all shots")
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
    if lidar.level_divergence is not None:
        raise ValueError("survey.lidar.level_divergence is given; admissible is None, a round footprint")
    check_number("survey.lidar.divergence", lidar.divergence, 0.0, low_open=True)
    # The radius of a beam, at 1/e^2 of the irradiance, is two standard deviations.
    sigma = 0.5 * float(survey.footprint_radius[0])
    zenith, azimuth = np.deg2rad(survey.zenith[0]), np.deg2rad(survey.azimuth[0])
    along = np.array([np.sin(azimuth), np.cos(azimuth)])
    # On the plane the footprint of an oblique beam is longer along its azimuth.
    return sigma**2 * (np.eye(2) + (1.0 / np.cos(zenith) ** 2 - 1.0) * np.outer(along, along))


class _Nodes(NamedTuple):
    """Waveforms of narrow beams at the nodes of a grid.

    - `position`: (nodes, 2) m. - `waveform`: (nodes, 2, wavelengths, times), light from plants and all other.
    - `height`: (times,) m, decreasing.
    - `precision`: (2, 2) 1/m2, inverse covariance of g, the density that makes a footprint of the nodes.
    - `reach`: m, distance from a footprint within which nodes count. - `spacing`: of the grid, m.
    """

    position: Float[np.ndarray, "nodes 2"]
    waveform: Float[np.ndarray, "nodes 2 wavelengths times"]
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
    assert survey.altitude is not None
    node_survey = Survey(narrow, position, survey.zenith[0], survey.azimuth[0], survey.altitude[0])
    with warnings.catch_warnings():
        # Beams at the edge of the map are expected: shifts towards it are tried, too.
        warnings.simplefilter("ignore", OffMapWarning)
        waves = simulate_many(
            node_survey, scene, key=key, rtol=rtol, max_orders=max_orders, keep=("reflectance", "components")
        )
    height = _heights_of(waves.time, np.cos(np.deg2rad(survey.zenith[0])))
    total = np.asarray(waves.reflectance, float)
    plants = sum(
        (np.asarray(waves.components[name], float) for name in _PLANTS if name in waves.components),
        start=np.zeros_like(total),
    )
    waveform = np.stack([plants, total - plants], axis=1)
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


class _Whitener(NamedTuple):
    """The inverse square root of I + V^T diag(variance) V, the covariance of a record over that of its noise.

    - `vectors`: V, (rank, significant samples), orthonormal rows. - `variance`: (rank,).
    - `significant`: (significant samples,) their numbers among the samples of all wavelengths; V is zero
      elsewhere.
    """

    vectors: np.ndarray
    variance: np.ndarray
    significant: np.ndarray

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        """Whiten rows (..., wavelengths x samples)."""
        change = 1.0 / np.sqrt(1.0 + self.variance) - 1.0
        whitened = rows.copy()
        whitened[..., self.significant] += (
            (rows[..., self.significant] @ self.vectors.T) * change
        ) @ self.vectors
        return whitened


class _Misfit(NamedTuple):
    """What the scene does not explain: its relative size, its correlation length in m, and whiteners."""

    relative: float
    length: float
    whiteners: list[_Whitener]


class _Fit(NamedTuple):
    """The fit at some parameters, of whitened residuals.

    - `objective`: chi-squared and the priors. - `information`: (parameters, parameters), J^T J and the
      priors.
    - `gradient`: (parameters,), J^T r and the priors'. - `scores`: (shots, parameters), s_i of the module.
    - `shot_information`: (shots, parameters, parameters), F_i. - `scale`: (shots,) factors a_i.
    - `deviance`: -2 ln of the restricted likelihood, and the priors.
    """

    objective: float
    information: np.ndarray
    gradient: np.ndarray
    scores: np.ndarray
    shot_information: np.ndarray
    scale: np.ndarray
    deviance: float


class _SurveyModel:
    """Simulated waveforms of all shots as a function of the parameters.

    These are the shift (2), the drift (2) if it is fitted, and the logarithm of the ratio of reflectances and
    the height offset if they are.
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
        ratio_error: float = 0.0,
    ):
        self.nodes, self.drift, self.height_error = nodes, drift, height_error
        self.position = position
        self.n_parameters = 2 + 2 * drift + (ratio_error > 0) + (height_error > 0)
        # Place of the logarithm of the ratio among the parameters; the height offset is the last one.
        self.ratio_index = 2 + 2 * drift if ratio_error > 0 else None
        self.prior_precision = np.zeros(self.n_parameters)
        if self.ratio_index is not None:
            self.prior_precision[self.ratio_index] = ratio_error**-2
        if height_error > 0:
            self.prior_precision[-1] = height_error**-2
        # All light of the nodes: that of the scene's own ratio.
        self.total = nodes.waveform.sum(axis=1)
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

    def ratio(self, parameters: np.ndarray) -> float:
        """Return the factor by which plants are brighter than in the scene."""
        return 1.0 if self.ratio_index is None else float(np.exp(parameters[self.ratio_index]))

    def simulated(self, shot: _ShotData, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the waveform of a shot, (wavelengths, samples), and its derivatives, (parameters, ...)."""
        nodes = self.nodes
        offset = shot.place + self.shift_of(shot, parameters) - nodes.position[shot.nodes]
        slope = offset @ nodes.precision
        g = self._density(offset)
        # g and its derivatives east and north, of all nodes: one product with their waveforms.
        rows = np.stack([g, -slope[:, 0] * g, -slope[:, 1] * g])
        if self.ratio_index is None:
            at_times, plants = np.tensordot(rows, self.total[shot.nodes], 1), None
        else:
            by_material = np.tensordot(rows, nodes.waveform[shot.nodes], 1)
            plants = self.ratio(parameters) * by_material[0, 0]
            at_times = self.ratio(parameters) * by_material[:, 0] + by_material[:, 1]
        step = (nodes.height[-1] - nodes.height[0]) / (nodes.height.size - 1)
        # A record whose heights are too low by z shows at h the scene at h + z.
        row = shot.row + (parameters[-1] / step if self.height_error > 0 else 0.0)
        waveform, *by_position = self._at_rows(row, at_times)
        columns = list(by_position)
        if self.drift:
            columns += [shot.weight * column for column in by_position]
        if plants is not None:
            columns.append(self._at_rows(row, plants))
        if self.height_error > 0:
            columns.append(self._at_rows(row, np.gradient(at_times[0], axis=-1) / step))
        return waveform, np.stack(columns)

    def _density(self, offset: np.ndarray) -> np.ndarray:
        """Return g times the area of a node, at offsets (..., 2) in m."""
        norm = self.nodes.spacing**2 * np.sqrt(np.linalg.det(self.nodes.precision)) / (2.0 * np.pi)
        return norm * np.exp(-0.5 * np.einsum("...i,ij,...j", offset, self.nodes.precision, offset))

    def fit(self, parameters: np.ndarray, misfit: _Misfit | None = None) -> _Fit:
        """Evaluate the fit, with the factors at their least-squares values; None: there is noise alone."""
        n = self.n_parameters
        information, gradient = np.diag(self.prior_precision), -self.prior_precision * parameters
        objective = float(self.prior_precision @ parameters**2)
        determinant, scores, shot_information, scales = 0.0, [], [], []
        for number, shot in enumerate(self.shots):
            waveform, columns = self.simulated(shot, parameters)
            model, columns = waveform * shot.inverse_noise, columns * shot.inverse_noise
            model, power, columns = model.ravel(), shot.power.ravel(), columns.reshape(n, -1)
            noise_square = max(float(model @ model), 1e-300)
            if misfit is not None:
                whitener = misfit.whiteners[number]
                model, power, *columns = whitener(np.vstack([model, power, columns]))
                columns = np.array(columns)
                determinant += float(np.sum(np.log1p(whitener.variance)))
            square = max(float(model @ model), 1e-300)
            # What the factor adds to the restricted likelihood, for a prior that scales with the model.
            determinant += np.log(square / noise_square)
            scale = max(float(model @ power) / square, 0.0)
            residual = power - scale * model
            # Derivatives less their projection on the model, which the factor takes up (Kaufman 1975).
            columns = scale * (columns - np.outer(columns @ model / square, model))
            scores.append(columns @ residual)
            shot_information.append(columns @ columns.T)
            objective += float(residual @ residual)
            gradient = gradient + scores[-1]
            information = information + shot_information[-1]
            scales.append(scale)
        return _Fit(
            objective,
            information,
            gradient,
            np.array(scores),
            np.array(shot_information),
            np.array(scales),
            objective + determinant,
        )

    def misfit(self, parameters: np.ndarray, scale: Float[np.ndarray, " shots"]) -> _Misfit:
        """Find the most likely relative misfit and correlation length, about waveforms times `scale`.

        The restricted likelihood of each record is a sum over the eigenvectors of its misfit, so that all
        sizes of the misfit are compared at once.
        """
        models = [a * self.simulated(shot, parameters)[0] for a, shot in zip(scale, self.shots)]
        lowest, best = np.inf, (0.0, _MISFIT_LENGTHS[0])
        for length in _MISFIT_LENGTHS:
            deviance = np.zeros(len(_MISFIT_SQUARES))
            for shot, model in zip(self.shots, models):
                deviance += _misfit_deviance(shot, model, *self._misfit_rows(shot, model, length))
            index = int(np.argmin(deviance))
            if deviance[index] < lowest:
                lowest, best = deviance[index], (float(np.sqrt(_MISFIT_SQUARES[index])), float(length))
        relative, length = best
        whiteners = []
        for shot, model in zip(self.shots, models):
            rows, significant = self._misfit_rows(shot, model, length)
            vectors, variance = _principal_axes(rows)
            whiteners.append(_Whitener(vectors, relative**2 * variance, significant))
        return _Misfit(relative, length, whiteners)

    def _misfit_rows(
        self, shot: _ShotData, model: np.ndarray, length: float
    ) -> tuple[Float[np.ndarray, "rank significant"], Int[np.ndarray, " significant"]]:
        """Return B, whose B^T B is the covariance of a misfit of unit size, and the significant samples.

        It is over that of the noise. A Gaussian process with the correlation length l is a sum of
        independent Gaussians of the width l / sqrt(2). With the distance l their variance is even to 1.4 %.
        """
        total = model.sum(axis=0)
        (samples,) = np.nonzero(total > _LEAST_SIGNAL * max(float(total.max()), 1e-300))
        wavelengths = len(model)
        significant = (np.arange(wavelengths)[:, None] * total.size + samples).ravel()
        if not samples.size:
            return np.zeros((0, 0)), significant
        step = (self.nodes.height[-1] - self.nodes.height[0]) / (self.nodes.height.size - 1)
        height = self.nodes.height[0] + step * shot.row[samples]
        knots = np.arange(height.min() - length, height.max() + 2.0 * length, length)
        shapes = (2.0 / np.pi) ** 0.25 * np.exp(-(((height - knots[:, None]) / length) ** 2))
        # Wavelengths have a misfit each.
        weighted = (model * shot.inverse_noise)[:, samples]
        rows = np.einsum("ks,ws,wv->kwvs", shapes, weighted, np.eye(wavelengths))
        return rows.reshape(-1, significant.size), significant

    def chi_squared_of_shifts(self, shifts: Float[np.ndarray, "shifts 2"]) -> Float[np.ndarray, " shifts"]:
        """Return chi-squared for many shifts, without drift and height offset."""
        total = np.zeros(len(shifts))
        for shot in self.shots:
            offset = shot.place + shifts[:, None] - self.nodes.position[shot.nodes]
            at_times = np.tensordot(self._density(offset), self.total[shot.nodes], 1)
            model = (self._at_rows(shot.row, at_times) * shot.inverse_noise).reshape(len(shifts), -1)
            square = np.maximum(np.sum(model * model, axis=1), 1e-300)
            overlap = np.maximum(model @ shot.power.ravel(), 0.0)
            total += np.sum(shot.power**2) - overlap**2 / square
        return total


def _principal_axes(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the eigenvectors, as rows, and the eigenvalues above rounding of B^T B, of rows B."""
    variance, axes = np.linalg.eigh(rows @ rows.T)
    positive = variance > 1e-9 * max(float(variance.max(initial=0.0)), 1e-9)
    return (axes[:, positive].T @ rows) / np.sqrt(variance[positive, None]), variance[positive]


def _misfit_deviance(
    shot: _ShotData,
    model: np.ndarray,
    rows: Float[np.ndarray, "rank significant"],
    significant: Int[np.ndarray, " significant"],
) -> Float[np.ndarray, " sizes"]:
    """Return -2 ln of the restricted likelihood of a record, for all sizes of the misfit with rows B."""
    vectors, variance = _principal_axes(rows)
    expected, power = (model * shot.inverse_noise).ravel(), shot.power.ravel()
    variances = _MISFIT_SQUARES[:, None] * variance
    # Products with the inverse of the covariance differ from plain ones by what lies along the eigenvectors.
    change = 1.0 / (1.0 + variances) - 1.0
    along, power_along = vectors @ expected[significant], vectors @ power[significant]
    plain_square = max(float(expected @ expected), 1e-300)
    square = np.maximum(plain_square + change @ along**2, 1e-12 * plain_square)
    overlap = np.maximum(expected @ power + change @ (along * power_along), 0.0)
    chi_squared = power @ power + change @ power_along**2 - overlap**2 / square
    return chi_squared + np.log1p(variances).sum(axis=1) + np.log(square / plain_square)


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
        remaining &= np.hypot(*(shifts - shifts[lowest]).T) > _START_DISTANCE * step
        yield np.concatenate([shifts[lowest], np.zeros(model.n_parameters - 2)])


class _Descent(NamedTuple):
    """The end of a descent: parameters, the fit and the misfit there, and whether it converged."""

    parameters: np.ndarray
    fit: _Fit
    misfit: _Misfit | None
    converged: bool


def _descend_with_misfit(model: _SurveyModel, parameters: np.ndarray) -> _Descent:
    """Descend with noise alone, then with the misfit that is most likely at the end, and so again."""
    end = _descend(model, parameters)
    for _ in range(_MISFIT_ROUNDS):
        end = _descend(model, end.parameters, model.misfit(end.parameters, end.fit.scale))
    return end


def _descend(model: _SurveyModel, parameters: np.ndarray, misfit: _Misfit | None = None) -> _Descent:
    """Minimise the objective by Gauss-Newton steps, damped by Levenberg and Marquardt."""
    fit, damping = model.fit(parameters, misfit), 1e-3
    for _ in range(_MAX_STEPS):
        diagonal = np.diag(fit.information) + 1e-30
        step = np.linalg.solve(fit.information + damping * np.diag(diagonal), fit.gradient)
        trial = model.fit(parameters + step, misfit)
        if trial.objective <= fit.objective:
            parameters, fit, damping = parameters + step, trial, 0.1 * damping
            if np.all(np.abs(step) < np.maximum(_SMALL_STEP / np.sqrt(diagonal), _SMALLEST_STEP)):
                return _Descent(parameters, fit, misfit, True)
        else:
            damping *= 10.0
    return _Descent(parameters, fit, misfit, False)


def _jackknife_covariance(fit: _Fit) -> np.ndarray:
    """Return the covariance by the jackknife over records, and nowhere less than by the information.

    With few records the first is often too small by chance. In coordinates in which the information is the
    unit matrix, its eigenvalues would be one if noise and misfit were as modelled; smaller ones are raised.
    """
    shots, n = fit.scores.shape
    # Without the only record that tells of a parameter nothing remains: the floor keeps the change finite.
    remaining = fit.information - fit.shot_information + _LEAST_INFORMATION * np.eye(n)
    changes = np.linalg.solve(remaining, fit.scores[:, :, None])[:, :, 0]
    jackknife = (shots - 1) / shots * changes.T @ changes
    eigenvalues, axes = np.linalg.eigh(fit.information)
    spread = np.sqrt(np.maximum(eigenvalues, _LEAST_INFORMATION))
    ratios, directions = np.linalg.eigh((axes * spread).T @ jackknife @ (axes * spread))
    root = (axes / spread) @ directions
    return root @ np.diag(np.maximum(ratios, 1.0)) @ root.T


def _geolocation(
    descent: _Descent, model: _SurveyModel, search_radius: float, records: object
) -> Geolocation:
    """Return the result of the best descent, with the covariance of its parameters."""
    parameters, fit, misfit, converged = descent
    shots, n = fit.scores.shape
    samples = sum(int(np.sum(shot.inverse_noise > 0)) for shot in model.shots)
    freedom = max(samples - shots - n, 1)
    # A scene that looks the same everywhere tells nothing: the floor keeps its covariance finite, and huge.
    eigenvalues, axes = np.linalg.eigh(fit.information)
    inverse = axes @ np.diag(1.0 / np.maximum(eigenvalues, _LEAST_INFORMATION)) @ axes.T
    shifts_end = 4 if model.drift else 2
    is_determined = np.linalg.eigvalsh(inverse[:shifts_end, :shifts_end])[-1] < search_radius**2
    if is_determined and shots >= max(_MIN_CLUSTERS, 2 * n):
        covariance = _jackknife_covariance(fit)
    else:
        covariance = max(fit.objective / freedom, 1.0) * inverse
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
        chi_squared=model.fit(parameters).objective / freedom,
        status=status,
        reflectance_ratio=model.ratio(parameters),
        misfit=0.0 if misfit is None else misfit.relative,
        misfit_length=0.0 if misfit is None else misfit.length,
    )
