"""Public names are documented: results, errors, actual defaults, and an example that runs.

The examples themselves are doctests, which pytest collects from the packages.
"""

import ast
import inspect
import re
import textwrap

import equinox as eqx
import jax
import numpy as np
import pytest

import inversion
import jaxlidar
import jaxlidar.extend
import jaxlidar.io
import jaxlidar.plot
from jaxlidar.cli.reference import classes_of_results

NAMESPACES = (jaxlidar, jaxlidar.io, jaxlidar.plot, inversion)
PUBLIC = {
    f"{module.__name__}.{name}": value
    for module in NAMESPACES
    for name, value in {
        **{name: getattr(module, name) for name in module.__all__},
        **classes_of_results(module),
    }.items()
}
CALLABLE = {name: value for name, value in PUBLIC.items() if callable(value)}
FUNCTIONS = {name: value for name, value in CALLABLE.items() if not inspect.isclass(value)}


def docstring_of(value):
    return inspect.cleandoc(value.__doc__ or "")


def executed_source(value):
    """Source of a function; of a class, that of the methods of its own that run at construction."""
    value = inspect.unwrap(getattr(value, "__wrapped__", value))
    if not inspect.isclass(value):
        return inspect.getsource(value)
    initialisers = [
        vars(value)[n] for n in ("__init__", "__check_init__", "__post_init__") if n in vars(value)
    ]
    functions = (m for m in initialisers if inspect.isfunction(inspect.unwrap(m)))
    return "".join(inspect.getsource(m) for m in functions if "equinox" not in (m.__module__ or ""))


def checks_or_raises(value):
    """True if the source of a function or class itself has a `raise` or calls a `check_...` function."""
    try:
        tree = ast.parse(textwrap.dedent(executed_source(value)) or "pass")
    except (OSError, TypeError, IndentationError, SyntaxError):
        return False
    for node in ast.walk(tree):
        if isinstance(node, ast.Raise) and node.exc is not None:
            return True
        if (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Name)
            and node.func.id.startswith("check_")
        ):
            return True
    return False


@pytest.mark.parametrize("name", CALLABLE)
def test_docstrings_explain_and_have_an_example(name):
    text = docstring_of(CALLABLE[name])
    first = text.split("\n\n")[0]
    assert first.rstrip().endswith((".", ":")), "begins with a sentence"
    assert ">>>" in text, "has an example"
    assert "**Example:**" in text
    if checks_or_raises(CALLABLE[name]):
        assert "**Raises:**" in text, "says what it raises"


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_says_what_it_returns(name):
    text = docstring_of(FUNCTIONS[name])
    assert "**Returns:**" in text
    arguments = inspect.signature(FUNCTIONS[name]).parameters
    for argument in arguments:
        assert f"`{argument}`" in text, f"says what {argument} is"


@pytest.mark.parametrize("package", [jaxlidar, inversion])
def test_dir_lists_public_names_alone(package):
    assert dir(package) == sorted(package.__all__)


BULLET = re.compile(r"^- ((?:`\w+`(?:, )?)+)[^:]*:(.*?)(?=^- |^\S|\Z)", re.M | re.S)
STATED = re.compile(r"[Dd]efaults? (?:is |are )?(`[^`]+`|\"[^\"]*\"|\([^)]*\)|[-+\w.,]*[\w)])")


def stated_defaults(text):
    """Yield arguments and the text of the defaults that the docstring states."""
    for names, description in BULLET.findall(text):
        default = STATED.search(description)
        if default:
            for name in re.findall(r"`(\w+)`", names):
                yield name, default.group(1).strip("`")


def actual_default(value, name):
    parameter = inspect.signature(value).parameters.get(name)
    if parameter is None or parameter.default is inspect.Parameter.empty:
        return inspect.Parameter.empty
    default = parameter.default
    if (inspect.isclass(value) and issubclass(value, eqx.Module)) or hasattr(value, "__dataclass_fields__"):
        field = value.__dataclass_fields__.get(name)
        factory = getattr(field, "default_factory", None)
        if callable(factory):
            return factory()
    return default


def equals_stated(stated, actual):
    """True if a default has the value that the docstring states; None if the text is no value."""
    scope = {"inf": np.inf, "infinity": np.inf, **{n: getattr(jaxlidar, n) for n in jaxlidar.__all__}}
    if type(actual).__name__ == "_Default":
        # It stands for a value by its text.
        actual = eval(str(actual), scope)
    words = {"zero": 0, "one": 1, "two": 2, "three": 3, "four": 4, "eight": 8, "none": None, "north": None}
    text = stated.replace(",", "") if re.fullmatch(r"[\d,]+", stated) else stated
    try:
        stated_value = words[text] if text in words else eval(text, scope)
    except (NameError, SyntaxError, TypeError):
        return None
    if isinstance(stated_value, eqx.Module) or isinstance(actual, eqx.Module):
        return jax.tree.structure(stated_value) == jax.tree.structure(actual) and bool(
            eqx.tree_equal(stated_value, actual)
        )
    if (
        stated_value is None
        or actual is None
        or isinstance(stated_value, str | bool)
        or isinstance(actual, str | bool)
    ):
        return stated_value == actual
    try:
        return bool(np.all(np.asarray(stated_value, float) == np.asarray(actual, float)))
    except (TypeError, ValueError):
        return None


@pytest.mark.parametrize("name", CALLABLE)
def test_stated_defaults_are_the_actual_ones(name):
    value = CALLABLE[name]
    for argument, stated in stated_defaults(docstring_of(value)):
        actual = actual_default(value, argument)
        if actual is inspect.Parameter.empty:
            continue
        assert equals_stated(stated, actual) is not False, (
            f"{argument}: {stated} is stated, the default is {actual!r}"
        )


def test_most_stated_defaults_can_be_compared():
    """The test above passes over texts that are no values: there are few of them."""
    comparisons = [
        equals_stated(stated, actual_default(value, argument))
        for value in CALLABLE.values()
        for argument, stated in stated_defaults(docstring_of(value))
    ]
    assert len(comparisons) > 300
    assert comparisons.count(None) < 0.05 * len(comparisons)


def test_a_wrong_default_is_noticed():
    def wrong(a=1, b="x", c=None):
        """Nothing.

        - `a`: a number. Default 2.
        - `b`: a word. Default "x".
        - `c`: a thing. Default None.
        """

    agreement = {
        n: equals_stated(s, actual_default(wrong, n)) for n, s in stated_defaults(docstring_of(wrong))
    }
    assert agreement == {"a": False, "b": True, "c": True}
