"""Fits of GEDI shots: a layered canopy over sloping ground, with each shot's own transmit pulse.

**Scene.** A horizontally uniform canopy of ten layers of equal thickness, from 1 m above the ground to the
top (`inversion.scene.layered_canopy`). The unknowns are the elevations of ground and top, the slope (which
stands for all that widens the ground's echo), the plant area density of every layer, and one factor for the
receiver's unknown gain. Reflectances are fixed, in the ratio of the level-2B algorithm, rho_v / rho_g = 0.6 /
0.4. First order only, with the hot spot.

**Ground.** Plants within a pulse's length of the ground merge with its echo, and waveforms alone do not
separate the two. So the ground starts at its matched mode (`inversion.find_ground`), with a prior of 0.1 m
about it. If GEDI's own rule gives another ground, the fit starts from both, and the better one counts.

**Noise.** That of the samples, correlated over the receiver's smoothing, and an error of the model in
proportion to the signal. Samples in the receiver's tail, which the transmitted pulse does not have, are not
fitted.

**Errors** are the robust standard errors of the fit (`inversion.fit.uncertainty`), with nothing added but to
that of the top, as `LayeredCanopy.estimates` does. They contain neither the fixed reflectances nor what
relief within the footprint does to the ground's echo.
"""

import dataclasses
import os
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

import jaxlidar as jl
from inversion.fit.problem import Problem
from inversion.fit.quality import Verdict, judge_fit
from inversion.fit.result import Retrieval
from inversion.fit.retrieval_many import retrieve_many
from inversion.fit.unknowns import Unknown
from inversion.metrics.gedi import RECEIVER_SMOOTHING, judge_shot
from inversion.scene.layered_canopy import LAYERS, LayeredCanopy
from jaxlidar.progress import ProgressOption, shows_progress

CANOPY = LayeredCanopy(clearance=1.0)
# Samples above and below the reference: of 1 ns, or 0.15 m.
_ABOVE, _BELOW = 280, 80
# Noise is correlated over five neighbouring samples: together they have the information of one.
_CORRELATED = 5
# The receiver has a tail that the transmitted pulse does not show: samples further than this below the
# ground's mode are not fitted.
_TAIL = 14
# Relative error of the model: the pulse is itself a record, and no canopy is uniform.
_MODEL_ERROR = 0.01
# Fewest samples above the fitted ones from which mean and noise are estimated.
_MIN_QUIET = 50
# Samples above this many standard deviations of the noise are signal. The echo of the top begins some metres
# above the top. Heights that fits start from, m.
_SIGNAL_SIGMAS, _TOP_ECHO, _START_HEIGHTS = 3.0, 2.0, (2.0, 38.0)
# Two estimates of the ground further apart than this are both tried, m. If the reduced chi-squared of the two
# fits differ by less than a factor, the ground is ambiguous.
_AMBIGUOUS_GROUND, _CHI2_FACTOR = 0.5, 2.0
# A fitted ground further than this from the mode that it started from is doubtful, m.
_DOUBTFUL_DISTANCE = 0.5
# Bounds of the gain: fractions of the signal over an apparent reflectance.
_GAINS = (0.0, 20.0)

# Columns of a fit: unit and description.
ESTIMATES = {
    "ground": ("m", "elevation of the ground"),
    "ground_stderr": ("m", "standard error of the elevation of the ground"),
    "canopy_top": ("m", "elevation of the canopy's top"),
    "canopy_top_stderr": ("m", "standard error of the elevation of the canopy's top"),
    "slope": ("degrees", "slope that widens the ground's echo"),
    "slope_stderr": ("degrees", "standard error of the slope"),
    "pai": ("m2 m-2", "plant area index of the layers"),
    "pai_stderr": ("m2 m-2", "standard error of the plant area index of the layers"),
    "reduced_chi2": ("", "reduced chi-squared"),
}
# Columns of its layers, (shots, LAYERS).
LAYER_ESTIMATES = {
    "plant_area_density": ("m2 m-3", "plant area density of layers of equal thickness, from below"),
    "plant_area_density_stderr": ("m2 m-3", "standard error of the plant area density of layers"),
}


def lidar_of(pulse: Any) -> jl.Lidar:
    """Return GEDI with the transmitted pulse of a shot."""
    return dataclasses.replace(jl.instrument("GEDI coverage"), pulse=pulse, jitter=RECEIVER_SMOOTHING)


def canopy_unknowns() -> list[Unknown]:
    """Return the unknowns of a fit: heights in m, the slope in degrees, log densities of the layers.

    Not a constant: its arrays would start JAX when the package is imported.
    """
    return [
        Unknown(name="ground", bounds=(-1.0, 1.0), prior=(0.0, 0.1), start=0.0, apply=CANOPY.put_ground),
        Unknown(name="canopy height", bounds=(1.5, 45.0), start=8.0, apply=CANOPY.put_height),
        Unknown("ground.slope", bounds=(0.0, 30.0), name="slope", prior=(0.0, 15.0)),
        Unknown(
            name="log density",
            bounds=(np.log(1e-5), np.log(3.0)),
            prior=(np.log(0.01), 1.5),
            start=np.full(LAYERS, np.log(0.02)),
            apply=CANOPY.put_density,
        ),
    ]


class PreparedShot:
    """A shot about an estimate of the ground: fraction of the signal in each sample, and its noise.

    - `ground`: the estimate, m. `reference`: elevation of the sample nearest to it, which is height zero of
      the fit.
    - `elevation`, `signal`, `noise`: of the samples, from the top down; noise is infinite for samples that
      are not fitted.
    - `total`: sum of the signal in counts, by which signal and noise are divided.
    - `height`: of the canopy over the ground, m, to start from.

    **Raises:** ValueError for a record without signal about the ground.
    """

    def __init__(self, shot: Any, ground: float):
        self.shot, self.ground = shot, float(ground)
        middle = int(np.argmin(np.abs(shot.elevation - ground)))
        lag = np.arange(-_ABOVE, _BELOW + 1)
        number = middle + lag
        inside = (number >= 0) & (number < shot.waveform.size)
        step = (shot.elevation[0] - shot.elevation[-1]) / (shot.waveform.size - 1)
        self.reference = float(shot.elevation[middle])
        self.elevation = self.reference - step * lag
        # Samples above the canopy are noise alone; a record that begins lower has the product's values.
        quiet = shot.waveform[: max(middle - _ABOVE, 0)]
        mean, std = shot.noise_mean, shot.noise_std
        if quiet.size >= _MIN_QUIET and np.ptp(quiet) > 0:
            mean, std = np.mean(quiet), np.std(quiet)
        signal = np.where(inside, shot.waveform[np.clip(number, 0, shot.waveform.size - 1)] - mean, 0.0)
        noise = np.sqrt(_CORRELATED) * np.hypot(std, _MODEL_ERROR * signal)
        self.total = float(signal.sum())
        if not self.total > 0:
            raise ValueError("no signal about the ground")
        self.signal = signal / self.total
        self.noise = np.where(inside & (lag <= _TAIL), noise / self.total, np.inf)
        bright = np.flatnonzero(signal > _SIGNAL_SIGMAS * shot.noise_std)
        top = self.elevation[bright[0]] - self.reference - _TOP_ECHO if bright.size else 0.0
        self.height = float(np.clip(top, *_START_HEIGHTS))


def start_grounds(ground: float, lowest_mode: float) -> list[float]:
    """Return the elevations that the ground starts from: the matched mode, and GEDI's where it differs."""
    # Written so that a missing lowest mode, NaN, is none.
    is_other = abs(lowest_mode - ground) > _AMBIGUOUS_GROUND
    return [float(ground), float(lowest_mode)] if is_other else [float(ground)]


@shows_progress
def fit_gedi_shots(
    shots: Sequence[Any],
    ground: Float[np.ndarray, " shots"],
    lowest_mode: Float[np.ndarray, " shots"],
    *,
    path: str | os.PathLike[str] | None = None,
    progress: ProgressOption = None,
) -> tuple[dict[str, Float[np.ndarray, "shots ..."]], list[Verdict]]:
    """Fit shots, some of them from two grounds, all in one batch.

    1. Prepare every shot about each of its possible grounds.
    2. Fit them all together.
    3. Choose the better fit of each shot, and judge record and fit.

    **Arguments:**

    - `shots`: of `jaxlidar.io.read_gedi_l1b`, whose records `inversion.gedi_table` can compute.
    - `ground`: (shots,) elevations of the matched mode in m. Shots with NaN are not fitted.
    - `lowest_mode`: (shots,) elevations of GEDI's lowest mode in m, NaN where there is none.
    - `path`, `progress`: as for `inversion.retrieve_many`.

    **Returns:** estimates by column, (shots,) and (shots, layers), NaN without a fit; and verdicts of record
    and fit, about the ground, bad without a fit.

    **Raises:** what `inversion.retrieve_many` raises for `path`; nothing for a single shot.
    """
    prepared: list[PreparedShot] = []
    # The numbers of the fits of each shot, or the reason why it has none.
    candidates: list[range | str] = []
    for shot, *elevations in zip(shots, ground, lowest_mode, strict=True):
        try:
            starts = _prepare(shot, *elevations)
        except ValueError as error:
            candidates.append(str(error))
            continue
        candidates.append(range(len(prepared), len(prepared) + len(starts)))
        prepared += starts
    retrievals = _fit(prepared, path, progress) if prepared else None
    fit_verdicts = [judge_fit(fit, about=["ground"]) for fit in retrievals or ()]
    shapes = dict.fromkeys(ESTIMATES, ()) | dict.fromkeys(LAYER_ESTIMATES, (LAYERS,))
    estimates = {name: np.full((len(shots), *shape), np.nan) for name, shape in shapes.items()}
    verdicts = []
    for i, (shot, numbers) in enumerate(zip(shots, candidates)):
        if isinstance(numbers, str) or retrievals is None:
            verdicts.append(Verdict("bad", (str(numbers),)))
            continue
        # One that did not converge counts only if none did.
        best, *alternatives = sorted(
            numbers, key=lambda n: (not retrievals.converged[n], retrievals.reduced_chi2[n])
        )
        for name, value in _estimates(prepared[best], retrievals, best).items():
            estimates[name][i] = value
        verdict = judge_shot(shot) & fit_verdicts[best]
        for n in alternatives:
            if retrievals.reduced_chi2[n] < _CHI2_FACTOR * retrievals.reduced_chi2[best]:
                reason = f"ground at {prepared[n].ground:.1f} m fits nearly as well"
                verdict &= Verdict("doubtful", (f"second minimum: {reason}",))
        distance = estimates["ground"][i] - prepared[best].ground
        if abs(distance) > _DOUBTFUL_DISTANCE:
            verdict &= Verdict("doubtful", (f"ground {distance:+.2f} m from the mode it started from",))
        verdicts.append(verdict)
    return estimates, verdicts


def _prepare(shot: Any, ground: float, lowest_mode: float) -> list[PreparedShot]:
    """Return a shot about each of its possible grounds. **Raises:** ValueError for one that has no fit."""
    if not np.isfinite(ground):
        raise ValueError("no ground above the noise")
    if not shot.noise_std > 0:
        raise ValueError(f"noise_std = {shot.noise_std:g}; a fit needs a record with noise")
    # Refuses pulses that no lidar has.
    jl.SampledPulse(time=shot.pulse_time, power=shot.pulse_power)
    return [PreparedShot(shot, elevation) for elevation in start_grounds(ground, lowest_mode)]


def _fit(
    prepared: list[PreparedShot],
    path: str | os.PathLike[str] | None,
    progress: ProgressOption,
) -> Retrieval:
    """Fit prepared shots in one batch."""
    size = max(np.size(p.shot.pulse_time) for p in prepared)
    # One plan of all shots, so that they compile once: for the longest pulse and the largest scene.
    plan = jl.plan(
        lidar_of(jl.GaussianPulse(fwhm=40.0)),
        CANOPY.scene(50.0, -6.0, 25.0),
        max_orders=1,
        window=(-_ABOVE, _BELOW),
        bin_width=1.0,
        n_rays=256,
        footprint="fixed",
    )
    problem = Problem(
        np.stack([p.signal for p in prepared])[:, None],
        [lidar_of(_padded_pulse(p.shot, size)) for p in prepared],
        CANOPY.scene(10.0),
        canopy_unknowns(),
        noise=np.stack([p.noise for p in prepared])[:, None],
        time=np.arange(-_ABOVE, _BELOW + 1),
        plan=plan,
        start={"canopy height": np.array([p.height for p in prepared])},
        scale=_GAINS,
    )
    return retrieve_many(problem, key=jax.random.key(0), max_steps=100, path=path, progress=progress)


def _padded_pulse(shot: Any, size: int) -> jl.SampledPulse:
    """Return the transmitted pulse, continued by zeros to a number of samples that all shots share."""
    time, power = np.asarray(shot.pulse_time, float), np.asarray(shot.pulse_power, float)
    later = time[-1] + np.arange(1.0, size - time.size + 1.0)
    return jl.SampledPulse(time=np.r_[time, later], power=np.r_[power, np.zeros(later.size)])


def _estimates(prepared: PreparedShot, retrievals: Retrieval, number: int) -> dict[str, Any]:
    """Return the estimates of a shot, those of a fit by its number, by the names of its columns."""
    values = {name: np.asarray(value[number], float) for name, value in retrievals.values.items()}
    stderr = {name: np.asarray(error[number], float) for name, error in retrievals.robust_stderr.items()}
    canopy = CANOPY.estimates(retrievals, number)
    return {
        "ground": prepared.reference + values["ground"],
        "ground_stderr": stderr["ground"],
        "canopy_top": prepared.reference + canopy.top,
        "canopy_top_stderr": canopy.top_stderr,
        "slope": values["slope"],
        "slope_stderr": stderr["slope"],
        "pai": canopy.pai,
        "pai_stderr": canopy.pai_stderr,
        "reduced_chi2": retrievals.reduced_chi2[number],
        "plant_area_density": canopy.density,
        "plant_area_density_stderr": canopy.density_stderr,
    }
