"""Readers of all kinds of files read or refuse mutants, and the fuzzing detects planted faults."""

import sys

import pytest

from tests.fuzz.fuzz import (
    DEFAULT_COUNTS,
    GOOD_VERDICTS,
    fuzz_reader,
    mutants,
    read_and_judge,
    reader_of,
)
from tests.fuzz.fuzz_kinds import KINDS, PLANTED_VERDICTS

FILE_KINDS = [name for name in KINDS if name != "planted"]
# Optional packages that a kind of file needs.
REQUIRED_PACKAGES = {"laz": "lazrs", "tiff": "rasterio"}
linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="children are bounded on Linux only")


def skip_without_package(name):
    """Skip a test if the package that a kind of file needs is not installed."""
    if name in REQUIRED_PACKAGES:
        pytest.importorskip(REQUIRED_PACKAGES[name])


@pytest.fixture
def judge(tmp_path):
    """A function that reads the first mutants of small files in this process.

    It returns a verdict and a message for each (see `fuzz.read_and_judge`).
    """

    def judge(name, count):
        skip_without_package(name)
        kind = KINDS[name]
        results = []
        for number, content, _ in mutants(name, 0, count, recorded=False):
            path = tmp_path / f"{name}-{number}{kind.suffix}"
            path.write_bytes(content)
            results.append(read_and_judge(kind, reader_of(kind), path))
        return results

    return judge


@pytest.mark.parametrize("name", FILE_KINDS)
def test_mutants_of_small_files_are_read_or_refused(name, judge):
    results = judge(name, 60)
    assert not [(verdict, message) for verdict, message in results if verdict not in GOOD_VERDICTS]
    assert {verdict for verdict, _ in results} == set(GOOD_VERDICTS)


def test_planted_faults_are_detected_in_one_process(judge):
    harmless = PLANTED_VERDICTS[: PLANTED_VERDICTS.index("memory")]
    assert tuple(verdict for verdict, _ in judge("planted", len(harmless))) == harmless


@linux
@pytest.mark.slow
@pytest.mark.parametrize("name", FILE_KINDS)
def test_mutants_are_read_or_refused_in_child_processes(name):
    skip_without_package(name)
    outcomes = fuzz_reader(name, DEFAULT_COUNTS[KINDS[name].format])
    assert not [outcome for outcome in outcomes if outcome.verdict not in GOOD_VERDICTS]
    for good_verdict in GOOD_VERDICTS:
        assert sum(outcome.verdict == good_verdict for outcome in outcomes) > 10


@linux
@pytest.mark.slow
def test_planted_faults_are_detected_in_child_processes():
    outcomes = fuzz_reader("planted", 2 * len(PLANTED_VERDICTS))
    assert [outcome.verdict for outcome in outcomes] == [*PLANTED_VERDICTS, *PLANTED_VERDICTS]
