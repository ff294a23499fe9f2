"""Results of the tasks of a long run, in a folder beside the file that they will become.

Every file appears complete or not at all. A run that was killed leaves the results of its finished tasks, and
the same run continues with them. The folder belongs to one problem, which is known by digests of everything
that the results depend on (`jaxlidar._fingerprint`).
"""

import json
import os
import shutil
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jaxlidar._files import atomic_write

_PROBLEM_FILE = "problem.json"


class TaskFiles:
    """Arrays of finished tasks by number, in the folder "NAME.parts" beside the file `path`.

    **Raises:** ValueError where the folder belongs to another problem, or holds other files.
    """

    def __init__(self, path: str | os.PathLike[str], problem: Mapping[str, str]):
        path = Path(path)
        self.folder = path.with_name(path.name + ".parts")
        self.folder.mkdir(parents=True, exist_ok=True)
        problem_path = self.folder / _PROBLEM_FILE
        if problem_path.exists():
            try:
                stored_problem = json.loads(problem_path.read_text())
            except ValueError as error:
                raise ValueError(f"{problem_path}: damaged: {error}") from error
            refuse_other_problem(self.folder, stored_problem, problem)
        elif any(not p.name.startswith(".") for p in self.folder.iterdir()):
            raise ValueError(
                f"{self.folder}: it holds other things than the parts of a run; nothing is overwritten"
            )
        else:
            with atomic_write(problem_path) as draft:
                draft.write_text(json.dumps(dict(problem), indent=1))

    def numbers(self) -> set[int]:
        """Return the numbers of finished tasks."""
        return {int(p.stem) for p in self.folder.glob("[0-9]*.npz")}

    def add(self, number: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Write the arrays of a task."""
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
        """Remove the folder, after the file that the results become is written."""
        shutil.rmtree(self.folder)


def refuse_other_problem(path: Path, stored: Mapping[str, str], current: Mapping[str, str]) -> None:
    """Refuse results of another problem, each given by its digests.

    **Raises:** ValueError that names `path` and the digests that differ.
    """
    differing = sorted(name for name in {*stored, *current} if stored.get(name) != current.get(name))
    if differing:
        raise ValueError(
            f"{path}: it holds results of another problem, which differs in {', '.join(differing)}; nothing "
            "is overwritten: give another path, or remove it"
        )
