"""Changes that make mutants of files, for fuzz.py: each takes bytes and gives other bytes, and says what it
did."""

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
NUMBERS = (
    *(0, 1, 2, 3, 5, 7, 8, 16, 127, 128, 255, 2**15, 2**16 - 1, 10**8),
    *(2**31 - 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1),
)
VALUES = (np.nan, np.inf, -1.0, 0.0, 0.5, 1e10, 1e39, 1e308, 2.0**63, 200.0, 1e-320)
# Of .npy files, what is replaced in the header, and by what.
SHAPES = (
    *("()", "(0,)", "(1000000000,)", "(99999,99999)", "(-1,)", "(0,10**9)", "(1.5,)"),
    *("(1000000000,0)", "(2**62,4)", "((", "(3,4611686018427387904)"),
)
TYPES = (
    *("'|O'", "'<U0'", "'<f2'", "'<i8'", "'<c16'", "'<M8[s]'", "'|V8'", "'<f16'", "'[('", "'<U9'", "'|b1'"),
    *("'>f8'", "7"),
)
HEADERS = (
    *((rb"\([^)]*\)", shape.encode()) for shape in SHAPES),
    *((rb"'[<|][^']*'", kind.encode()) for kind in TYPES),
    *((b"False", b"True"), (b"shape", b"sharp"), (b"NUMPY.", b"NUMPY\x03"), (b"NUMPY.", b"NUMPY\x07")),
)


def pick(random: Random, things: Any) -> Any:
    return things[int(random.integers(len(things)))]


def somewhere(random: Random, size: int, head: int, tail: int) -> int:
    """An index below `size`, most often in the head or in the tail."""
    low, high = pick(random, [(0, head), (0, head), (size - tail, size), (0, size), (0, size)])
    return int(random.integers(max(low, 0), max(min(high, size), 1)))


def change_text(random: Random, data: bytes) -> Changed:
    """One change of a line, a word or a few bytes."""
    lines = data.decode("utf-8", "surrogateescape").split("\n")
    i = somewhere(random, len(lines), 15, 2)
    kind = pick(random, ["word", "word", "word", "insert", "delete", "double", "swap", "end", "join", "byte"])
    word = pick(random, WORDS)
    if kind == "byte":
        return change_bytes(random, data)
    if kind == "word":
        parts = re.split(r"([\s,;:()]+)", lines[i])
        parts[2 * int(random.integers((len(parts) + 1) // 2))] = word
        lines[i] = "".join(parts)
    elif kind == "insert":
        at = int(random.integers(len(lines[i]) + 1))
        lines[i] = lines[i][:at] + word + lines[i][at:]
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


def change_bytes(random: Random, data: bytes) -> Changed:
    """One change of a number in the file, of a bit, or of a stretch of bytes."""
    out = bytearray(data)
    at, length = somewhere(random, len(out), 1000, 200), int(random.integers(1, 64))
    length = len(out[at : at + length])
    kind = pick(random, ["number"] * 3 + ["bit", "byte", "end", "zeros", "ones", "noise", "cut", "copy"])
    if kind == "number":
        width, value = pick(random, [1, 2, 4, 8]), pick(random, NUMBERS)
        out[at : at + width] = (value % 256**width).to_bytes(width, "little")
        return bytes(out), f"{width} bytes at {at} are {value % 256**width}"
    if kind == "bit" and length:
        out[at] ^= 1 << int(random.integers(8))
    elif kind == "byte" and length:
        out[at] = int(random.integers(256))
    elif kind == "end":
        del out[at:]
    elif kind in ("zeros", "ones"):
        out[at : at + length] = (b"\0" if kind == "zeros" else b"\xff") * length
    elif kind == "noise":
        out[at : at + length] = random.bytes(length)
    elif kind == "cut":
        del out[at : at + length]
    elif kind == "copy":
        start = int(random.integers(len(out) + 1))
        out[at:at] = out[start : start + length]
    return bytes(out), f"{kind} at {at}"


def change_archive(random: Random, data: bytes) -> Changed:
    """One change of an array in an .npz file, whose checksums then are right; or of the archive's bytes."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, OSError, RuntimeError, ValueError, EOFError):
        members = {}
    kind = pick(random, ["archive", "archive", "archive", "bytes", "header", "value", "value", "leave out"])
    if kind == "archive" or not members:
        return change_bytes(random, data)
    name = pick(random, sorted(members))
    said = kind
    if kind == "bytes":
        members[name], said = change_bytes(random, members[name])
    elif kind == "header":
        old, new = pick(random, HEADERS)
        header, rest = members[name][:128], members[name][128:]
        changed = re.sub(old, lambda _: new, header, count=1, flags=re.DOTALL)
        # Blanks at its end make room.
        room = len(header) - len(changed)
        members[name] = (changed[:-1] + b" " * room + b"\n" if room >= 0 else changed) + rest
        said = f"header {new!r}"
    elif kind == "value":
        value = pick(random, VALUES)
        try:
            array = np.load(io.BytesIO(members[name]))
            at = int(random.integers(array.size)) if random.random() < 0.7 else slice(None)
            array.flat[at] = value
        except (ValueError, OverflowError, TypeError, EOFError, SyntaxError, MemoryError):
            return change_bytes(random, data)
        file = io.BytesIO()
        np.save(file, array)
        members[name], said = file.getvalue(), f"value {value}"
    else:
        del members[name]
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for key, content in members.items():
            archive.writestr(key, content)
    return file.getvalue(), f"{name}: {said}"


def change_hdf5(random: Random, data: bytes) -> Changed:
    """One change of a dataset in a small HDF5 file; or of the file's bytes."""
    import h5py

    if random.random() < 0.5 or len(data) > 2**19:
        return change_bytes(random, data)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "changed.h5"
        path.write_bytes(data)
        try:
            with h5py.File(path, "r+") as file:
                said = _change_dataset(random, file[pick(random, sorted(file))])
        except (OSError, RuntimeError, KeyError, ValueError, TypeError, OverflowError, AttributeError):
            return change_bytes(random, data)
        return path.read_bytes(), said


def _change_dataset(random: Random, group: Any) -> str:
    import h5py

    names: list[str] = []
    group.visititems(lambda name, node: names.append(name) if hasattr(node, "shape") else None)
    name = pick(random, sorted(names))
    array, empty = group[name][...], h5py.Empty("f8")
    kind = pick(random, ["value"] * 3 + ["all", "type", "shape", "sparse", "chunk", "link", "gone"])
    said = f"{group.name}/{name}: {kind}"
    del group[name]
    if kind in ("value", "all"):
        value = pick(random, VALUES)
        at = int(random.integers(array.size)) if kind == "value" else slice(None)
        array = array.astype(float) if random.random() < 0.5 else array
        array[at] = value if array.dtype.kind == "f" else int(np.clip(np.nan_to_num(value), 0, 2**16))
        group[name], said = array, f"{said} {value}"
    elif kind == "sparse":
        size = pick(random, [1, 2**24, 2**28, 2**33])
        chunks = pick(random, [None, (min(size, 2**20),)])
        group.create_dataset(name, (size,), array.dtype, chunks=chunks)
    elif kind == "chunk":
        length = pick(random, [1, 1000, 2**20, 2**27])
        packed = {"chunks": (length,), "maxshape": (None,), "compression": 1}
        dataset = group.create_dataset(name, array.shape, array.dtype, **packed)
        if length < 2**24:
            dataset[...] = array
    elif kind == "type":
        group[name] = array.astype(pick(random, ["i1", "f2", "S5", "u8", "i8", "c8", "bool", "f8"]))
    elif kind == "shape":
        group[name] = pick(
            random, [array[:-1], array[:0], array[:, None], array[0], np.repeat(array, 2), empty]
        )
    elif kind == "link":
        soft = h5py.SoftLink(pick(random, ["/nowhere", f"{group.name}/{name}"]))
        group[name] = pick(random, [soft, h5py.ExternalLink("none.h5", "/x")])
    return said
