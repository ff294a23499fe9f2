"""L-systems: words of modules, and rules that rewrite all modules of a word at once.

A module is a symbol with numbers, a word is a sequence of modules, and a rule replaces a module by a word
(Prusinkiewicz and Lindenmayer 1990, The Algorithmic Beauty of Plants, chapter 1). Rules are parametric (they
compute with the module's numbers), conditional, and stochastic (those that apply compete by weight); they do
not look at neighbours. What the symbols mean in space is in `jaxlidar.turtle`.

All modules of one symbol are rewritten together, so that a rule sees arrays, one element a module: write
NumPy expressions, and write cases as rules with conditions. A binary tree whose branches end at 1 cm:

    import jaxlidar as jl

    grow = jl.Rule(
        "A",
        lambda r: [("F", 50 * r, r), "[", ("+", 35), ("A", 0.8 * r), "]", ("-", 20), "/", ("A", 0.6 * r)],
        condition=lambda r: r >= 0.01,
    )
    end = jl.Rule("A", lambda r: "J", condition=lambda r: r < 0.01)
    word = jl.LSystem([("A", 0.1)], [grow, end]).rewrite()
    tree = jl.turtle(word, angle=90)
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt32

# A run of plain symbols, or one symbol with its numbers (in a rule's successor: arrays).
Item = str | tuple[Any, ...]


class Module(NamedTuple):
    """A symbol, one character, with its parameters."""

    symbol: str
    parameters: tuple[float, ...] = ()

    def __str__(self) -> str:
        return self.symbol + (f"({','.join(f'{p:g}' for p in self.parameters)})" if self.parameters else "")


@dataclass(frozen=True, eq=False)
class Word:
    """A sequence of modules, held as arrays. `Word.of` makes one; iterating gives each `Module`.

    **Arguments:**

    - `codes`: (n,) Unicode code points of the symbols.
    - `arity`: (n,) how many parameters each module has.
    - `parameters`: (n, p) parameters, NaN beyond a module's arity.
    """

    codes: UInt32[np.ndarray, " n"]
    arity: Int[np.ndarray, " n"]
    parameters: Float[np.ndarray, "n p"]

    @staticmethod
    def of(items: str | Iterable[Item]) -> "Word":
        """From a string of plain symbols, or a sequence of strings and of (symbol, parameter, ...).

        **Raises:** ValueError for symbols that are not one character and parameters that are not finite.
        """
        codes, arity, parameters = _successor(items, 1, "the word")
        return Word(codes, arity, parameters[0])

    def __len__(self) -> int:
        return self.codes.size

    def __iter__(self) -> Iterator[Module]:
        rows = zip(self.codes.tolist(), self.arity.tolist(), self.parameters.tolist())
        return (Module(chr(code), tuple(row[:count])) for code, count, row in rows)

    def __str__(self) -> str:
        return "".join(map(str, self))

    @property
    def alphabet(self) -> str:
        """The symbols that occur, sorted."""
        return "".join(map(chr, np.unique(self.codes).tolist()))

    def where(self, symbol: str) -> Int[np.ndarray, " k"]:
        """Indices of the modules with this symbol."""
        return np.flatnonzero(self.codes == ord(symbol))


@dataclass(frozen=True)
class Rule:
    """What replaces a module.

    **Arguments:**

    - `symbol`: one character, the predecessor.
    - `produce`: from the module's parameters, (k,) arrays over the k modules that the rule replaces, to the
      successor: a string of plain symbols, or a sequence of strings and of (symbol, parameter, ...) whose
      parameters are numbers or (k,) arrays. An empty sequence removes the module.
    - `condition`: from the same arrays to booleans, where the rule applies. Default None: everywhere.
    - `weight`: among the rules that apply to a module, one is chosen with probability proportional to its
      weight. Positive; or, as `condition`, from the parameters to (k,) weights, zero or more. Default 1.
    - `random`: whether `produce` draws parameters; it is then given a `numpy.random.Generator` as `rng=`.
      Default False.

    **Raises:** ValueError for a symbol that is not one character and a weight that is not positive.
    """

    symbol: str
    produce: Callable[..., str | Iterable[Item]]
    condition: Callable[..., Any] | None = None
    weight: float | Callable[..., Any] = 1.0
    random: bool = False

    def __post_init__(self):
        _check_symbol(self.symbol, "symbol")
        if not callable(self.weight) and not (np.isfinite(self.weight) and self.weight > 0):
            raise ValueError(f"weight = {self.weight:g} is outside the admissible range (0, inf)")

    def weights(self, parameters: Float[np.ndarray, "p k"]) -> Float[np.ndarray, " k"]:
        """The weight for each module, zero where the condition does not hold."""
        weight = self.weight(*parameters) if callable(self.weight) else self.weight
        weights = np.broadcast_to(np.asarray(weight, dtype=float), parameters.shape[1:])
        if not np.all(np.isfinite(weights) & (weights >= 0)):
            bad = weights[~(np.isfinite(weights) & (weights >= 0))][0]
            raise ValueError(
                f"weight of a rule for {self.symbol!r} = {bad:g} is outside the admissible range [0, inf)"
            )
        return weights if self.condition is None else np.where(self.condition(*parameters), weights, 0.0)


@dataclass(frozen=True)
class LSystem:
    """An axiom and rules. A module to which no rule applies stays as it is.

    **Arguments:**

    - `axiom`: the word to start from, in the form that `Word.of` takes, or a `Word`.
    - `rules`: of any number of symbols, in any order.
    """

    axiom: str | Sequence[Item] | Word
    rules: Sequence[Rule]
    _by_symbol: dict[str, list[Rule]] = field(init=False, repr=False, compare=False)

    def __post_init__(self):
        by_symbol: dict[str, list[Rule]] = {}
        for rule in self.rules:
            by_symbol.setdefault(rule.symbol, []).append(rule)
        object.__setattr__(self, "_by_symbol", by_symbol)

    def rewrite(
        self,
        steps: int | None = None,
        *,
        seed: int | np.random.Generator = 0,
        max_modules: int = 10_000_000,
        max_steps: int = 10_000,
    ) -> Word:
        """The word after `steps` rewritings, or, by default, after as many as it takes until no rule applies.

        **Arguments:**

        - `steps`: how many, 0 or more. Default None: until the word is stable.
        - `seed`: of the stochastic choices, or a generator. Default 0.
        - `max_modules`: a longer word is refused. Default ten million.
        - `max_steps`: where `steps` is None, how many rewritings may be needed. Default 10,000.

        **Raises:** ValueError for negative `steps`, words longer than `max_modules`, words that are not
        stable after `max_steps`, and rules whose successors are malformed or not finite.
        """
        if steps is not None and steps < 0:
            raise ValueError(f"steps = {steps} is outside the admissible range [0, inf)")
        rng = np.random.default_rng(seed)
        word = self.axiom if isinstance(self.axiom, Word) else Word.of(self.axiom)
        for _ in range(max_steps if steps is None else steps):
            after = self._step(word, rng, max_modules)
            if after is None:
                return word
            word = after
        if steps is None:
            raise ValueError(
                f"max_steps = {max_steps}: rules still apply to the word after so many rewritings"
            )
        return word

    def _step(self, word: Word, rng: np.random.Generator, max_modules: int) -> Word | None:
        """The next word; None where no rule applies."""
        made = []
        lengths = np.ones(len(word), dtype=int)
        kept = np.ones(len(word), dtype=bool)
        for symbol, rules in self._by_symbol.items():
            at = word.where(symbol)
            if at.size == 0:
                continue
            arity = np.unique(word.arity[at])
            if arity.size > 1:
                raise ValueError(f"{symbol!r} occurs with {arity[0]} and with {arity[1]} parameters")
            parameters = word.parameters[at, : arity[0]].T
            choice = _choose(np.stack([rule.weights(parameters) for rule in rules]), rng)
            for number, rule in enumerate(rules):
                chosen = np.flatnonzero(choice == number)
                if chosen.size == 0:
                    continue
                drawn = {"rng": rng} if rule.random else {}
                items = rule.produce(*parameters[:, chosen], **drawn)
                successor = _successor(items, chosen.size, f"a successor of {symbol!r}")
                made.append((at[chosen], *successor))
                lengths[at[chosen]] = successor[0].size
                kept[at[chosen]] = False
        if not made:
            return None
        ends = np.cumsum(lengths)
        total = int(ends[-1])
        if total > max_modules:
            raise ValueError(f"max_modules = {max_modules}: the word would have {total} modules")
        first = ends - lengths
        width = max([word.parameters.shape[1], *(parameters.shape[2] for *_, parameters in made)])
        after = Word(np.empty(total, np.uint32), np.empty(total, int), np.full((total, width), np.nan))
        for at, codes, arity, parameters in (
            (
                np.flatnonzero(kept),
                word.codes[kept, None],
                word.arity[kept, None],
                word.parameters[kept, None],
            ),
            *made,
        ):
            to = first[at][:, None] + np.arange(codes.shape[-1])
            after.codes[to] = codes
            after.arity[to] = arity
            after.parameters[to, : parameters.shape[2]] = parameters
        return after


def _choose(weights: Float[np.ndarray, "rules k"], rng: np.random.Generator) -> Int[np.ndarray, " k"]:
    """For each module the number of the rule that replaces it; -1 where none applies."""
    upper = np.cumsum(weights, axis=0)
    none = upper[-1] <= 0
    if np.all(np.count_nonzero(weights, axis=0) <= 1):
        return np.where(none, -1, np.argmax(weights > 0, axis=0))
    # Below the total, so that a rule of zero weight is never reached.
    mark = rng.uniform(size=none.size) * upper[-1]
    return np.where(none, -1, np.argmax(upper > mark, axis=0))


def _successor(
    items: str | Iterable[Item], count: int, name: str
) -> tuple[UInt32[np.ndarray, " m"], Int[np.ndarray, " m"], Float[np.ndarray, "{count} m p"]]:
    """Codes, arities and parameters of `count` words of the same symbols."""
    modules: list[tuple[Any, ...]] = []
    for item in (items,) if isinstance(items, str) else items:
        modules += [(symbol,) for symbol in item] if isinstance(item, str) else [item]
    width = max((len(module) - 1 for module in modules), default=0)
    parameters = np.full((count, len(modules), width), np.nan)
    for i, (symbol, *values) in enumerate(modules):
        _check_symbol(symbol, f"symbol in {name}")
        for j, value in enumerate(values):
            parameters[:, i, j] = value
            if not np.all(np.isfinite(parameters[:, i, j])):
                bad = parameters[~np.isfinite(parameters[:, i, j]), i, j][0]
                raise ValueError(
                    f"parameter {j + 1} of {symbol!r} in {name} = {bad:g}"
                    " is outside the admissible range (-inf, inf)"
                )
    codes = np.array([ord(symbol) for symbol, *_ in modules], dtype=np.uint32)
    return codes, np.array([len(module) - 1 for module in modules], dtype=int), parameters


def _check_symbol(symbol: Any, name: str) -> None:
    if not isinstance(symbol, str) or len(symbol) != 1:
        raise ValueError(f"{name} = {symbol!r} is not one character")
