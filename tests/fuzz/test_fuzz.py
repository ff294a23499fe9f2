"""Mutants of every kind of file are read well or refused by name; what the hunt is to find, it finds."""

import sys

import pytest

from tests.fuzz.fuzz import FEW, GOOD, hunt, mutants, reader_of, verdict
from tests.fuzz.fuzz_kinds import KINDS, PLANTED

FILES = [name for name in KINDS if name != "planted"]
# What reads a kind of file beside the library itself.
NEEDS = {"laz": "lazrs", "tiff": "rasterio"}
linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="children are bounded on Linux only")


@pytest.fixture
def verdicts(tmp_path):
    """Gives the verdict and the message for the first mutants of small files, read in this process."""

    def read_all(name, count):
        if name in NEEDS:
            pytest.importorskip(NEEDS[name])
        kind = KINDS[name]
        for number, data, _ in mutants(name, 0, count, recorded=False):
            path = tmp_path / f"{name}-{number}{kind.ending}"
            path.write_bytes(data)
            yield verdict(kind, reader_of(kind), path)

    return read_all


@pytest.mark.parametrize("name", FILES)
def test_a_few_mutants(name, verdicts):
    found = list(verdicts(name, 60))
    assert not [said for said in found if said[0] not in GOOD]
    assert {said[0] for said in found} == set(GOOD)


def test_what_is_planted_is_found_in_one_process(verdicts):
    harmless = PLANTED[: PLANTED.index("memory")]
    assert [said[0] for said in verdicts("planted", len(harmless))] == list(harmless)


@linux
@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_mutants(name):
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    outcomes = hunt(name, FEW[KINDS[name].of])
    assert not [outcome for outcome in outcomes if outcome.verdict not in GOOD]
    for good in GOOD:
        assert sum(outcome.verdict == good for outcome in outcomes) > 10


@linux
@pytest.mark.slow
def test_what_is_planted_is_found():
    assert [outcome.verdict for outcome in hunt("planted", 2 * len(PLANTED))] == [*PLANTED, *PLANTED]
