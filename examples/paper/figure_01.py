"""Figure 1 and Table 2: the default tree of the L-system, with and without leaves.

python examples/paper/figure_01.py [--out figures] [--small]
"""

import numpy as np
from _common import options, plt, save, table

import jaxlidar as jl
import jaxlidar.plot


def main(argv=None) -> dict[str, float]:
    arguments = options(__doc__, argv)
    tree = jl.grow(jl.broadleaf(), seed=0)
    # Name: the paper's value and the tree's, m.
    sizes = {
        "height": (15.0, tree.height),
        "trunk width at base": (0.89, tree.trunk_diameter),
        "smallest branches": (0.03, tree.smallest_diameter),
        "leaf clump diameter": (0.06, float(2 * np.median(tree.bud_radius))),
    }
    table(("m", "paper", "tree"), [(name, *pair) for name, pair in sizes.items()])
    print(f"{len(tree.start)} segments, {len(tree.bud_radius)} leaf clumps")
    for name, (paper, value) in sizes.items():
        assert abs(value / paper - 1) < 0.01, name

    figure = plt.figure(figsize=(7.0, 4.0), layout="constrained")
    axes = [figure.add_subplot(1, 2, i, projection="3d") for i in (1, 2)]
    jaxlidar.plot.leaf_on_and_off(tree, axes, **({"max_buds": 2000} if arguments.small else {}))
    save(figure, arguments.out / "paper_figure_01.png")
    return {name: value for name, (_, value) in sizes.items()}


if __name__ == "__main__":
    main()
