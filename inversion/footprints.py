"""Footprints of a spaceborne lidar over airborne point clouds: a level 1B file, and a table of its metrics.

It is the work of `jaxlidar footprints`, in four steps: places of footprints from a file, waveforms over the
clouds tile by tile (`jaxlidar.simulate_tiles`), a GEDI L1B file with noise (`jaxlidar.io.write_gedi_l1b`),
and a table of what the GEDI simulator, and `gedi_table`, make of that file.
"""

import dataclasses
import os
from collections.abc import Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxlidar as jl
from inversion.metrics.gedi_simulator import link_margin_noise, simulator_table, true_metrics
from inversion.metrics.gedi_table import gedi_table
from jaxlidar.extend import check_number
from jaxlidar.formats.footprints import Places, read_places
from jaxlidar.formats.gedi import BEAMS
from jaxlidar.formats.tables import ColumnAxis
from jaxlidar.io import Column, ShotTable, read_gedi_l1b, write_gedi_l1b
from jaxlidar.progress import ProgressOption
from jaxlidar.survey.cloud_tiles import REFLECTANCE, CloudFile

# Counts per apparent reflectance of a sample, as `write_gedi_l1b` has it by default.
_GAIN = 50_000.0
# Footprints of which less is over returns have no waveform to speak of: the simulator's own limit.
_LEAST_COVERED = 2.0 / 3.0
_PERCENT = ColumnAxis("percent", np.arange(101.0), "percent")
# Random numbers of the waveforms, of noise, and of the errors of geolocation.
_OF_LIGHT, _OF_NOISE, _OF_PLACES = range(3)


def simulate_footprints(
    files: Sequence[str | os.PathLike[str]],
    places: str | os.PathLike[str],
    out: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    *,
    lidar: jl.Lidar,
    link_margin: float | None = None,
    cover: float = 0.95,
    geolocation_error: float = 0.0,
    crs: str | None = None,
    seed: int = 0,
    executor: Executor | None = None,
    progress: ProgressOption = None,
) -> ShotTable:
    """Simulate footprints over airborne clouds, write them as GEDI L1B, and return a table of metrics.

    **Arguments:**

    - `files`, `folder`, `executor`, `progress`: as for `jaxlidar.simulate_tiles`.
    - `places`: as for `jaxlidar.formats.footprints.read_places`.
    - `out`: the HDF5 file to write.
    - `lidar`: that of all footprints.
    - `link_margin`: dB, at the canopy cover `cover`, in [0, 1): noise as `inversion.metrics.gedi_simulator`
      states. It is the standard deviation before the product's smoothing. Default None: no noise. The file
      then states a noise of 0, the columns `blairSense` and `sensitivity` are NaN, and `quality` is not
      judged by noise.
    - `geolocation_error`: standard deviation in m, along x and y, of the error of the stated places, which
      is the same along a beam. Light falls on the true places. Default 0.
    - `crs`: coordinate reference system of files that declare none, in metres. Default None: the files'.
    - `seed`: of light, noise and errors of geolocation.

    **Returns:** a `ShotTable` with a row for each footprint of `places`, in its order:

    - `shot_number`, `beam`, `x`, `y`, and with an error `true_x` and `true_y`, m;
    - `covered`: fraction of its light that fell on ground or plants near returns of the clouds;
    - metrics without noise: `true ground`, `true top`, `ground slope`, `ALS cover`, `rhReal`, as
      `inversion.metrics.gedi_simulator.true_metrics` states;
    - metrics of the record, as `simulator_table` there states;
    - the columns of `inversion.gedi_table`, without those of each setting group; one whose name the simulator
      has, too, ends in "_jaxlidar".

    Footprints outside of all files, and those of which less than 2/3 is covered, are "bad" in the column
    `quality`, and `reasons` says why. Of a product's file, shots outside are left out.

    **Raises:** as `read_places`, `jaxlidar.simulate_tiles` and `write_gedi_l1b`; ValueError for files without
    a coordinate reference system.
    """
    if link_margin is not None:
        check_number("link_margin", link_margin)
    check_number("cover", cover, 0.0, 1.0, high_open=True)
    check_number("geolocation_error", geolocation_error, 0.0)
    # Systems that differ are refused by `simulate_tiles`.
    system = next((c for c in (crs, *(CloudFile.of(path).crs for path in files)) if c is not None), None)
    if system is None:
        raise ValueError(f"{files[0]}: no coordinate reference system is declared: give one (--crs)")
    known = read_places(places, system)
    key = jax.random.key(seed)
    beams, beam_of_shot = np.unique(known.beam, return_inverse=True)
    errors = jax.random.normal(jax.random.fold_in(key, _OF_PLACES), (len(BEAMS), 2))
    # By the beam's name, whichever others there are.
    error = np.asarray(errors, float)[[list(BEAMS).index(beam) for beam in beams]][beam_of_shot]
    true_position = known.position + geolocation_error * error
    survey = jl.Survey(lidar, true_position, zenith=0.0, azimuth=0.0, crs=system)
    options: dict[str, Any] = {"executor": executor, "progress": progress}
    try:
        parts = jl.simulate_tiles(files, survey, folder, key=jax.random.fold_in(key, _OF_LIGHT), **options)
    except ValueError as error:
        # The survey is that of a file.
        raise ValueError(str(error).replace("survey:", f"{places}:", 1)) from error
    rows = np.concatenate([shots for shots, _ in parts])
    stated = jl.Survey(lidar, known.position[rows], zenith=0.0, azimuth=0.0, crs=system)
    # The file states where the footprints should be.
    waves = [dataclasses.replace(waves, position=known.position[shots]) for shots, waves in parts]
    pulse_std = 0.5 * jl.SPEED_OF_LIGHT * float(lidar.pulse.std)
    # A Gaussian's 1/e^2 radius is twice its standard deviation.
    footprint_std = 0.5 * float(survey.footprint_radius.max())
    noise: dict[str, Any] = {"noise_std": 0.0}
    if link_margin is not None:
        sigma = link_margin_noise(link_margin, cover, pulse_std, footprint_std)
        # Of a record of unit energy per m, in counts of a sample.
        sample = 0.5 * jl.SPEED_OF_LIGHT * float(lidar.sampling_interval)
        noise = {"noise_std": sigma * sample * _GAIN * REFLECTANCE}
        noise["key"] = jax.random.fold_in(key, _OF_NOISE)
    numbers, names = known.shot_number[rows], known.beam[rows]
    write_gedi_l1b(out, waves, stated, beam=names, shot_number=numbers, gain=_GAIN, **noise)
    shots = read_gedi_l1b(out)
    table = _place_table(known, true_position, geolocation_error > 0, Path(places).suffix, rows)
    table = table.join(_true_table(parts, known.shot_number, pulse_std, footprint_std))
    report = progress if callable(progress) else None
    table = table.join(simulator_table(shots, footprint_std, report))
    ours = gedi_table(shots, progress=progress)
    columns = {name: c for name, c in ours.columns.items() if name != "beam" and name[-3:-1] != "_a"}
    table = table.join(ShotTable(columns), suffix="_jaxlidar")
    settings = {"pSigma": pulse_std, "fSigma": footprint_std}
    settings |= {} if link_margin is None else {"linkM": link_margin, "linkCov": cover}
    columns = {name: Column(np.full(len(table), value)) for name, value in settings.items()}
    return _with_reasons(
        ShotTable(table.columns | columns, {"title": "simulated footprints over airborne clouds"})
    )


def _place_table(
    known: Places, true_position: np.ndarray, has_error: bool, suffix: str, rows: np.ndarray
) -> ShotTable:
    """Return the places of footprints; of a product's file, of those that were simulated."""
    columns = {
        "shot_number": Column(known.shot_number, "", "number of the footprint"),
        "beam": Column(known.beam, "", "name of the beam's group"),
        "x": Column(known.position[:, 0], "m", "stated place"),
        "y": Column(known.position[:, 1], "m", "stated place"),
    }
    if has_error:
        columns |= {f"true_{a}": Column(true_position[:, k], "m", "true place") for k, a in enumerate("xy")}
    table = ShotTable(columns)
    return table.select(np.sort(rows)) if suffix.lower() in (".h5", ".hdf5") else table


def _true_table(
    parts: list[tuple[np.ndarray, jl.Waveforms]],
    shot_number: np.ndarray,
    pulse_std: float,
    footprint_std: float,
) -> ShotTable:
    """Return the metrics without noise of the footprints that have light, and how much of each is covered."""
    numbers, covered, metrics = [], [], []
    missing = dict.fromkeys(("true ground", "true top", "ground slope", "ALS cover"), np.nan)
    for shots, waves in parts:
        first = np.asarray(waves.components["first"][:, 0], float)
        ground = waves.components.get("ground")
        for row, shot in enumerate(shots):
            of_ground = np.zeros_like(first[row]) if ground is None else np.asarray(ground[row, 0], float)
            record = (waves.height_of_shot(row), first[row], of_ground)
            numbers.append(shot_number[shot])
            covered.append(first[row].sum() / REFLECTANCE)
            has_light = first[row].sum() > 0
            metrics.append(
                true_metrics(*record, pulse_std, footprint_std)
                if has_light
                else missing | {"rhReal": np.full(101, np.nan)}
            )
    texts = {
        "true ground": ("m", "centre of gravity of the ground's echo"),
        "true top": ("m", "elevation above which a thousandth of the energy lies"),
        "ground slope": ("degrees", "slope by the width of the ground's echo"),
        "ALS cover": ("", "cover by the energies of plants and ground"),
        "rhReal": ("m", "relative height above the true ground, without noise"),
    }
    columns = {
        "shot_number": Column(np.array(numbers, np.uint64)),
        "covered": Column(np.array(covered), "", "fraction of the footprint near returns of the clouds"),
    }
    for name, text in texts.items():
        values = np.array([row[name] for row in metrics])
        columns[name] = Column(values, *text, _PERCENT if values.ndim == 2 else None)
    return ShotTable(columns)


def _with_reasons(table: ShotTable) -> ShotTable:
    """Return the table with the reasons why footprints have no, or only part of, a waveform."""
    quality, reasons = table["quality"].astype(object), table["reasons"].astype(object)
    for i, covered in enumerate(table["covered"]):
        if np.isnan(covered):
            quality[i], reasons[i] = "bad", "outside of all files of points"
        elif covered < _LEAST_COVERED:
            reason = f"returns below {100.0 * covered:.0f} % of the footprint"
            quality[i], reasons[i] = "bad", "; ".join(filter(None, (reason, reasons[i])))
    columns = dict(table.columns)
    for name, values in (("quality", quality), ("reasons", reasons)):
        columns[name] = columns[name]._replace(values=values.astype(str))
    return ShotTable(columns, table.attributes)
