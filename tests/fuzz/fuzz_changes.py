"""Random changes that make mutants of files, for fuzz.py.

Each function takes the content of a file and returns the changed content with a description of the change.
"""

import io
import re
import tempfile
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

Random = np.random.Generator
Changed = tuple[bytes, str]

# Words that replace one word of a text file: numbers at and beyond limits, empty text, other alphabets,
# separators, and words longer than Python's csv module allows for one field (131072 characters).
WORDS = (
    *("nan", "inf", "-inf", "-1", "0", "1", "2", "0.5", "1e308", "1e39", "1e-320", "1e-30", "1_0", "-0.0"),
    *(
        "4294967296",
        "99999999999999999999",
        "1e10",
        "",
        "x",
        '"',
        "'",
        "\0",
        "\x0c",
        "\r",
        "٣",
        "\ufeff",
        "é",
    ),
    *(",", ";", "\t", "(", "#", "# #", "9" * 200_000, '"' + "1" * 140_000),
)
# Whole numbers that replace 1 to 8 bytes of a binary file.
INTEGERS = (
    *(0, 1, 2, 3, 5, 7, 8, 16, 127, 128, 255, 2**15, 2**16 - 1, 10**8),
    *(2**31 - 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1),
)
# Values that replace elements of arrays.
VALUES = (np.nan, np.inf, -1.0, 0.0, 0.5, 1e10, 1e39, 1e308, 2.0**63, 200.0, 1e-320)
# Shapes and types that replace those in the header of an .npy file.
SHAPES = (
    *("()", "(0,)", "(1000000000,)", "(99999,99999)", "(-1,)", "(0,10**9)", "(1.5,)"),
    *("(1000000000,0)", "(2**62,4)", "((", "(3,4611686018427387904)"),
)
TYPES = (
    *("'|O'", "'<U0'", "'<f2'", "'<i8'", "'<c16'", "'<M8[s]'", "'|V8'", "'<f16'", "'[('", "'<U9'", "'|b1'"),
    *("'>f8'", "7"),
)
# Regular expressions of what is replaced in such a header, and the replacements.
HEADER_CHANGES = (
    *((rb"\([^)]*\)", shape.encode()) for shape in SHAPES),
    *((rb"'[<|][^']*'", dtype.encode()) for dtype in TYPES),
    *((b"False", b"True"), (b"shape", b"sharp"), (b"NUMPY.", b"NUMPY\x03"), (b"NUMPY.", b"NUMPY\x07")),
)


def choose(random: Random, choices: Any) -> Any:
    """Choose an element of a sequence; all are equally probable."""
    return choices[int(random.integers(len(choices)))]


def random_index(random: Random, size: int, head: int, tail: int) -> int:
    """Draw an index below `size`.

    Its first `head` and last `tail` elements are preferred, as headers and tables of contents lie there.
    """
    low, high = choose(random, [(0, head), (0, head), (size - tail, size), (0, size), (0, size)])
    return int(random.integers(max(low, 0), max(min(high, size), 1)))


def change_text(random: Random, content: bytes) -> Changed:
    """Change one line, one word or a few bytes of a text file."""
    lines = content.decode("utf-8", "surrogateescape").split("\n")
    i = random_index(random, len(lines), 15, 2)
    kind = choose(
        random, ["word", "word", "word", "insert", "delete", "double", "swap", "end", "join", "byte"]
    )
    word = choose(random, WORDS)
    if kind == "byte":
        return change_bytes(random, content)
    if kind == "word":
        # Words have even indices, the separators between them odd ones.
        tokens = re.split(r"([\s,;:()]+)", lines[i])
        tokens[2 * int(random.integers((len(tokens) + 1) // 2))] = word
        lines[i] = "".join(tokens)
    elif kind == "insert":
        column = int(random.integers(len(lines[i]) + 1))
        lines[i] = lines[i][:column] + word + lines[i][column:]
    elif kind == "delete":
        del lines[i]
    elif kind == "double":
        lines.insert(i, lines[i])
    elif kind == "swap":
        j = int(random.integers(len(lines)))
        lines[i], lines[j] = lines[j], lines[i]
    elif kind == "end":
        lines = [*lines[:i], lines[i][: int(random.integers(len(lines[i]) + 1))]]
    else:
        lines[i : i + 2] = ["".join(lines[i : i + 2])]
    changed = "\n".join(lines).encode("utf-8", "surrogateescape")
    return changed, f"{kind} in line {i + 1}" + (f": {word[:12]!r}" if kind in ("word", "insert") else "")


def change_bytes(random: Random, content: bytes) -> Changed:
    """Change one number, one bit or some consecutive bytes of a binary file."""
    changed = bytearray(content)
    offset, length = random_index(random, len(content), 1000, 200), int(random.integers(1, 64))
    # No further than to the end of the file; 0 if the file is empty.
    length = len(changed[offset : offset + length])
    kind = choose(random, ["number"] * 3 + ["bit", "byte", "end", "zeros", "ones", "noise", "cut", "copy"])
    if kind == "number":
        width, value = choose(random, [1, 2, 4, 8]), choose(random, INTEGERS)
        changed[offset : offset + width] = (value % 256**width).to_bytes(width, "little")
        return bytes(changed), f"{width} bytes at {offset} are {value % 256**width}"
    if kind == "bit" and length:
        changed[offset] ^= 1 << int(random.integers(8))
    elif kind == "byte" and length:
        changed[offset] = int(random.integers(256))
    elif kind == "end":
        del changed[offset:]
    elif kind in ("zeros", "ones"):
        changed[offset : offset + length] = (b"\0" if kind == "zeros" else b"\xff") * length
    elif kind == "noise":
        changed[offset : offset + length] = random.bytes(length)
    elif kind == "cut":
        del changed[offset : offset + length]
    elif kind == "copy":
        start = int(random.integers(len(changed) + 1))
        changed[offset:offset] = changed[start : start + length]
    return bytes(changed), f"{kind} at {offset}"


def change_archive(random: Random, content: bytes) -> Changed:
    """Change one array of an .npz file, or the bytes of the archive.

    An archive with a changed array is written anew. Its checksums are right, so that the array is read.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, OSError, RuntimeError, ValueError, EOFError):
        members = {}
    # Checksums reveal nearly all changes of an archive's bytes: most changes are those of arrays, and some of
    # these leave numbers admissible, so that the reader gets beyond its first checks.
    kind = choose(random, ["archive", "bytes", "header", "value", "value", "swap", "swap", "remove"])
    if kind == "archive" or not members:
        return change_bytes(random, content)
    name = choose(random, sorted(members))
    description = kind
    if kind == "bytes":
        members[name], description = change_bytes(random, members[name])
    elif kind == "header":
        old, new = choose(random, HEADER_CHANGES)
        header, values = members[name][:128], members[name][128:]
        changed = re.sub(old, lambda _: new, header, count=1, flags=re.DOTALL)
        # NumPy pads headers with blanks before their final newline; they keep the length that is declared.
        padding = len(header) - len(changed)
        members[name] = (changed[:-1] + b" " * padding + b"\n" if padding >= 0 else changed) + values
        description = f"header {new!r}"
    elif kind in ("value", "swap"):
        value = choose(random, VALUES)
        try:
            array = np.load(io.BytesIO(members[name]))
            if kind == "swap":
                i, j = random.integers(array.size, size=2)
                array.flat[i], array.flat[j] = array.flat[j], array.flat[i]
            else:
                index = int(random.integers(array.size)) if random.random() < 0.7 else slice(None)
                array.flat[index] = value
                description = f"value {value}"
        except (ValueError, OverflowError, TypeError, EOFError, SyntaxError, MemoryError):
            return change_bytes(random, content)
        file = io.BytesIO()
        np.save(file, array)
        members[name] = file.getvalue()
    else:
        del members[name]
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for key, member in members.items():
            archive.writestr(key, member)
    return file.getvalue(), f"{name}: {description}"


def change_hdf5(random: Random, content: bytes) -> Changed:
    """Change one dataset of a small HDF5 file, or the bytes of the file."""
    import h5py

    if random.random() < 0.5 or len(content) > 2**19:
        return change_bytes(random, content)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "changed.h5"
        path.write_bytes(content)
        try:
            # Changes of type overflow: that is their purpose.
            with np.errstate(all="ignore"), h5py.File(path, "r+") as file:
                description = _change_dataset(random, file[choose(random, sorted(file))])
        except (OSError, RuntimeError, KeyError, ValueError, TypeError, OverflowError, AttributeError):
            return change_bytes(random, content)
        return path.read_bytes(), description


def _change_dataset(random: Random, group: Any) -> str:
    """Replace one dataset of a group: by other values, another type or shape, a link, or none at all."""
    import h5py

    names: list[str] = []
    group.visititems(lambda name, node: names.append(name) if hasattr(node, "shape") else None)
    name = choose(random, sorted(names))
    if group[name].size > 2**20:
        # An earlier change made it sparse. Changed, it would be stored, and fill the memory for its size.
        raise ValueError(f"{group.name}/{name} is too large to be changed")
    array, empty = group[name][...], h5py.Empty("f8")
    kind = choose(random, ["value"] * 3 + ["all", "type", "shape", "sparse", "chunk", "link", "gone"])
    description = f"{group.name}/{name}: {kind}"
    del group[name]
    if kind in ("value", "all"):
        value = choose(random, VALUES)
        index = int(random.integers(array.size)) if kind == "value" else slice(None)
        array = array.astype(float) if random.random() < 0.5 else array
        array.flat[index] = value if array.dtype.kind == "f" else int(np.clip(np.nan_to_num(value), 0, 2**16))
        group[name], description = array, f"{description} {value}"
    elif kind == "sparse":
        # It declares its size and holds no values.
        size = choose(random, [1, 2**24, 2**28, 2**33])
        chunks = choose(random, [None, (min(size, 2**20),)])
        group.create_dataset(name, (size,), array.dtype, chunks=chunks)
    elif kind == "chunk":
        # A compressed chunk is unpacked as a whole, whatever the shape of the dataset.
        length = choose(random, [1, 1000, 2**20, 2**27])
        packed = {"chunks": (length,), "maxshape": (None,), "compression": 1}
        dataset = group.create_dataset(name, array.shape, array.dtype, **packed)
        if length < 2**24:
            dataset[...] = array
    elif kind == "type":
        group[name] = array.astype(choose(random, ["i1", "f2", "S5", "u8", "i8", "c8", "bool", "f8"]))
    elif kind == "shape":
        group[name] = choose(
            random, [array[:-1], array[:0], array[:, None], array[0], np.repeat(array, 2), empty]
        )
    elif kind == "link":
        # To nowhere, to itself, or to a file that does not exist.
        soft = h5py.SoftLink(choose(random, ["/nowhere", f"{group.name}/{name}"]))
        group[name] = choose(random, [soft, h5py.ExternalLink("none.h5", "/x")])
    return description
