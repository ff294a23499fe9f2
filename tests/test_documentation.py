"""Public names are documented: what they return and raise, their real defaults, and an example that runs.

The examples themselves are doctests, which pytest collects from the packages.
"""

import ast
import contextlib
import inspect
import pickle
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

PLACES = (jaxlidar, jaxlidar.io, jaxlidar.plot, inversion)
PUBLIC = {f"{place.__name__}.{name}": getattr(place, name) for place in PLACES for name in place.__all__}
CALLABLE = {name: thing for name, thing in PUBLIC.items() if callable(thing)}
FUNCTIONS = {name: thing for name, thing in CALLABLE.items() if not inspect.isclass(thing)}


def doc_of(thing):
    return inspect.cleandoc(thing.__doc__ or "")


def own_source(thing):
    """Of a function, or of what runs when a class is made."""
    thing = inspect.unwrap(getattr(thing, "__wrapped__", thing))
    if not inspect.isclass(thing):
        return inspect.getsource(thing)
    made = [vars(thing)[n] for n in ("__init__", "__check_init__", "__post_init__") if n in vars(thing)]
    own = (m for m in made if inspect.isfunction(inspect.unwrap(m)))
    return "".join(inspect.getsource(m) for m in own if "equinox" not in (m.__module__ or ""))


def raises(thing):
    """Whether its own lines raise or check."""
    try:
        tree = ast.parse(textwrap.dedent(own_source(thing)) or "pass")
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
def test_it_is_explained(name):
    text = doc_of(CALLABLE[name])
    first = text.split("\n\n")[0]
    assert first.rstrip().endswith((".", ":")), "begins with a sentence"
    assert ">>>" in text, "has an example"
    assert "**Example:**" in text
    if raises(CALLABLE[name]):
        assert "**Raises:**" in text, "says what it raises"


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_says_what_it_returns(name):
    text = doc_of(FUNCTIONS[name])
    assert "**Returns:**" in text
    arguments = inspect.signature(FUNCTIONS[name]).parameters
    for argument in arguments:
        assert f"`{argument}`" in text, f"says what {argument} is"


def signatures_shown():
    """Signatures of all public functions, classes and public methods, by name, as `help` shows them."""
    for name, exported in CALLABLE.items():
        members = dir(exported) if inspect.isclass(exported) else ()
        methods = {m: getattr(exported, m) for m in members if not m.startswith("_")}
        routines = {f"{name}.{m}": value for m, value in methods.items() if callable(value)}
        for label, function in {name: exported, **routines}.items():
            # Warnings are built-in classes without a signature.
            with contextlib.suppress(ValueError):
                yield label, inspect.signature(function)


def test_signatures_fit_on_a_screen():
    shown = dict(signatures_shown())
    assert len(shown) > 300
    for name, signature in shown.items():
        assert len(str(signature)) <= 600, name
        annotations = [signature.return_annotation, *(p.annotation for p in signature.parameters.values())]
        for annotation in annotations:
            assert len(inspect.formatannotation(annotation)) <= 60, (name, annotation)


def test_signatures_name_types_as_source_code_does():
    text = str(inspect.signature(inversion.ground_and_canopy))
    assert text.startswith(
        '(height: Float[ArrayLike, "... bins"], power: Float[ArrayLike, "... bins"], *, pulse: '
    )
    assert text.endswith("-> GroundAndCanopy")
    assert "(lidar: Lidar, scene: Scene, *, key: PRNGKeyArray, rtol: float | None = None" in str(
        inspect.signature(jaxlidar.simulate)
    )
    # Only what is shown is short: readers of annotations find the types.
    assert inspect.get_annotations(jaxlidar.simulate)["scene"] is jaxlidar.Scene
    assert pickle.loads(pickle.dumps(jaxlidar.simulate)) is jaxlidar.simulate


@pytest.mark.parametrize("package", [jaxlidar, inversion])
def test_dir_lists_public_names_alone(package):
    assert dir(package) == sorted(package.__all__)


BULLET = re.compile(r"^- ((?:`\w+`(?:, )?)+)[^:]*:(.*?)(?=^- |^\S|\Z)", re.M | re.S)
STATED = re.compile(r"[Dd]efaults? (?:is |are )?(`[^`]+`|\"[^\"]*\"|\([^)]*\)|[-+\w.,]*[\w)])")


def stated_defaults(text):
    """Arguments and what is said of their defaults."""
    for names, said in BULLET.findall(text):
        found = STATED.search(said)
        if found:
            for name in re.findall(r"`(\w+)`", names):
                yield name, found.group(1).strip("`")


def real_default(thing, name):
    parameter = inspect.signature(thing).parameters.get(name)
    if parameter is None or parameter.default is inspect.Parameter.empty:
        return inspect.Parameter.empty
    default = parameter.default
    if (inspect.isclass(thing) and issubclass(thing, eqx.Module)) or hasattr(thing, "__dataclass_fields__"):
        field = thing.__dataclass_fields__.get(name)
        factory = getattr(field, "default_factory", None)
        if callable(factory):
            return factory()
    return default


def same(said, real):
    """Whether a default is the one stated, where what is stated is a value."""
    scope = {"inf": np.inf, "infinity": np.inf, **{n: getattr(jaxlidar, n) for n in jaxlidar.__all__}}
    words = {"zero": 0, "one": 1, "two": 2, "three": 3, "four": 4, "eight": 8, "none": None, "north": None}
    text = said.replace(",", "") if re.fullmatch(r"[\d,]+", said) else said
    try:
        value = words[text] if text in words else eval(text, scope)
    except (NameError, SyntaxError, TypeError):
        return None
    if isinstance(value, eqx.Module) or isinstance(real, eqx.Module):
        return jax.tree.structure(value) == jax.tree.structure(real) and bool(eqx.tree_equal(value, real))
    if value is None or real is None or isinstance(value, str | bool) or isinstance(real, str | bool):
        return value == real
    try:
        return bool(np.all(np.asarray(value, float) == np.asarray(real, float)))
    except (TypeError, ValueError):
        return None


@pytest.mark.parametrize("name", CALLABLE)
def test_stated_defaults_are_the_real_ones(name):
    thing = CALLABLE[name]
    for argument, said in stated_defaults(doc_of(thing)):
        try:
            real = real_default(thing, argument)
        except (TypeError, ValueError):
            return
        if real is inspect.Parameter.empty:
            continue
        assert same(said, real) is not False, f"{argument}: default {said} is stated, {real!r} is real"


def test_a_wrong_default_is_noticed():
    def wrong(a=1, b="x", c=None):
        """Nothing.

        - `a`: a number. Default 2.
        - `b`: a word. Default "x".
        - `c`: a thing. Default None.
        """

    found = {n: same(s, real_default(wrong, n)) for n, s in stated_defaults(doc_of(wrong))}
    assert found == {"a": False, "b": True, "c": True}
