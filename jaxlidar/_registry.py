"""Functions and classes that upper packages offer to lower ones.

Imports go downwards only, but a few methods of lower classes do the work of an upper package: `Waveform.save`
writes a file, which is the work of `jaxlidar.results`. The upper package registers its function here when it
is imported, and the method looks it up when it is called. `import jaxlidar` imports all packages that
register something, so users meet no function without a provider.
"""

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

_Function = TypeVar("_Function", bound=Callable[..., Any])


class RegisteredFunction:
    """A function that lower packages call and an upper package provides.

    - `purpose`: what it does, for the message where nothing is registered.
    - `provider`: the package that registers it.
    """

    def __init__(self, purpose: str, provider: str):
        self.purpose, self.provider = purpose, provider
        self._function: Callable[..., Any] | None = None

    def register(self, function: _Function) -> _Function:
        """Make `function` the one that is called, and return it unchanged."""
        self._function = function
        return function

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call the registered function. **Raises:** RuntimeError where there is none."""
        if self._function is None:
            raise RuntimeError(f"{self.purpose} needs {self.provider}, which is not imported yet")
        return self._function(*args, **kwargs)


save_result = RegisteredFunction("saving a result", "jaxlidar.results")
waveform_html = RegisteredFunction("the figure of a waveform in a notebook", "jaxlidar")
detect_returns = RegisteredFunction("detecting discrete returns", "jaxlidar.survey.waveforms")
true_returns = RegisteredFunction("the list of true echoes", "jaxlidar.survey.waveforms")
survey_lines = RegisteredFunction("describing the strategy of a survey", "jaxlidar.survey.choose_strategy")
shots_within = RegisteredFunction("clipping a survey to a scene", "jaxlidar.survey.coverage")
simulate_survey = RegisteredFunction("simulating a survey", "jaxlidar.survey.simulate_many")

# The public names of jaxlidar. `jaxlidar.results` finds among them the classes that a table of a TOML file
# can stand for.
public_objects: dict[str, Any] = {}


def register_public_objects(objects: Mapping[str, Any]) -> None:
    """Add public names, with the objects that they stand for."""
    public_objects.update(objects)
