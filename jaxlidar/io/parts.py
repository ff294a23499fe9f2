"""A long run's results, part by part: a folder beside the file that they will make.

Every part appears whole or not at all. A run that was killed leaves the parts that it had done, and the same
run goes on with them. They belong to one problem, which is told by digests of all that the results depend on.
"""

import json
import os
import shutil
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jaxlidar._files import atomic_write

_PROBLEM = "problem.json"


class Parts:
    """The parts that are done, by number, in the folder "NAME.parts" beside the file `path`."""

    def __init__(self, path: str | os.PathLike[str], problem: Mapping[str, str]):
        path = Path(path)
        self.folder = path.with_name(path.name + ".parts")
        self.folder.mkdir(parents=True, exist_ok=True)
        told = self.folder / _PROBLEM
        if told.exists():
            try:
                before = json.loads(told.read_text())
            except ValueError as error:
                raise ValueError(f"{told}: damaged: {error}") from error
            refuse_another(self.folder, before, problem)
        elif any(not p.name.startswith(".") for p in self.folder.iterdir()):
            raise ValueError(
                f"{self.folder}: it holds other things than the parts of a run; nothing is overwritten"
            )
        else:
            with atomic_write(told) as draft:
                draft.write_text(json.dumps(dict(problem), indent=1))

    def done(self) -> set[int]:
        """Numbers of the parts that are there."""
        return {int(p.stem) for p in self.folder.glob("[0-9]*.npz")}

    def add(self, number: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Keep a part."""
        with atomic_write(self.folder / f"{number:06d}.npz") as draft, draft.open("wb") as file:
            np.savez(file, **dict(arrays))  # pyright: ignore[reportArgumentType]

    def __getitem__(self, number: int) -> dict[str, np.ndarray]:
        path = self.folder / f"{number:06d}.npz"
        try:
            with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
                return dict(file)
        except (ValueError, OSError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(f"{path}: damaged: {error}; without this file its part is done again") from error

    def remove(self) -> None:
        """Remove the folder, when the file that the parts make is there."""
        shutil.rmtree(self.folder)


def refuse_another(path: Path, before: Mapping[str, str], now: Mapping[str, str]) -> None:
    """Refuse results of another problem.

    **Raises:** ValueError that names `path` and says what differs.
    """
    differing = sorted(name for name in {*before, *now} if before.get(name) != now.get(name))
    if differing:
        raise ValueError(
            f"{path}: it holds results of another problem, which differs in {', '.join(differing)}; nothing "
            "is overwritten: give another path, or remove it"
        )
