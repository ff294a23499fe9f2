"""L-systems: words of the textbook, parametric, conditional and stochastic rules, and the turtle's moves."""

import numpy as np
import pytest
from scipy import stats

import jaxlidar as jl
from jaxlidar.plants.lsystem import Symbol, Word

ALGAE = [jl.Rule("A", lambda: "AB"), jl.Rule("B", lambda: "A")]


def test_algae_grow_by_fibonacci_numbers():
    system = jl.LSystem("A", ALGAE)
    assert [str(system.rewrite(n)) for n in range(5)] == ["A", "AB", "ABA", "ABAAB", "ABAABABA"]
    assert [len(system.rewrite(n)) for n in range(12)] == [1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144, 233]


def test_a_symbol_may_vanish():
    system = jl.LSystem("AXA", [jl.Rule("X", lambda: "")])
    assert str(system.rewrite()) == "AA"
    assert len(jl.LSystem("X", system.rules).rewrite()) == 0


def test_words_hold_symbols():
    word = Word.of(["AB", ("F", 1, 2.5), "[", "]"])
    assert str(word) == "ABF(1,2.5)[]"
    assert list(word)[1:3] == [Symbol("B"), Symbol("F", (1.0, 2.5))]
    assert word.alphabet == "ABF[]"
    assert word.where("F").tolist() == [2]


def test_parametric_rules_rewrite_each_symbol_by_its_parameters():
    # The example of The Algorithmic Beauty of Plants, section 1.10.
    rules = [
        jl.Rule("A", lambda x, y: [("A", 2 * x, x + y)], condition=lambda x, y: y <= 3),
        jl.Rule("A", lambda x, y: [("B", x), ("A", x / y, 0)], condition=lambda x, y: y > 3),
        jl.Rule("B", lambda x: "C", condition=lambda x: x < 1),
        jl.Rule("B", lambda x: [("B", x - 1)], condition=lambda x: x >= 1),
    ]
    system = jl.LSystem([("B", 2), ("A", 4, 4)], rules)
    assert [str(system.rewrite(n)) for n in range(5)] == [
        "B(2)A(4,4)",
        "B(1)B(4)A(1,0)",
        "B(0)B(3)A(2,1)",
        "CB(2)A(4,3)",
        "CB(1)A(8,7)",
    ]


def test_growth_ends_when_no_condition_holds():
    rule = jl.Rule("A", lambda n: ["[", ("A", n - 1), "]", ("A", n - 2)], condition=lambda n: n >= 2)
    word = jl.LSystem([("A", 6)], [rule]).rewrite()
    assert [m.parameters[0] for m in word if m.symbol == "A"] == [1, 0, 1, 1, 0, 1, 0, 1, 1, 0, 1, 1, 0]


def test_stochastic_rules_are_chosen_by_weight():
    rules = [
        jl.Rule("A", lambda: "X", weight=1.0),
        jl.Rule("A", lambda: "Y", weight=2.0),
        jl.Rule("A", lambda: "Z", weight=5.0),
    ]
    word = jl.LSystem("A" * 80_000, rules).rewrite(1, seed=1)
    counts = [word.where(symbol).size for symbol in "XYZ"]
    assert stats.chisquare(counts, [10_000, 20_000, 50_000]).pvalue > 1e-3
    # The test rejects weights that differ by a few per cent.
    assert stats.chisquare(counts, [10_600, 19_400, 50_000]).pvalue < 1e-3
    # Neighbours are chosen independently.
    is_z = word.codes == ord("Z")
    pairs = np.count_nonzero(is_z[:-1] & is_z[1:])
    assert abs(pairs - 79_999 * 0.625**2) < 4 * np.sqrt(79_999 * 0.625**2)


def test_weights_may_depend_on_parameters_and_vanish():
    rules = [
        jl.Rule("A", lambda n: "X", weight=lambda n: n),
        jl.Rule("A", lambda n: "Y", weight=lambda n: 1 - n),
    ]
    assert str(jl.LSystem([("A", 0), ("A", 1), ("A", 0)], rules).rewrite()) == "YXY"
    weightless = jl.Rule("A", lambda n: "X", weight=lambda n: 0 * n)
    assert str(jl.LSystem([("A", 3)], [weightless]).rewrite()) == "A(3)"


def test_random_parameters_come_from_the_seed():
    rule = jl.Rule("A", lambda n, rng: [("B", rng.normal(n))], random=True)
    system = jl.LSystem([("A", 2.0)] * 4000, [rule])
    drawn = system.rewrite(seed=3).parameters[:, 0]
    assert stats.kstest(drawn, stats.norm(2.0).cdf).pvalue > 1e-3
    assert np.array_equal(drawn, system.rewrite(seed=3).parameters[:, 0])
    assert not np.array_equal(drawn, system.rewrite(seed=4).parameters[:, 0])


def test_koch_curve():
    word = jl.LSystem("F", [jl.Rule("F", lambda: "F+F--F+F")]).rewrite(3)
    tree = jl.turtle(word, angle=60, length=1 / 27, heading=(1, 0, 0), left=(0, 1, 0))
    assert len(tree.start) == 64
    assert np.allclose(tree.end[-1], [1, 0, 0])
    assert np.allclose(tree.start[32], [0.5, np.sqrt(3) / 6, 0])
    assert np.allclose(tree.end[:-1], tree.start[1:])
    assert np.isclose(tree.end[:, 1].max(), np.sqrt(3) / 6)


def test_a_binary_tree_by_ones_own_rules():
    """The example of `LSystem`: every fork has a branch of 0.8 and one of 0.6 times its radius."""
    grow = jl.Rule(
        "A",
        lambda r: [("F", 50 * r, r), "[", ("+", 35), ("A", 0.8 * r), "]", ("-", 20), "/", ("A", 0.6 * r)],
        condition=lambda r: r >= 0.01,
    )
    end = jl.Rule("A", lambda r: "J", condition=lambda r: r < 0.01)
    tree = jl.turtle(jl.LSystem([("A", 0.1)], [grow, end]).rewrite(), angle=90)
    forks = np.bincount(tree.parent[1:], minlength=len(tree.parent))
    assert len(tree.bud_radius) == len(tree.start) + 1 == np.sum(2 - forks)
    children = tree.parent[1:]
    ratio = tree.radius_start[1:] / tree.radius_end[children]
    assert np.all(np.isclose(ratio, 0.8) | np.isclose(ratio, 0.6))
    assert np.array_equal(tree.order[1:] - tree.order[children], np.isclose(ratio, 0.8).astype(int))


@pytest.mark.parametrize(
    ("moves", "heading", "left"),
    [
        ("", (1, 0, 0), (0, 1, 0)),
        ("+", (0, 1, 0), (-1, 0, 0)),
        ("-", (0, -1, 0), (1, 0, 0)),
        ("&", (0, 0, -1), (0, 1, 0)),
        ("^", (0, 0, 1), (0, 1, 0)),
        ("\\", (1, 0, 0), (0, 0, -1)),
        ("/", (1, 0, 0), (0, 0, 1)),
        ("|", (-1, 0, 0), (0, -1, 0)),
        ("/+", (0, 0, 1), (-1, 0, 0)),
        ("T", (0, 0, 1), (0, 1, 0)),
    ],
)
def test_turns(moves, heading, left):
    """A turtle that looks east, with north at its left: a step, then one after a turn left."""
    tree = jl.turtle(moves + "F+FJ", heading=(1, 0, 0), left=(0, 1, 0))
    steps = tree.end - tree.start
    assert np.allclose(steps, [heading, left], atol=1e-12)
    assert np.allclose(tree.bud_direction, [left], atol=1e-12)
    assert np.allclose(tree.bud_position, tree.end[-1:])


def test_tropism_bends_in_proportion_to_the_sine():
    zenith = np.deg2rad(30)
    heading = (np.sin(zenith), 0, np.cos(zenith))
    for angle in (20.0, -20.0):
        word = Word.of([("T", angle), "F"])
        tree = jl.turtle(word, heading=heading, left=(0, 1, 0))
        bent = np.arctan2(tree.end[0, 0], tree.end[0, 2])
        assert np.isclose(np.rad2deg(bent), 30 - 0.5 * angle)
    assert np.allclose(jl.turtle("TF").end, [[0, 0, 1]])


def test_rolling_to_the_horizontal():
    tree = jl.turtle([("/", 77), "$", ("+", 90), "F"], heading=(1, 0, 1), left=(0, 1, 0))
    assert np.allclose(tree.end, [[0, 1, 0]])
    assert np.allclose(jl.turtle("$F").end, [[0, 0, 1]])


def test_segments_buds_parents_and_orders():
    word = Word.of(
        [("F", 2, 0.2), "[", ("+", 90), ("F", 1, 0.1, 0.05), "FJ]X", ("f", 1), ("!", 0.03), "F", ("J", 0.07)]
    )
    tree = jl.turtle(word, position=(0, 0, 5), heading=(0, 0, 1), left=(1, 0, 0))
    assert np.allclose(tree.start, [[0, 0, 5], [0, 0, 7], [1, 0, 7], [0, 0, 8]])
    assert np.allclose(tree.end, [[0, 0, 7], [1, 0, 7], [2, 0, 7], [0, 0, 9]])
    assert np.allclose(tree.radius_start, [0.2, 0.1, 0.05, 0.03])
    assert np.allclose(tree.radius_end, [0.2, 0.05, 0.05, 0.03])
    assert tree.parent.tolist() == [-1, 0, 1, 0]
    assert tree.order.tolist() == [0, 1, 1, 0]
    assert np.allclose(tree.bud_position, [[2, 0, 7], [0, 0, 9]])
    assert tree.bud_radius.tolist() == [0.03, 0.07]


def test_empty_words_are_trees_without_segments():
    tree = jl.turtle("")
    assert (tree.height, tree.trunk_diameter, tree.wood_volume) == (0, 0, 0)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Word.of([("AB", 1)]), "symbol in the word = 'AB' is not one character"),
        (lambda: Word.of([("A", np.nan)]), "parameter 1 of 'A' in the word = nan is outside"),
        (lambda: jl.Rule("AB", lambda: "A"), "symbol = 'AB' is not one character"),
        (lambda: jl.Rule("A", lambda: "A", weight=0.0), "weight = 0 is outside"),
        (lambda: jl.LSystem("A", ALGAE).rewrite(-1), "steps = -1 is outside"),
        (lambda: jl.LSystem("A", ALGAE).rewrite(max_modules=1000), "max_modules = 1000: the word would have"),
        (lambda: jl.LSystem("A", [jl.Rule("A", lambda: "A")]).rewrite(max_steps=9), "max_steps = 9"),
        (
            lambda: jl.LSystem([("A", 0)], [jl.Rule("A", lambda n: [("B", n + np.inf)])]).rewrite(),
            "parameter 1 of 'B' in a successor of 'A' = inf is outside",
        ),
        (
            lambda: jl.LSystem([("A", 1)], [jl.Rule("A", lambda n: "B", weight=lambda n: -n)]).rewrite(),
            "weight of a rule for 'A' = -1 is outside",
        ),
        (
            lambda: jl.LSystem(["A", ("A", 1)], [jl.Rule("A", lambda n: "B")]).rewrite(),
            "'A' occurs with 0 and with 1 parameters",
        ),
        (lambda: jl.turtle("F]"), "without its '\\['"),
        (lambda: jl.turtle("[F[F]"), "has 1 '\\[' without"),
        (lambda: jl.turtle("F", radius=0.0), "radius = 0 is outside"),
        (lambda: jl.turtle("F", bud_radius=-1.0), "bud_radius = -1 is outside"),
        (lambda: jl.turtle("F", angle=np.nan), "angle = nan is outside"),
        (lambda: jl.turtle("F", heading=(0, 0, 0)), "length of heading = 0 is outside"),
        (lambda: jl.turtle("F", heading=(1, 0, 0), left=(2, 0, 0)), "left = .* is along the heading"),
        (lambda: jl.turtle([("F", 1, -0.1)]), "radius_start = -0.1 is outside"),
    ],
)
def test_inadmissible_input_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
