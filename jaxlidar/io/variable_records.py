"""Variable length records, which files of points and of pulses alike have after their header."""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple


class VariableRecord(NamedTuple):
    """Where the content of a record lies: its user, number, place and length in bytes."""

    user: bytes
    number: int
    place: int
    length: int


def variable_records(
    path: Path, file: BinaryIO, head: struct.Struct, at: int, end: int, count: int, then: str
) -> Iterator[VariableRecord]:
    """The variable length records between two places.

    `head` unpacks user, number and length of a record; `then` names what follows at `end`.

    **Raises:** ValueError, naming the file and the record, where they have no room.
    """
    for i in range(count):
        if at + head.size > end:
            raise ValueError(f"{path}: header: {count} variable length records, but there is room for {i}")
        file.seek(at)
        user, number, length = head.unpack(file.read(head.size))
        at += head.size + length
        if length < 0 or at > end:
            raise ValueError(
                f"{path}: variable length record {i}: its {length} bytes run into the {then}, from {end} on"
            )
        yield VariableRecord(user.split(b"\0")[0], number, at - length, length)
