"""The group of one beam in a GEDI L1B file: its datasets, checked against the file before they are read."""

import functools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxlidar.io.checks import FARTHEST, MOST_COUNTS, check_unpacked, refuse_damage

# Per-shot datasets of a beam's group, and what a GediShot makes of them.
_PER_SHOT = (
    "rx_sample_count",
    "rx_sample_start_index",
    "tx_sample_count",
    "tx_sample_start_index",
    "tx_gloc",
    "noise_mean_corrected",
    "noise_stddev_corrected",
    "geolocation/elevation_bin0",
    "geolocation/elevation_lastbin",
    "geolocation/latitude_lastbin",
    "geolocation/longitude_lastbin",
    "geolocation/altitude_instrument",
    "geolocation/local_beam_elevation",
    "geolocation/local_beam_azimuth",
)
# Flags that a GediShot keeps; subsets may have left them out.
FLAGS = {"degrade": "geolocation/degrade", "stale_return": "stale_return_flag"}


class Beam:
    """The group of one beam: its numbers for each shot, and where the samples of each shot lie.

    Per-shot numbers are read when the first one is asked for. Beams are told apart by identity.
    """

    def __init__(self, path: Path, file: Any, name: str):
        self.path, self.file, self.name = path, file, name
        self.size = self._dataset("shot_number").shape[0]

    def __len__(self) -> int:
        return self.size

    def at(self, field: str, shot: int | None = None) -> str:
        """The place of a field, and of a shot in it, for messages."""
        place = f"{self.path}: /{self.name}/{field}"
        return place if shot is None else f"{place}, shot {int(self.shot_number[shot])}"

    def number(self, field: str, shot: int, low: float = -FARTHEST, high: float = FARTHEST) -> float:
        """A per-shot number.

        **Raises:** ValueError where it is not one in [low, high].
        """
        value = float(self._per_shot[field][shot])
        if not low <= value <= high:
            raise ValueError(
                f"{self.at(field, shot)}: {value:g} is outside the admissible range [{low:g}, {high:g}]"
            )
        return value

    def flag(self, name: str, shot: int) -> int | None:
        """A flag of a shot, or None where the file does not have it."""
        values = self._flags.get(name)
        return None if values is None else int(values[shot])

    def samples(self, kind: str, shots: Sequence[int]) -> dict[int, np.ndarray]:
        """The samples of several shots, in increasing order, of the received ("rx") or sent ("tx") waveform.

        Shots that follow one another are read in one pass.
        """
        field = f"{kind}waveform"
        start, count = self._start_and_count[kind]
        node, cut = self._dataset(field), {}
        runs = np.split(np.array(shots), np.flatnonzero(np.diff(shots) > 1) + 1)
        for run in (run.tolist() for run in runs):
            first, end = int(start[run[0]]), int(start[run[-1]] + count[run[-1]])
            with refuse_damage(f"{self.at(field, run[0])}: damaged"):
                together = node[first:end]
            for i in run:
                if count[i] < 2:
                    raise ValueError(
                        f"{self.at(f'{kind}_sample_count', i)}: {count[i]} samples; at least 2 belong here"
                    )
                samples = together[start[i] - first : start[i] - first + count[i]].astype(np.float64)
                wrong = ~(np.abs(samples) <= MOST_COUNTS)
                if wrong.any():
                    bad = int(np.argmax(wrong))
                    raise ValueError(f"{self.at(field, i)}: sample {bad} is {samples[bad]:g}")
                cut[i] = samples
        return cut

    @functools.cached_property
    def shot_number(self) -> np.ndarray:
        """(shots,) the product's unique numbers."""
        numbers = self._read("shot_number")
        if numbers.dtype.kind not in "iu":
            raise ValueError(f"{self.at('shot_number')}: type {numbers.dtype} where whole numbers belong")
        return numbers

    @functools.cached_property
    def _per_shot(self) -> dict[str, np.ndarray]:
        for field in _PER_SHOT:
            shape = self._dataset(field).shape
            if shape != (self.size,):
                raise ValueError(
                    f"{self.at(field)}: shape {shape}, but shot_number has the shape {(self.size,)}"
                )
        return {field: self._read(field) for field in _PER_SHOT}

    @functools.cached_property
    def _flags(self) -> dict[str, np.ndarray]:
        found = {}
        for name, field in FLAGS.items():
            with refuse_damage(f"{self.at(field)}: damaged"):
                absent = f"{self.name}/{field}" not in self.file
            if absent:
                continue
            values = self._read(field)
            if values.shape != (self.size,) or values.dtype.kind not in "iu":
                raise ValueError(
                    f"{self.at(field)}: shape {values.shape} and type {values.dtype}, where a whole number "
                    f"for each of {self.size} shots belongs"
                )
            found[name] = values
        return found

    @functools.cached_property
    def _start_and_count(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Index of the first sample of each shot, from 0, and number of samples; received and sent."""
        found = {}
        for kind in ("rx", "tx"):
            size = self._dataset(f"{kind}waveform").size
            count = self._whole(f"{kind}_sample_count", size)
            given = self._whole(f"{kind}_sample_start_index", 2**62) - 1
            end = given + count
            if not (np.all(given >= 0) and np.all(end <= size) and np.all(given[1:] >= end[:-1])):
                if count.sum() != size:
                    raise ValueError(
                        f"{self.at(f'{kind}_sample_start_index')}: neither do the indices fit the {size} "
                        f"samples stored, nor do the counts ({count.sum()} in all)"
                    )
                given = np.cumsum(count) - count
            found[kind] = (given, count)
        return found

    def _whole(self, field: str, high: int) -> np.ndarray:
        values = self._per_shot[field]
        if values.dtype.kind == "f":
            # Half precision does not hold the limits.
            values = values.astype(np.float64)
        wrong = ~((values >= 0) & (values <= high) & (values == np.floor(values)))
        if wrong.any():
            i = int(np.argmax(wrong))
            raise ValueError(f"{self.at(field, i)}: {values[i]:g} is no whole number in [0, {high}]")
        return values.astype(np.int64)

    def _dataset(self, field: str) -> Any:
        """A dataset of numbers in one dimension, all of which are stored in the file."""
        with refuse_damage(f"{self.at(field)}: damaged"):
            node = self.file.get(f"{self.name}/{field}")
            shape, kind = getattr(node, "shape", None), getattr(getattr(node, "dtype", None), "kind", None)
        if shape is None or kind is None:
            raise ValueError(f"{self.at(field)}: no such dataset; it is part of a GEDI L1B product")
        if kind not in "iuf":
            raise ValueError(f"{self.at(field)}: type {node.dtype} where numbers belong")
        if len(shape) != 1:
            raise ValueError(f"{self.at(field)}: shape {shape}, where one dimension belongs")
        with refuse_damage(f"{self.at(field)}: damaged"):
            elsewhere = node.is_virtual or node.external
            (chunk,) = node.chunks or shape
            pieces = math.ceil(shape[0] / chunk) if chunk else 0
            whole = node.id.get_storage_size() // max(node.nbytes, 1)
            stored = node.id.get_num_chunks() if node.chunks else whole
        if elsewhere or stored < pieces:
            raise ValueError(
                f"{self.at(field)}: {shape[0]} numbers are declared, but the file holds {stored} of "
                f"{pieces} parts of them"
            )
        check_unpacked(self.path, f"/{self.name}/{field}", pieces * chunk * node.dtype.itemsize)
        return node

    def _read(self, field: str) -> np.ndarray:
        node = self._dataset(field)
        with refuse_damage(f"{self.at(field)}: damaged"):
            return node[:]
