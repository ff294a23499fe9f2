"""Progress, as it is reported to the argument `progress` of all functions that take long."""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, ParamSpec, TypeAlias, TypeVar

# True for a bar; a function that is called with each report; None or False for neither.
ProgressOption: TypeAlias = bool | Callable[..., Any] | None
_P = ParamSpec("_P")
_R = TypeVar("_R")


@dataclasses.dataclass(frozen=True)
class Progress:
    """Progress of a simulation, a survey, many fits or a table. Printed, it is one line of text.

    - `done`: number that is done, that of an earlier run included. With shared illumination, and with truth,
      shots count in proportion to the tasks that are done.
    - `total`: number in all; None where it depends on the error.
    - `seconds`: time since the work began, s; planning comes before.
    - `unit`: what is counted: "shots" of a survey or table, "fits", or the "photons" of `simulate` and
      `energy_budget`. Default "shots".
    - `stored`: number that an earlier run has done, which took none of these seconds. Default 0.
    - `converged`: number of fits that have converged; None where there are none. Default None.
    - `error`: current relative error: of the waveform, as `simulate` defines it, or of the emitted energy;
      None where none is estimated. Default None.
    - `rtol`: target of the relative error, or None where there is none. Default None.

    **Example:** of a survey, and of a simulation.

    >>> import jaxlidar as jl
    >>> print(jl.Progress(done=500, total=2000, seconds=10.0))
    500 of 2000 shots, 10 s, 50 per s, 30 s left
    >>> print(jl.Progress(65536, None, 1.5, "photons", error=0.004, rtol=0.01))
    65536 photons, 1.5 s, relative error 0.004 (aim 0.01)
    """

    done: int
    total: int | None
    seconds: float
    unit: str = "shots"
    stored: int = 0
    converged: int | None = None
    error: float | None = None
    rtol: float | None = None

    @property
    def rate(self) -> float:
        """Number per s in this run; 0 before the first."""
        return (self.done - self.stored) / max(self.seconds, 1e-9)

    @property
    def left(self) -> float:
        """Estimated time left, s; infinite before the first is done, and where the total is not known."""
        if self.done == self.total:
            return 0.0
        return (self.total - self.done) / self.rate if self.total and self.rate > 0 else math.inf

    def __str__(self) -> str:
        total = "" if self.total is None else f" of {self.total}"
        parts = [f"{self.done}{total} {self.unit}"]
        if self.converged is not None:
            parts.append(f"{self.converged} converged")
        parts.append(f"{self.seconds:.3g} s")
        if self.total is not None:
            parts.append(f"{self.rate:.3g} per s")
        if math.isfinite(self.left):
            parts.append(f"{self.left:.3g} s left")
        if self.error is not None:
            target = "" if self.rtol is None else f" (aim {self.rtol:.2g})"
            parts.append(f"relative error {self.error:.2g}{target}")
        return ", ".join(parts)


class _Bar:
    """A progress bar of tqdm, in a terminal or a notebook; it is drawn at the first report."""

    def __init__(self):
        self._bar: Any = None
        # What the bar counts: its total and unit.
        self._counted: Any = None

    def __call__(self, report: Any, total: int | None = None) -> None:
        """Show a report: a `Progress`, a number that is done (of a total), or text of a further step."""
        if isinstance(report, Progress):
            done, total, unit = report.done, report.total, report.unit
            if total is None and report.error is not None and report.rtol is not None:
                # The error falls with the square root of the number of photons.
                completed = (report.rtol / max(report.error, report.rtol)) ** 2
                done, total, unit = round(100 * completed), 100, "%"
        else:
            # A number without a total is that of the step, not of those that are done.
            done, unit = (None if total is None else report), "steps"
        if self._counted != (total, unit):
            # The first report, or that of the next kind of work.
            self.close()
            self._counted = (total, unit)
            # Imported here: a bar is shown at request alone.
            from tqdm.auto import tqdm

            stored = report.stored if isinstance(report, Progress) else 0
            self._bar = tqdm(total=total, initial=stored, unit=f" {unit}")
        self._bar.n = self._bar.n + 1 if done is None else done
        if isinstance(report, Progress):
            texts = [] if report.error is None else [f"error {report.error:.2g}"]
            texts += [] if report.converged is None else [f"{report.converged} converged"]
            self._bar.set_postfix_str(", ".join(texts), refresh=False)
        elif done is None:
            self._bar.set_postfix_str(str(report), refresh=False)
        self._bar.refresh()

    def close(self) -> None:
        """Leave the bar as it is."""
        if self._bar is not None:
            self._bar.close()


def shows_progress(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Let a function whose argument `progress` is a function or None take True as well, for a bar.

    **Raises:** TypeError, when it is called, for a `progress` of another kind.
    """

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        progress: Any = kwargs.get("progress")
        if not isinstance(progress, bool):
            if not (progress is None or callable(progress)):
                raise TypeError(f"progress = {progress!r} is no function")
            return function(*args, **kwargs)
        bar = _Bar() if progress else None
        kwargs["progress"] = bar
        try:
            return function(*args, **kwargs)
        finally:
            if bar is not None:
                bar.close()

    return call
