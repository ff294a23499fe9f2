"""Reader of forest inventories: text tables with a row for each tree."""

import os

from jaxlidar._fields.crs import crs_name
from jaxlidar.formats.text import read_table
from jaxlidar.plants.inventory import Inventory, inventory_of_columns


def read_inventory(path: str | os.PathLike[str], *, crs: str | int | None = None) -> Inventory:
    r"""Read the trees of a forest inventory from a text table with a row for each tree.

    **Arguments:**

    - `path`: a text file of comma-, semicolon- or tab-separated values. Its first line names the columns: x,
      y and height, and where they are known species, z, diameter (also dbh), crown (crown diameter) and
      leaf_area, in any order and case. Lengths are in m, or in the unit at the end of the name, as in
      "dbh [cm]" or "dbh_cm"; leaf areas in m2. Cells of diameter and crown may be empty. Further columns are
      not read.
    - `crs`: coordinate reference system of x and y, in metres, such as "EPSG:32633", or its EPSG number.
      Default None: not known.

    **Returns:** an `Inventory`, for `jaxlidar.stand_from_inventory`.

    **Raises:** FileNotFoundError where there is no such file. ValueError, naming the file and the line, for
    columns that are missing or ambiguous, units that are not known, rows of another length, and cells that
    are no numbers or outside of their range; and for a `crs` that is not known or not in metres.

    **Example:**

    >>> import pathlib, tempfile
    >>> import jaxlidar.io
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "plot.csv"
    >>> _ = path.write_text("tree,species,x,y,height,dbh_cm\n1,beech,2.5,7.0,21.4,35\n2,oak,8,3,18,\n")
    >>> inventory = jaxlidar.io.read_inventory(path)
    >>> inventory.species, inventory.height.tolist(), inventory.diameter.tolist()
    (('beech', 'oak'), [21.4, 18.0], [0.35000000000000003, nan])
    """
    system = crs_name(crs)
    path, names, rows = read_table(path)
    cells = dict(rows)
    columns = list(zip(*cells.values())) or [()] * len(names)
    places = [f"{path}: line {number}" for number in cells]
    return inventory_of_columns(f"{path}: line 1", names, columns.__getitem__, places)._replace(crs=system)
