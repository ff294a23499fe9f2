"""Comparison of tables: statistics of known differences, rows by number, and the picture of them."""

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

import inversion
import jaxlidar as jl
from jaxlidar.formats.tables import ColumnAxis
from jaxlidar.io import Column, ShotTable

matplotlib.use("agg")


def test_statistics_are_those_of_the_differences():
    random = np.random.default_rng(0)
    truth, sigma = random.normal(size=4000), 0.5
    estimate = truth + 0.1 + sigma * random.normal(size=4000)
    table = {"h": estimate, "h_stderr": np.full(4000, sigma)}
    (row,) = inversion.compare(table, {"h": truth}, on=None).statistics
    assert row.count == 4000
    assert row.bias == pytest.approx(0.1, abs=4 * sigma / 63)
    assert row.rmse == pytest.approx(np.hypot(0.1, sigma), rel=0.04)
    # With a bias of 0.2 sigma, P(|d| < 2 sigma) = 0.950.
    assert row.coverage == pytest.approx(0.950, abs=0.012)
    assert row.rank == pytest.approx(6 / np.pi * np.arcsin(0.5 / np.hypot(1, sigma)), abs=0.03)
    # Negative control: errors that are half as large do not cover as often.
    table["h_stderr"] = table["h_stderr"] / 2
    assert inversion.compare(table, {"h": truth}, on=None).statistics[0].coverage < 0.72


def test_rows_belong_together_by_number_and_have_classes():
    axis = ColumnAxis("percentile", np.array([98.0]))
    table = ShotTable(
        {
            "shot_number": Column(np.array([5, 6, 7, 8])),
            "ground": Column(np.array([1.0, 2.0, np.nan, 4.0]), "m"),
            "quality": Column(np.array(["good", "bad", "good", "good"])),
            "rh": Column(np.array([[10.0], [20.0], [30.0], [40.0]]), "m", "", axis),
        }
    )
    product = {
        "shot_number": np.array([8, 6, 5]),
        "elev": np.array([3.5, 1.0, 1.0]),
        "rh_98": np.array([41, 22, 10]),
    }
    names = {"ground": "elev", "rh_98": "rh_98"}
    comparison = inversion.compare(table, product, names, classes="quality")
    by_key = {(row.column, row.group): row for row in comparison.statistics}
    assert by_key["ground", "all"].count == 3
    assert by_key["ground", "good"].bias == pytest.approx(0.25)
    assert by_key["ground", "bad"].bias == 1.0
    assert by_key["rh_98", "all"].bias == pytest.approx(-1.0)
    assert np.isnan(by_key["ground", "all"].coverage)
    assert comparison.pairs["ground"].unit == "m"
    assert len(str(comparison).splitlines()) == 7
    axes = jl.plot.comparison(comparison.pairs, Figure().subplots(1, 2))
    assert [ax.get_xlabel() for ax in axes] == ["reference ground (m)", "reference rh_98 (m)"]
    assert {text.get_text() for text in axes[0].get_legend().get_texts()} == {"good", "bad"}
    assert axes[0].get_title().startswith("3 rows, bias 0.5, rmse")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"columns": ["nothing"]}, "table has no column 'nothing'; admissible are n, h"),
        ({"columns": {"h": "nothing"}}, "reference has no column 'nothing'"),
        ({"on": "shot_number"}, "table has no column 'shot_number'"),
        ({"sigmas": 0.0}, "sigmas = 0"),
        ({"classes": np.zeros(5)}, r"classes has shape \(5,\); admissible is \(2,\)"),
        ({"reference": {"n": np.array([1, 1]), "h": np.zeros(2)}}, "n = 1 is that of 2 rows"),
        ({"reference": {"n": np.array([1, 2])}}, "no column of numbers in common"),
    ],
)
def test_what_cannot_be_compared_is_refused(arguments, message):
    table = {"n": np.array([1, 2]), "h": np.array([1.0, 2.0])}
    with pytest.raises(ValueError, match=message):
        inversion.compare(**{"table": table, "reference": table, "on": "n", **arguments})
