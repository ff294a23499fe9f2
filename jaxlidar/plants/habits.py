"""How trees grow: habits, which are the numbers of an L-system that branches by da Vinci's rule.

Where an axis of diameter d branches, d^p = sum of d_i^p over those that go on, with p = 2: the cross-section
is kept (da Vinci; Richter 1970, The Notebooks of Leonardo da Vinci, 394). An axis goes on as thinner wood and
gives the rest to its laterals. From any point to the tip of its axis is a length in proportion to
d^`length_exponent`, so that laterals are shorter than what they grow on, and crowns get their outline from
how the cross-section is shared. An axis ends where a fork would be thinner than `smallest_diameter`, in a
twig that tapers to exactly that. What is thinner is not wood here: shoots, on which the buds sit.

The default, `broadleaf()`, is the tree of Table 2 of the paper: 15 m tall, 0.89 m thick at the base, branches
down to 0.03 m, leaf clumps 0.06 m across.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from jaxlidar._checks import check_range
from jaxlidar.plants.lsystem import Item, LSystem, Rule, Word
from jaxlidar.plants.tree import Tree
from jaxlidar.plants.turtle import turtle

GOLDEN_ANGLE = 137.50776405
# Standard deviations in degrees: of a lateral's place round its axis, and of a shoot's turn at each bud.
DIVERGENCE_SPREAD = 15.0
SHOOT_SPREAD = 28.0
BUDS = ("bud_position", "bud_direction", "bud_radius")


@dataclass(frozen=True)
class Branching:
    """How an axis branches.

    **Arguments:**

    - `laterals`: how many at a node, 1 or more; a fork near the twigs, where so many would be too thin, has
      one. Default 1.
    - `share`: (low, high) share of the cross-section that the laterals of a node take together, within
      [0, 1]; drawn evenly for each. No lateral gets thicker than what goes on. Default (0.2, 0.5).
    - `angle`: degrees between a lateral and what goes on, 0 to 180. Where there is one lateral, both turn
      away from the axis, the thicker one less. Default 50.
    - `angle_spread`: standard deviation of `angle`, degrees. Default 8.
    - `divergence`: degrees round the axis from node to node. Default the golden angle, 137.5.
    - `bend`: standard deviation of the turns along an axis of the smallest diameter, degrees a piece of an
      internode; thicker wood bends less, by the fourth root of its diameter. Default 7.
    - `tropism`: degrees by which a horizontal piece turns up; negative is down. Default 2.

    **Raises:** ValueError for what is outside the ranges above.
    """

    laterals: int = 1
    share: tuple[float, float] = (0.2, 0.5)
    angle: float = 50.0
    angle_spread: float = 8.0
    divergence: float = GOLDEN_ANGLE
    bend: float = 7.0
    tropism: float = 2.0

    def __post_init__(self):
        check_range("laterals", self.laterals, 1)
        check_range("share", self.share, 0.0, 1.0)
        if self.share[0] > self.share[1]:
            raise ValueError(f"share = {self.share} is not (low, high) with low <= high")
        check_range("angle", self.angle, 0.0, 180.0)
        check_range("angle_spread", self.angle_spread, 0.0)
        check_range("divergence", self.divergence)
        check_range("bend", self.bend, 0.0)
        check_range("tropism", self.tropism)


@dataclass(frozen=True)
class Habit:
    """The habit of a tree: sizes and proportions from which `grow` makes individuals.

    **Arguments:**

    - `height`: m, from the base to the highest wood. Default 15.
    - `trunk_diameter`: m, at the base, of the thickest stem. Default 0.89.
    - `smallest_diameter`: m, of the branches; at most `trunk_diameter`. Default 0.03.
    - `clump_diameter`: m, of the leaves round a bud. Default 0.06.
    - `exponent`: p of da Vinci's rule, positive. Default 2.
    - `length_exponent`: of diameter, to which the lengths of axes are in proportion, positive. Default 0.8.
    - `bole`: share of the trunk's length below its first node, in [0, 1). Default 0.2.
    - `stems`: how many grow from the base, 1 or more. Default 1.
    - `stem_angle`: degrees by which they lean outward, 0 to 90. Default 0.
    - `trunk`, `branches`: how axes of order 0, and all others, branch.
    - `pieces`: segments into which an internode is divided, to bend between. Default 3.
    - `twig`: length of the twig beyond the last fork, as a share of the length that an axis as thin as
      `smallest_diameter` would have; positive. Default 0.4.
    - `shoots`: on each twig, 0 or more. Default 8.
    - `shoot_length`: m, positive. Default 0.6.
    - `shoot_angle`: degrees between shoot and twig, 0 to 180. Default 50.
    - `shoot_buds`: on each shoot, at even distances, 1 or more. Default 8.

    **Raises:** ValueError for what is outside the ranges above.
    """

    height: float = 15.0
    trunk_diameter: float = 0.89
    smallest_diameter: float = 0.03
    clump_diameter: float = 0.06
    exponent: float = 2.0
    length_exponent: float = 0.65
    bole: float = 0.08
    stems: int = 1
    stem_angle: float = 0.0
    trunk: Branching = field(default_factory=Branching)
    branches: Branching = field(default_factory=Branching)
    pieces: int = 3
    twig: float = 0.4
    shoots: int = 8
    shoot_length: float = 0.6
    shoot_angle: float = 50.0
    shoot_buds: int = 8

    def __post_init__(self):
        for name in ("height", "trunk_diameter", "smallest_diameter", "clump_diameter", "exponent"):
            check_range(name, getattr(self, name), 0.0, low_open=True)
        check_range("smallest_diameter", self.smallest_diameter, 0.0, self.trunk_diameter)
        for name in ("length_exponent", "twig", "shoot_length"):
            check_range(name, getattr(self, name), 0.0, low_open=True)
        check_range("bole", self.bole, 0.0, 1.0, high_open=True)
        check_range("stem_angle", self.stem_angle, 0.0, 90.0)
        check_range("shoot_angle", self.shoot_angle, 0.0, 180.0)
        for name, low in (("stems", 1), ("pieces", 1), ("shoots", 0), ("shoot_buds", 1)):
            check_range(name, getattr(self, name), low)

    def wood(self) -> LSystem:
        """The L-system of the wood.

        `R` is the root, `A(d)` and `B(d)` are the growing ends of trunk and branches of diameter d (m), `S`
        is a shoot yet to be; the rest is the turtle's. Lengths are relative: 1 is the trunk above the bole.
        """
        rules = [Rule("R", self._stems, random=True)]
        for symbol, how in (("A", self.trunk), ("B", self.branches)):
            rules += self._axis(symbol, how)
        return LSystem("R", rules)

    def foliage(self, wood: Word) -> LSystem:
        """The L-system that, in one step, puts shoots and buds on wood whose lengths are in m."""
        step = self.shoot_length / self.shoot_buds

        def shoot(*, rng: np.random.Generator) -> Iterator[Item]:
            count = wood.where("S").size
            for i in range(self.shoot_buds):
                yield from [("+&"[i % 2], rng.normal(0.0, SHOOT_SPREAD, count)), ("f", step)]
                yield ("J", 0.5 * self.clump_diameter)

        return LSystem(wood, [Rule("S", shoot, random=True)])

    def _path(self, diameter: Any) -> Any:
        """Relative length from where an axis has this diameter to its tip."""
        return (diameter / self.trunk_diameter) ** self.length_exponent

    def _stems(self, *, rng: np.random.Generator) -> Iterator[Item]:
        turn = rng.uniform(0.0, 360.0)
        for i in range(self.stems):
            d = self.trunk_diameter * (1.0 if i == 0 else rng.uniform(0.6, 1.0))
            lean = self.stem_angle * rng.uniform(0.4, 1.3)
            yield from ["[", ("/", turn + i * GOLDEN_ANGLE), ("&", lean)]
            yield from self._internode(self._path(d) * self.bole / (1 - self.bole), d, d, self.trunk, rng, ())
            yield from [("A", d), "]"]

    def _axis(self, symbol: str, how: Branching) -> list[Rule]:
        """Branch into as many laterals as `how` says; if they would be too thin, fork; if so again, end."""
        p, smallest = self.exponent, self.smallest_diameter
        many, two = ((n * smallest**p) ** (1 / p) for n in (how.laterals + 1, 2))

        def end(d: Any, *, rng: np.random.Generator) -> Iterator[Item]:
            yield from self._twig(d, how, rng)

        def node(laterals: int) -> Any:
            def branch(d: Any, *, rng: np.random.Generator) -> Iterator[Item]:
                yield from self._node(symbol, d, laterals, how, rng)

            return branch

        return [
            Rule(symbol, node(how.laterals), condition=lambda d: d >= many, random=True),
            Rule(symbol, node(1), condition=lambda d: (d >= two) & (d < many), random=True),
            Rule(symbol, end, condition=lambda d: d < two, random=True),
        ]

    def _node(
        self, symbol: str, d: Any, laterals: int, how: Branching, rng: np.random.Generator
    ) -> Iterator[Item]:
        n, p = len(d), self.exponent
        # Even the thinnest lateral is wood, and none is thicker than what goes on.
        low, high = (self.smallest_diameter / d) ** p, 1 / (laterals + 1)
        shares = np.clip(rng.uniform(*how.share, (laterals, n)) / laterals, np.minimum(low, high), high)
        rest = 1 - shares.sum(axis=0)
        after = d * rest ** (1 / p)
        yield from self._internode(self._path(d) - self._path(after), d, d, how, rng, ())
        yield ("/", how.divergence + rng.normal(0.0, DIVERGENCE_SPREAD, n))
        for share in shares:
            angle = np.clip(rng.normal(how.angle, how.angle_spread, n), 0.0, 180.0)
            turn = share / (share + rest) * angle if laterals == 1 else 0.0
            yield from ["[", ("&", angle - turn), ("B", d * share ** (1 / p)), "]"]
            yield (
                ("/", 360 / laterals + rng.normal(0.0, DIVERGENCE_SPREAD, n)) if laterals > 1 else ("^", turn)
            )
        yield (symbol, after)

    def _twig(self, d: Any, how: Branching, rng: np.random.Generator) -> Iterator[Item]:
        length = self._path(d) - self._path(self.smallest_diameter) * (1 - self.twig)
        # An axis of just the smallest diameter may have come out thinner by rounding.
        d, thin = np.maximum(d, self.smallest_diameter), self.smallest_diameter
        turn = rng.uniform(0.0, 360.0, len(d))
        shoots = [
            ("/", turn + i * GOLDEN_ANGLE, self.shoot_angle * (i < self.shoots - 1))
            for i in range(self.shoots)
        ]
        yield from self._internode(np.maximum(length, 0.0), d, thin, how, rng, shoots)

    def _internode(
        self, length: Any, begin: Any, end: Any, how: Branching, rng: np.random.Generator, shoots: Any
    ) -> Iterator[Item]:
        """Pieces that bend, with the shoots spread over their ends; `begin` and `end` are diameters."""
        k = self.pieces
        bend = how.bend * (self.smallest_diameter / begin) ** 0.25
        for i in range(k):
            radii = [0.5 * (begin + (end - begin) * (i + j) / k) for j in (0, 1)]
            yield from [(symbol, rng.normal(0.0, bend, np.shape(begin))) for symbol in "+&"]
            yield from [("T", how.tropism), ("F", length / k, *radii)]
            for _, roll, angle in shoots[i * len(shoots) // k : (i + 1) * len(shoots) // k]:
                yield from ["[", ("/", roll), ("&", angle), "S", "]"]


def grow(habit: Habit | None = None, *, seed: int | np.random.Generator = 0) -> Tree:
    """Grow one individual, with its base at the origin.

    The wood is rewritten until no end of it can branch, its lengths are scaled to the habit's height, then
    shoots and buds are put on. Buds whose clumps would reach below the base are left out.

    **Arguments:**

    - `habit`: a `Habit`. Default None: `broadleaf()`, the tree of Table 2.
    - `seed`: of all that is drawn, or a generator. Default 0.

    **Raises:** ValueError where the habit lets the wood grow nowhere upward.
    """
    habit = broadleaf() if habit is None else habit
    rng = np.random.default_rng(seed)
    word = habit.wood().rewrite(seed=rng)
    relative = turtle(word).height
    if not relative > 1e-6:
        raise ValueError(
            f"height = {habit.height:g} cannot be had: the wood of this habit does not grow upward"
        )
    lengths = word.parameters.copy()
    lengths[word.where("F"), 0] *= habit.height / relative
    word = replace(word, parameters=lengths)
    tree = turtle(habit.foliage(word).rewrite(1, seed=rng))
    above = tree.bud_position[:, 2] >= tree.bud_radius
    return replace(tree, **{name: getattr(tree, name)[above] for name in BUDS})


def broadleaf(**changes: Any) -> Habit:
    """A broadleaved tree grown in the open: Table 2's. `changes` are fields of `Habit` that differ."""
    return replace(Habit(), **changes)


def conifer(**changes: Any) -> Habit:
    """A spruce-like conifer: one straight trunk, whorls of branches, a conical crown. Changes as above."""
    habit = Habit(
        height=20.0,
        trunk_diameter=0.4,
        smallest_diameter=0.012,
        clump_diameter=0.04,
        length_exponent=0.9,
        bole=0.08,
        trunk=Branching(laterals=5, share=(0.14, 0.24), angle=85.0, bend=1.0, tropism=3.0),
        branches=Branching(share=(0.15, 0.35), angle=50.0, divergence=180.0, bend=4.0, tropism=0.0),
        shoots=8,
        shoot_length=0.3,
    )
    return replace(habit, **changes)


def spreading(**changes: Any) -> Habit:
    """A broadleaved tree wider than tall, as an umbrella thorn or an old oak in a field. Changes as above."""
    habit = Habit(
        height=10.0,
        trunk_diameter=0.7,
        length_exponent=0.5,
        bole=0.16,
        trunk=Branching(share=(0.45, 0.5), angle=95.0, tropism=1.0),
        branches=Branching(share=(0.35, 0.5), angle=64.0, tropism=3.0),
    )
    return replace(habit, **changes)


def shrub(**changes: Any) -> Habit:
    """A shrub of many stems from one base. Changes as above."""
    habit = Habit(
        height=2.5,
        trunk_diameter=0.05,
        smallest_diameter=0.008,
        clump_diameter=0.04,
        bole=0.1,
        stems=9,
        stem_angle=30.0,
        trunk=Branching(share=(0.2, 0.5), angle=40.0, tropism=2.0),
        branches=Branching(share=(0.2, 0.5), angle=45.0, tropism=2.0),
        shoots=5,
        shoot_length=0.25,
        shoot_buds=6,
    )
    return replace(habit, **changes)
