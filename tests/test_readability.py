"""Counts of how the source reads: vague names, riddling docstrings, comments, class names.

A vague name is one that says nothing of its value: it has one or two words, all of them in `VAGUE_WORDS`
(`found`, `_kept`, `far_left`). Names such as `__all__`, which Python prescribes, do not count. Docstrings say
what a function does or returns, and do not open with a question word. Comments count where they have a line
of their own, against the lines that have code (docstrings are neither). The counts are a floor: a source that
passes can still be hard to read.
"""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
# fmt: off
VAGUE_WORDS = {
    "found", "own", "owns", "known", "given", "part", "parts", "whole", "there", "here", "kept", "keep",
    "both", "its", "it", "more", "less", "many", "much", "some", "few", "other", "others", "rest", "left",
    "beside", "besides", "asked", "wanted", "going", "done", "begun", "spent", "said", "told", "brief",
    "abridged", "settled", "settle", "taken", "got", "way", "ways", "thing", "things", "all", "each",
    "every", "one", "ones", "so", "far", "again", "ready",
}
# fmt: on
QUESTION_WORD = re.compile(r"(What|Whether|How|Where|Which|Why|So|Who|When)\b")
MAX_VAGUE_NAMES = 0.005
MAX_QUESTION_DOCSTRINGS = 0.01
MIN_COMMENTS = 0.08
# The packages that are hardest to understand from code alone.
COMMENTED = ("jaxlidar/trace", "jaxlidar/planning", "jaxlidar/survey", "inversion")


# -- counting ----------------------------------------------------------------------------------------------


def defined_names(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Names that a file binds and their lines: variables, arguments, functions and classes."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id, node.lineno
        elif isinstance(node, ast.arg):
            yield node.arg, node.lineno
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name, node.lineno


def is_vague(name: str) -> bool:
    """True if a name has one or two words and all are vague; underscores at its ends do not count.

    Names of the form `__name__` are Python's and not vague.
    """
    if name.startswith("__") and name.endswith("__"):
        return False
    words = [word for word in name.lower().split("_") if word]
    return 1 <= len(words) <= 2 and VAGUE_WORDS.issuperset(words)


def docstrings(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Docstrings of a module, its classes and functions, with the lines of these."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text:
                yield text, getattr(node, "lineno", 1)


def opens_with_question_word(docstring: str) -> bool:
    """True if the first word of a docstring is a question word."""
    return QUESTION_WORD.match(docstring) is not None


def count_comment_and_code_lines(text: str) -> tuple[int, int]:
    """Numbers of lines that are a comment, and of lines that have code.

    A line of a string alone, as of a docstring, is neither.
    """
    no_code = {
        tokenize.COMMENT,
        tokenize.NL,
        tokenize.NEWLINE,
        tokenize.INDENT,
        tokenize.DEDENT,
        tokenize.ENDMARKER,
        tokenize.STRING,
    }
    # From Python 3.12 on, a formatted string is a run of tokens, strings in its fields among them.
    start_type, end_type = getattr(tokenize, "FSTRING_START", None), getattr(tokenize, "FSTRING_END", None)
    comments, code_lines, string_depth = 0, set(), 0
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        string_depth += (token.type == start_type) - (token.type == end_type)
        if token.type == tokenize.COMMENT:
            comments += token.line.lstrip().startswith("#")
        elif token.type not in no_code and token.type != end_type and string_depth == 0:
            code_lines.add(token.start[0])
    return comments, len(code_lines)


def class_definitions(*folders: Path) -> dict[str, list[str]]:
    """For each name of a class below some folders, the files and lines that define it."""
    definitions: dict[str, list[str]] = {}
    for path in sorted(path for folder in folders for path in folder.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef):
                definitions.setdefault(node.name, []).append(f"{path}:{node.lineno}")
    return definitions


def folders_with_sources(*tops: str) -> list[str]:
    """Folders below the root that hold Python files, as paths with slashes."""
    parents = {path.parent for top in tops for path in (ROOT / top).rglob("*.py")}
    return sorted(folder.relative_to(ROOT).as_posix() for folder in parents)


def sources(folder: str, *, recursive: bool = False) -> list[Path]:
    """Python files of a folder, and with `recursive` also those of the folders in it."""
    return sorted((ROOT / folder).glob("**/*.py" if recursive else "*.py"))


def vague_names(folder: str) -> tuple[list[str], float]:
    """Vague names in a folder with their lines, and their fraction of all names."""
    names = [(path, *name) for path in sources(folder) for name in defined_names(ast.parse(path.read_text()))]
    vague = [f"{path.relative_to(ROOT)}:{line}: {name}" for path, name, line in names if is_vague(name)]
    return vague, len(vague) / max(len(names), 1)


def question_docstrings(folder: str) -> tuple[list[str], float]:
    """Docstrings in a folder that open with a question word, and their fraction of all docstrings."""
    texts = [(path, *text) for path in sources(folder) for text in docstrings(ast.parse(path.read_text()))]
    questions = [
        f"{path.relative_to(ROOT)}:{line}: {text.splitlines()[0]}"
        for path, text, line in texts
        if opens_with_question_word(text)
    ]
    return questions, len(questions) / max(len(texts), 1)


# -- the source --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("folder", folders_with_sources("jaxlidar", "inversion", "tests"))
def test_names_say_what_their_values_are(folder):
    vague, fraction = vague_names(folder)
    assert fraction < MAX_VAGUE_NAMES, "\n".join(vague)


@pytest.mark.parametrize("folder", folders_with_sources("jaxlidar", "inversion"))
def test_docstrings_do_not_open_with_a_question_word(folder):
    questions, fraction = question_docstrings(folder)
    assert fraction < MAX_QUESTION_DOCSTRINGS, "\n".join(questions)


@pytest.mark.parametrize("folder", list(COMMENTED))
def test_difficult_code_has_comments(folder):
    counts = [count_comment_and_code_lines(p.read_text()) for p in sources(folder, recursive=True)]
    comments, code = map(sum, zip(*counts, strict=True))
    assert comments / code >= MIN_COMMENTS


def test_no_class_name_is_defined_twice():
    definitions = class_definitions(*(ROOT / name for name in ("jaxlidar", "inversion", "tests", "examples")))
    assert {name: lines for name, lines in definitions.items() if len(lines) > 1} == {}


# -- the counts themselves ---------------------------------------------------------------------------------


def test_vague_names_are_counted():
    source = (
        "def kept(given, *rest, share=1):\n    found = [one for one in given]\n    x.left = _the_other = 2\n"
    )
    names = [name for name, _ in defined_names(ast.parse(source))]
    assert sorted(names) == sorted(["kept", "given", "rest", "share", "found", "one", "_the_other"])
    assert [name for name in names if is_vague(name)] == [
        n for n in names if n not in ("share", "_the_other")
    ]
    assert is_vague("_far_left")
    assert is_vague("Known")
    assert not is_vague("known_values")
    assert not is_vague("_")
    assert not is_vague("__all__")
    assert is_vague("__all")


def test_question_words_are_counted():
    source = '"""What it is."""\nclass A:\n    """How."""\n\n    def f():\n        """Whatever it gives."""\n'
    texts = [text for text, _ in docstrings(ast.parse(source))]
    assert [opens_with_question_word(text) for text in texts] == [True, True, False]


def test_comment_lines_are_counted():
    source = (
        '"""Text.\n\n# Not a comment.\n"""\n# A comment.\nx = (\n    1  # beside code\n)\n\n    # Another.\n'
        'y = (\n    f"{x}"\n)\n'
    )
    assert count_comment_and_code_lines(source) == (2, 5)


def test_class_names_are_counted(tmp_path):
    (tmp_path / "a.py").write_text("class A:\n    class B:\n        pass\n")
    (tmp_path / "b.py").write_text("def f():\n    class B:\n        pass\n")
    a, b = tmp_path / "a.py", tmp_path / "b.py"
    assert class_definitions(tmp_path) == {"A": [f"{a}:1"], "B": [f"{a}:2", f"{b}:2"]}
