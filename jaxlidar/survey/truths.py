"""Truth of the shots of a survey: reference quantities of what each beam meets in the scene."""

import dataclasses
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxlidar._jax.programs import Program
from jaxlidar._jax.threads import ONE_CORE
from jaxlidar._jax.workers import WorkUnit, task
from jaxlidar.io.datasets import keep_as_netcdf
from jaxlidar.io.netcdf import TRUTH_QUANTITIES
from jaxlidar.planning.setup import Setup
from jaxlidar.simulation.truth import Truth, compute_labels, first_order_setup
from jaxlidar.spectral.apply_optics import make_waveform_model
from jaxlidar.survey.per_shot import ShotGeometry, aim_offset, setup_of_shot, shot_geometry
from jaxlidar.survey.strategy import AbstractStrategy, ContributionSum, Shots, first_rows
from jaxlidar.trace.device_scene import DeviceScene, aim_at, build_device_scene


@final
class Truths(eqx.Module):
    """Truth of all shots of a survey: what their beams meet in a scene; axis 0 is the shots'.

    The fields are those of `Truth`, at the samples of the `Waveforms` that they belong to;
    `waves[i].truth` is the `Truth` of shot i.

    **Example:**

    >>> import jax, jaxlidar as jl
    >>> survey = jl.Survey.track(jl.Lidar(), start=(0, 0), end=(100, 0), spacing=50.0)
    >>> scene = jl.Scene(ground=jl.Ground(height=5.0, reflectance=0.4, slope=5.0, aspect=90.0))
    >>> many = jl.simulate_many(survey, scene, key=jax.random.key(0), truth=True)
    >>> print(", ".join(f"{z:.2f}" for z in many.truth.surface_height["ground"]))
    5.00, 0.63, -3.75
    >>> print(f"{float(many[2].truth.returns['ground'].sum()):.2f}")
    0.40
    """

    returns: dict[str, Float[np.ndarray, "shots wavelengths samples"]]
    gap_probability: Float[np.ndarray, "shots samples"]
    leaf_area_density: Float[np.ndarray, "shots samples"]
    bark_area_density: Float[np.ndarray, "shots samples"]
    plant_area_index: Float[np.ndarray, "shots samples"]
    top_height: Float[np.ndarray, " shots"]
    surface_height: dict[str, Float[np.ndarray, " shots"]]
    surface_spread: dict[str, Float[np.ndarray, " shots"]]

    def of_shot(self, shot: int, time: Float[Array, "samples"], height: Float[Array, "samples"]) -> Truth:
        """Return the truth of one shot.

        **Arguments:** `shot`: its number. `time`, `height`: of the samples, as those of `Truth`.

        **Returns:** a `Truth`.
        """
        fields = {
            name: jax.tree.map(lambda a: jnp.asarray(a[shot]), field) for name, field in vars(self).items()
        }
        return Truth(time=time, height=height, **fields)


# In files, truths are a group of their own beside the waveforms.
keep_as_netcdf(
    Truths,
    "truth of the shots of a survey",
    TRUTH_QUANTITIES,
    dimensions={"shots": "shot", "samples": "time", "wavelengths": "wavelength"},
    items={"returns": "material", "surface_height": "surface", "surface_spread": "surface"},
    rows="shots",
)


@dataclasses.dataclass(frozen=True)
class StrategyWithTruth(AbstractStrategy):
    """A strategy that traces light, and the truth of all shots.

    After the tasks of `light_strategy`, there is one for the truth of each of its blocks of shots.
    """

    light_strategy: AbstractStrategy

    @staticmethod
    def around(light: AbstractStrategy) -> "StrategyWithTruth":
        """Return a strategy that traces light, with the truth of its shots."""
        return StrategyWithTruth(light.setup, light.survey, light.rtol, light.kept_names, light)

    @property
    def shot_slices(self) -> list[slice]:
        return self.light_strategy.shot_slices

    def tasks(self, key: PRNGKeyArray) -> list[WorkUnit]:
        return [*self.light_strategy.tasks(key), *self.truth_tasks(key)]

    def truth_tasks(self, key: PRNGKeyArray) -> list[WorkUnit]:
        """Return the tasks for the truth alone. They draw no random numbers: `key` is passed on unused."""
        # All are as large as the first, for one program; the last one is filled up.
        size = self.shot_slices[0].stop
        return [
            task(number, truths_of_chunk, (self.setup, shot_geometry(self.survey, shots.start, size)), key)
            for number, shots in enumerate(self.shot_slices, self.light_strategy.n_tasks)
        ]

    @property
    def n_tasks(self) -> int:
        return self.light_strategy.n_tasks + len(self.shot_slices)

    @property
    def n_light_tasks(self) -> int:
        return self.light_strategy.n_tasks

    @property
    def contribution_sum(self) -> ContributionSum | None:
        return self.light_strategy.contribution_sum

    def shots_of_task(self, number: int) -> Shots:
        n_light = self.n_light_tasks
        return (
            self.light_strategy.shots_of_task(number)
            if number < n_light
            else self.shot_slices[number - n_light]
        )

    def results_of_task(self, number: int, result: Any) -> Any:
        n_light = self.n_light_tasks
        if number < n_light:
            return self.light_strategy.results_of_task(number, result)
        return first_rows(result, self.shot_slices[number - n_light])

    def info(self) -> dict[str, Any]:
        return self.light_strategy.info()


def truths_of_chunk(setup: Setup, shots: ShotGeometry, key: PRNGKeyArray) -> Truths:
    """Return the truth of a chunk of shots; no random numbers are drawn."""
    # The truth is that of the first order with a fixed key: `key` is unused, as every task has one.
    fields = _compiled_truths(first_order_setup(setup), shots.in_precision())
    return Truths(**jax.tree.map(np.asarray, fields))


def _truth_of_shot(scene: DeviceScene, setup: Setup, shot: ShotGeometry) -> dict[str, Any]:
    """Return the fields of `Truths` for one shot."""
    offset = aim_offset(setup, shot)
    setup = setup_of_shot(setup, shot)
    scene = aim_at(scene, setup.lidar, offset)
    truth = vars(compute_labels(scene, make_waveform_model(setup)))
    return {field.name: truth[field.name] for field in dataclasses.fields(Truths)}


def _truths_of_shots(setup: Setup, shots: ShotGeometry) -> dict[str, Any]:
    """Return the fields of `Truths` for shots one after the other, over one device scene."""
    scene = build_device_scene(setup)
    return jax.lax.map(lambda shot: _truth_of_shot(scene, setup, shot), shots)


_compiled_truths = Program(_truths_of_shots, **ONE_CORE)
