r"""Comparison of a table of estimates with a reference: bias, scatter, rank, and coverage of standard errors.

With differences d_i = estimate - reference over the n rows that have both:

    bias = mean(d),    rmse = sqrt(mean(d^2)),    coverage = mean(|d| <= k stderr),

rank is Spearman's correlation, and the median and the median absolute difference resist outliers. For normal
errors and k = 2 the coverage of right standard errors is 0.954.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy
from jaxtyping import Float, Shaped

from jaxlidar.extend import as_numpy, check_number
from jaxlidar.formats.tables import matching_rows
from jaxlidar.io import ShotTable

# Fewest rows of which a rank correlation is given, and the class of all rows.
_MIN_RANKED, _ALL_ROWS = 3, "all"
# Rows of statistics that are printed.
_PRINTED_ROWS = 30
# Ending of the names of standard errors.
_STDERR = "_stderr"


class ComparedColumn(NamedTuple):
    """Estimates of one quantity beside their reference, for rows that have both.

    - `reference`, `estimate`: (rows,) values.
    - `stderr`: (rows,) standard errors of the estimates; NaN where there are none.
    - `group`: (rows,) class of each row as text.
    - `unit`: of the values.

    **Example:** `jaxlidar.plot.comparison` draws columns by their names.

    >>> import inversion, numpy as np
    >>> table, product = {"ground": np.array([1.0, 2.0])}, {"ground": np.array([1.1, np.nan])}
    >>> inversion.compare(table, product, on=None).pairs["ground"].reference
    array([1.1])
    """

    reference: Float[np.ndarray, " rows"]
    estimate: Float[np.ndarray, " rows"]
    stderr: Float[np.ndarray, " rows"]
    group: Shaped[np.ndarray, " rows"]
    unit: str = ""


class ComparisonStatistics(NamedTuple):
    """Agreement of one column with its reference, over the rows of one class.

    - `column`, `group`: name of the column; the class, "all" for all rows.
    - `count`: number of rows with both values.
    - `bias`, `median`: mean and median of estimate less reference.
    - `rmse`, `median_absolute`: root mean square and median magnitude of the difference.
    - `rank`: Spearman's rank correlation; NaN for fewer than three rows, or equal values.
    - `coverage`: fraction of rows within the standard errors; NaN where there are none.

    **Example:**

    >>> import inversion
    >>> from inversion.metrics.comparison import ComparisonStatistics
    >>> row = ComparisonStatistics("ground", "all", 2, -0.1, -0.1, 0.1, 0.1, float("nan"), 1.0)
    >>> row.bias
    -0.1
    """

    column: str
    group: str
    count: int
    bias: float
    median: float
    rmse: float
    median_absolute: float
    rank: float
    coverage: float


class Comparison(NamedTuple):
    """Result of `compare`. Printed, it is a table of the statistics.

    - `statistics`: `ComparisonStatistics` of each column: of all rows first, then of each class.
    - `pairs`: by name of the column, the compared values, for `jaxlidar.plot.comparison`.
    - `sigmas`: standard errors within which a row counts as covered.

    **Example:**

    >>> import inversion, numpy as np
    >>> table = {"ground": np.array([1.0, 2.0, 3.0]), "ground_stderr": np.array([0.1, 0.1, 0.1])}
    >>> print(inversion.compare(table, {"ground": np.array([1.1, 2.0, 2.5])}, on=None))
    column                 class      rows     bias   median     rmse  |median|   rank  within 2 s.e.
    ground                 all           3    0.133        0    0.294       0.1   1.00           0.67
    """

    statistics: tuple[ComparisonStatistics, ...]
    pairs: dict[str, ComparedColumn]
    sigmas: float = 2.0

    def __str__(self) -> str:
        covered = f"within {self.sigmas:g} s.e."
        lines = [
            f"{'column':<22} {'class':<8} {'rows':>6} {'bias':>8} {'median':>8} {'rmse':>8} "
            f"{'|median|':>9} {'rank':>6} {covered:>14}"
        ]
        for row in self.statistics[:_PRINTED_ROWS]:
            lines.append(
                f"{row.column[:22]:<22} {row.group[:8]:<8} {row.count:>6} {row.bias:>8.3g} "
                f"{row.median:>8.3g} {row.rmse:>8.3g} {row.median_absolute:>9.3g} {row.rank:>6.2f} "
                f"{row.coverage:>14.2f}"
            )
        if len(self.statistics) > _PRINTED_ROWS:
            lines.append(f"... {len(self.statistics) - _PRINTED_ROWS} more rows")
        return "\n".join(lines)


def compare(
    table: Any,
    reference: Any,
    columns: Mapping[str, str] | Sequence[str] | None = None,
    *,
    on: str | None = "shot_number",
    classes: Any = None,
    sigmas: float = 2.0,
) -> Comparison:
    """Compare estimates with a reference, row by row where a number is the same.

    Rows that one of the two lacks, or where a value is NaN, are left out of that column's statistics; their
    number is `ComparisonStatistics.count`. A column of the table with the ending `_stderr` has the standard
    errors of the column before the ending; errors of the reference are not used.

    **Arguments:**

    - `table`, `reference`: `jaxlidar.io.ShotTable`s, mappings of names to arrays, data frames or datasets. A
      `ShotTable` also has the columns of its second axes, such as `rh_98`.
    - `columns`: names of the columns to compare, or a mapping of those of the table to those of the
      reference. Default None: all columns of numbers that both have, of one dimension.
    - `on`: the column of whole numbers by which rows belong together. Default "shot_number". None: row by
      row.
    - `classes`: the name of a column of the table, or (rows,) classes of its rows, such as land cover: they
      have statistics of their own. Default None: none.
    - `sigmas`: standard errors within which a row is covered, above 0. Default 2.

    **Returns:** a `Comparison`.

    **Raises:** ValueError for columns that a table lacks, numbers that the reference has twice, tables of
    different lengths with `on=None`, and tables without a column in common.

    **Example:**

    >>> import inversion, numpy as np
    >>> table = {"shot_number": np.array([7, 8, 9]), "pai": np.array([1.0, 2.0, 3.2])}
    >>> product = {"shot_number": np.array([9, 7, 8]), "pai": np.array([3.0, 1.1, 2.1])}
    >>> agreement = inversion.compare(table, product, ["pai"])
    >>> print(f"bias {agreement.statistics[0].bias:.2f}, rank {agreement.statistics[0].rank:.1f}")
    bias 0.00, rank 1.0
    """
    check_number("sigmas", sigmas, 0.0, low_open=True)
    estimates, references = _columns(table), _columns(reference)
    if columns is None:
        names = {n: n for n in estimates if n in references and n != on and not n.endswith(_STDERR)}
        names = {n: n for n in names if all(_is_numeric(t[n]) for t in (estimates, references))}
        # Levels of a second axis are compared where they are asked for: there may be hundreds.
        if isinstance(table, ShotTable):
            names = {n: n for n in names if n in table}
        if not names:
            raise ValueError("columns = None: the two tables have no column of numbers in common")
    else:
        names = dict(columns) if isinstance(columns, Mapping) else {name: name for name in columns}
    for name, reference_name in names.items():
        _check_column("table", estimates, name)
        _check_column("reference", references, reference_name)
    count = len(estimates[next(iter(names))]) if on is None else len(_column("table", estimates, on))
    if on is None:
        rows = np.arange(count)
        size = len(references[next(iter(names.values()))])
        if size != count:
            raise ValueError(
                f"on = None: the tables have {count} and {size} rows; admissible is the same number"
            )
    else:
        rows = matching_rows(_column("table", estimates, on), _column("reference", references, on), on)
    group = _classes(classes, estimates, count)
    units = (
        {name: column.unit for name, column in table.flat().items()} if isinstance(table, ShotTable) else {}
    )
    pairs, statistics = {}, []
    for name, reference_name in names.items():
        estimate = as_numpy(estimates[name], name)
        expected = np.append(as_numpy(references[reference_name], reference_name), np.nan)
        # The row -1, of shots that the reference lacks, is the NaN at the end.
        expected = expected[rows]
        stderr = np.full(count, np.nan)
        if name + _STDERR in estimates:
            stderr = as_numpy(estimates[name + _STDERR], name + _STDERR)
        both = np.isfinite(estimate) & np.isfinite(expected)
        pair = ComparedColumn(expected[both], estimate[both], stderr[both], group[both], units.get(name, ""))
        pairs[name] = pair
        statistics.append(_statistics(name, _ALL_ROWS, pair, sigmas))
        if classes is not None:
            for label in np.unique(pair.group):
                of_class = pair.group == label
                members = ComparedColumn(*(a[of_class] for a in pair[:4]), unit=pair.unit)
                statistics.append(_statistics(name, str(label), members, sigmas))
    return Comparison(tuple(statistics), pairs, float(sigmas))


def _statistics(name: str, group: str, pair: ComparedColumn, sigmas: float) -> ComparisonStatistics:
    """Return the statistics of the rows of one class."""
    difference = pair.estimate - pair.reference
    if difference.size == 0:
        return ComparisonStatistics(name, group, 0, *[float("nan")] * 6)
    rank = np.nan
    if difference.size >= _MIN_RANKED and np.ptp(pair.estimate) > 0 and np.ptp(pair.reference) > 0:
        rank = float(scipy.stats.spearmanr(pair.estimate, pair.reference).statistic)
    has_error = np.isfinite(pair.stderr)
    is_covered = np.abs(difference) <= sigmas * pair.stderr
    return ComparisonStatistics(
        name,
        group,
        difference.size,
        bias=float(difference.mean()),
        median=float(np.median(difference)),
        rmse=float(np.sqrt(np.mean(difference**2))),
        median_absolute=float(np.median(np.abs(difference))),
        rank=float(rank),
        coverage=float(np.mean(is_covered[has_error])) if has_error.any() else float("nan"),
    )


def _columns(table: Any) -> Mapping[str, np.ndarray]:
    """Return the columns of a table of any kind, of one dimension, by name."""
    if isinstance(table, ShotTable):
        return {name: column.values for name, column in table.flat().items()}
    names = list(table.keys()) if hasattr(table, "keys") else None
    if names is None:
        raise TypeError(
            f"table is a {type(table).__name__}; admissible is a ShotTable, a mapping of arrays, a data "
            "frame or a dataset"
        )
    return {str(name): array for name in names if (array := np.asarray(table[name])).ndim == 1}


def _is_numeric(values: np.ndarray) -> bool:
    return values.dtype.kind in "iuf"


def _column(table_name: str, columns: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    """Return a column. **Raises:** ValueError, naming those that there are."""
    if name not in columns:
        raise ValueError(f"{table_name} has no column {name!r}; admissible are {', '.join(columns)}")
    return columns[name]


def _check_column(table_name: str, columns: Mapping[str, np.ndarray], name: str) -> None:
    """Refuse a column that is missing or has no numbers."""
    if not _is_numeric(values := _column(table_name, columns, name)):
        raise ValueError(f"{table_name}: {name} has the type {values.dtype}; admissible are numbers")


def _classes(classes: Any, columns: Mapping[str, np.ndarray], count: int) -> np.ndarray:
    """Return the class of each row as text. **Raises:** ValueError for another number of rows."""
    if classes is None:
        return np.full(count, _ALL_ROWS)
    values = _column("table", columns, classes) if isinstance(classes, str) else np.asarray(classes)
    if values.shape != (count,):
        raise ValueError(f"classes has shape {values.shape}; admissible is {(count,)}")
    return values.astype(str)
