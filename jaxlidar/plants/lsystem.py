"""Parametric, stochastic L-systems: words of symbols, and rules that rewrite all symbols of a word at once.

A *symbol* is a letter with parameters, A(t_1, ..., t_p), a *word* is a sequence of symbols, and a *rule*
replaces a symbol, its predecessor, by a word, its successor:

    A(t_1, ..., t_p) : condition(t) -> successor(t)    with probability weight(t) / sum of weights

(Prusinkiewicz and Lindenmayer 1990, The Algorithmic Beauty of Plants, chapter 1; there a letter with
parameters is a "module", section 1.10). One step of rewriting replaces every symbol of the word at the same
time. Symbols to which no rule applies stay, and among several rules that apply one is drawn, independently
for every symbol (section 1.7). Rules are context-free: they do not look at neighbouring symbols.
`jaxlidar.turtle` turns a word into geometry.

All symbols of one letter are rewritten by one call of the rule, for a tree has a million of them. A rule
therefore receives arrays with one element per symbol: write NumPy expressions, and write different cases as
rules with conditions. An example is in `jaxlidar.LSystem`.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, final

import numpy as np
from jaxtyping import Float, Int, UInt32

from jaxlidar._fields.checks import check_flag, check_integer, check_kind, check_number, check_seed, kind_of

# A run of letters without parameters, or one letter with its parameters (in a rule's successor: arrays).
Item = str | tuple[Any, ...]


class Symbol(NamedTuple):
    """One symbol of a word: a letter with its parameters.

    **Arguments:**

    - `symbol`: the letter, one character.
    - `parameters`: a tuple of numbers. Default ().

    **Example:**

    >>> import jaxlidar as jl
    >>> from jaxlidar.plants.lsystem import Symbol
    >>> print(Symbol("F", (2.0, 0.1)))
    F(2,0.1)
    """

    symbol: str
    parameters: tuple[float, ...] = ()

    def __str__(self) -> str:
        return self.symbol + (f"({','.join(f'{p:g}' for p in self.parameters)})" if self.parameters else "")


@final
@dataclass(frozen=True, eq=False)
class Word:
    """A word of an L-system: a sequence of n symbols, stored as arrays.

    `Word.of` makes one. Iterating over a word gives each `Symbol`.

    **Arguments:**

    - `codes`: (n,) Unicode code points of the letters.
    - `arity`: (n,) number of parameters of each symbol.
    - `parameters`: (n, p) parameters; NaN beyond the arity of a symbol.

    **Example:**

    >>> import jaxlidar as jl
    >>> from jaxlidar.plants.lsystem import Word
    >>> word = Word.of([("F", 2.0), "[", ("+", 30.0), "J]J"])
    >>> print(word, len(word), word.alphabet)
    F(2)[+(30)J]J 6 +FJ[]
    """

    codes: UInt32[np.ndarray, " n"]
    arity: Int[np.ndarray, " n"]
    parameters: Float[np.ndarray, "n p"]

    @staticmethod
    def of(items: str | Iterable[Item]) -> "Word":
        """Make a word of letters and parameters.

        **Arguments:**

        - `items`: a string of letters without parameters, or a sequence of such strings and of tuples
          (letter, parameter, ...).

        **Returns:** a `Word`.

        **Raises:** ValueError for letters that are not one character and parameters that are not finite;
        TypeError for items that are no sequence.
        """
        check_kind("items", items, Iterable, "a string, or a sequence of strings and tuples")
        codes, arity, parameters = _successor(items, 1, "the word")
        return Word(codes, arity, parameters[0])

    def __len__(self) -> int:
        return self.codes.size

    def __iter__(self) -> Iterator[Symbol]:
        rows = zip(self.codes.tolist(), self.arity.tolist(), self.parameters.tolist())
        return (Symbol(chr(code), tuple(row[:count])) for code, count, row in rows)

    def __str__(self) -> str:
        return "".join(map(str, self))

    @property
    def alphabet(self) -> str:
        """The different letters of the word, sorted, as one string."""
        return "".join(map(chr, np.unique(self.codes).tolist()))

    def where(self, symbol: str) -> Int[np.ndarray, " k"]:
        """Indices of all symbols with one letter.

        **Arguments:**

        - `symbol`: the letter, one character.

        **Returns:** (k,) indices from 0, ascending.
        """
        return np.flatnonzero(self.codes == ord(symbol))


@final
@dataclass(frozen=True)
class Rule:
    """A production rule of an L-system: the word that replaces a symbol.

    Functions of a rule receive the parameters of the symbols as separate (k,) arrays, one element for each
    of the k symbols.

    **Arguments:**

    - `symbol`: the letter that is replaced (the predecessor), one character.
    - `produce`: function of the parameters that returns the successor: a string of letters without
      parameters, or a sequence of such strings and of tuples (letter, parameter, ...). Parameters are numbers
      or (k,) arrays. An empty sequence removes the symbol.
    - `condition`: function of the parameters that returns (k,) booleans, true where the rule applies. Default
      None: everywhere.
    - `weight`: among the rules that apply to a symbol, one is chosen with a probability proportional to its
      weight. A positive number, or a function of the parameters that returns (k,) weights, 0 or more.
      Default 1.
    - `random`: True if `produce` draws random numbers. It then receives a `numpy.random.Generator` as the
      keyword argument `rng`. Default False.

    **Raises:** ValueError for a letter that is not one character and a weight that is not positive; TypeError
    for a successor, condition or weight of another kind.

    **Example:**

    >>> import jaxlidar as jl
    >>> grow = jl.Rule("A", lambda n: ["F", ("A", n - 1)], condition=lambda n: n > 0)
    >>> print(jl.LSystem([("A", 3)], [grow]).rewrite())
    FFFA(0)
    """

    symbol: str
    produce: Callable[..., str | Iterable[Item]]
    condition: Callable[..., Any] | None = None
    weight: float | Callable[..., Any] = 1.0
    random: bool = False

    def __post_init__(self):
        _check_symbol(self.symbol, "symbol")
        if not callable(self.produce):
            raise TypeError(f"produce is {kind_of(self.produce)}; admissible is a function of the parameters")
        if self.condition is not None and not callable(self.condition):
            raise TypeError(f"condition is {kind_of(self.condition)}; admissible is a function or None")
        if not callable(self.weight):
            check_number("weight", self.weight, 0.0, low_open=True)
        check_flag("random", self.random)

    def weights(self, parameters: Float[np.ndarray, "p k"]) -> Float[np.ndarray, " k"]:
        """Weight of the rule for each symbol; zero where the condition does not hold.

        **Arguments:**

        - `parameters`: (p, k) the p parameters of k symbols.

        **Returns:** (k,) weights.

        **Raises:** ValueError for weights that are negative or not finite.
        """
        weight = self.weight(*parameters) if callable(self.weight) else self.weight
        weights = np.broadcast_to(np.asarray(weight, dtype=float), parameters.shape[1:])
        if not np.all(np.isfinite(weights) & (weights >= 0)):
            inadmissible = weights[~(np.isfinite(weights) & (weights >= 0))][0]
            raise ValueError(
                f"weight of a rule for {self.symbol!r} = {inadmissible:g} is outside the admissible range "
                "[0, inf)"
            )
        return weights if self.condition is None else np.where(self.condition(*parameters), weights, 0.0)


@final
@dataclass(frozen=True)
class LSystem:
    """An L-system: an axiom, which is the word to start from, and production rules.

    A symbol to which no rule applies stays as it is.

    **Arguments:**

    - `axiom`: a `Word`, or letters and parameters in the form that `Word.of` takes.
    - `rules`: a sequence of `Rule`, for any number of letters, in any order.

    **Raises:** TypeError for rules of another kind.

    **Example:** a binary tree whose branches end at a radius of 1 cm.

    >>> import jaxlidar as jl
    >>> def fork(r):
    ...     return [("F", 50 * r, r), "[", ("+", 35), ("A", 0.8 * r), "]", ("-", 20), "/", ("A", 0.6 * r)]
    >>> rules = [jl.Rule("A", fork, lambda r: r >= 0.01), jl.Rule("A", lambda r: "J", lambda r: r < 0.01)]
    >>> tree = jl.turtle(jl.LSystem([("A", 0.1)], rules).rewrite(), angle=90)
    >>> print(f"{len(tree.start)} segments, {len(tree.bud_position)} buds")
    153 segments, 154 buds
    """

    axiom: str | Sequence[Item] | Word
    rules: Sequence[Rule]
    _by_symbol: dict[str, list[Rule]] = field(init=False, repr=False, compare=False)

    def __post_init__(self):
        by_symbol: dict[str, list[Rule]] = {}
        check_kind("rules", self.rules, Sequence, "a sequence of Rule, as in [rule]")
        for rule in self.rules:
            check_kind("one of rules", rule, Rule, "a Rule")
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
        """Rewrite the axiom a number of times; by default, until no rule applies any more.

        **Arguments:**

        - `steps`: number of steps, 0 or more. Default None: until no rule applies.
        - `seed`: random seed of stochastic rules, or a NumPy generator. Default 0.
        - `max_modules`: largest admissible length of the word, in symbols. Default 10,000,000.
        - `max_steps`: largest admissible number of steps where `steps` is None. Default 10,000.

        **Returns:** a `Word`.

        **Raises:** ValueError for `steps` that are negative or no integer, words longer than `max_modules`,
        words to which rules still apply after `max_steps`, rules whose successors are malformed or not
        finite, rules with inadmissible weights, and letters that occur with different numbers of parameters.
        """
        if steps is not None:
            steps = check_integer("steps", steps, 0)
        max_modules = check_integer("max_modules", max_modules)
        max_steps = check_integer("max_steps", max_steps)
        check_seed(seed)
        rng = np.random.default_rng(seed)
        word = self.axiom if isinstance(self.axiom, Word) else Word.of(self.axiom)
        for _ in range(max_steps if steps is None else steps):
            next_word = self._step(word, rng, max_modules)
            if next_word is None:
                return word
            word = next_word
        if steps is None:
            raise ValueError(
                f"max_steps = {max_steps}: rules still apply to the word after {max_steps} rewritings"
            )
        return word

    def _step(self, word: Word, rng: np.random.Generator, max_modules: int) -> Word | None:
        """Rewrite every symbol once; None where no rule applies.

        1. For each letter with rules: draw the rule that replaces each of its symbols, and let each rule
           produce the successors of all its symbols in one call.
        2. Compute the length of the next word, and the index at which each successor begins.
        3. Copy the symbols that stay, and the successors, to these indices.
        """
        # Per rule: indices of the symbols replaced; codes, arities and parameters of their successors.
        productions = []
        lengths = np.ones(len(word), dtype=int)
        stays = np.ones(len(word), dtype=bool)
        for symbol, rules in self._by_symbol.items():
            predecessors = word.where(symbol)
            if predecessors.size == 0:
                continue
            arity = np.unique(word.arity[predecessors])
            if arity.size > 1:
                raise ValueError(f"{symbol!r} occurs with {arity[0]} and with {arity[1]} parameters")
            parameters = word.parameters[predecessors, : arity[0]].T
            chosen_rule = _choose(np.stack([rule.weights(parameters) for rule in rules]), rng)
            for number, rule in enumerate(rules):
                selected = np.flatnonzero(chosen_rule == number)
                if selected.size == 0:
                    continue
                generator = {"rng": rng} if rule.random else {}
                items = rule.produce(*parameters[:, selected], **generator)
                successor = _successor(items, selected.size, f"a successor of {symbol!r}")
                productions.append((predecessors[selected], *successor))
                lengths[predecessors[selected]] = successor[0].size
                stays[predecessors[selected]] = False
        if not productions:
            return None

        ends = np.cumsum(lengths)
        total = int(ends[-1])
        if total > max_modules:
            raise ValueError(f"max_modules = {max_modules}: the word would have {total} symbols")
        first = ends - lengths
        width = max([word.parameters.shape[1], *(parameters.shape[2] for *_, parameters in productions)])
        next_word = Word(np.empty(total, np.uint32), np.empty(total, int), np.full((total, width), np.nan))

        # Symbols that stay are words of length one.
        unchanged = (
            np.flatnonzero(stays),
            word.codes[stays, None],
            word.arity[stays, None],
            word.parameters[stays, None],
        )
        for predecessors, codes, arity, parameters in (unchanged, *productions):
            index = first[predecessors][:, None] + np.arange(codes.shape[-1])
            next_word.codes[index] = codes
            next_word.arity[index] = arity
            next_word.parameters[index, : parameters.shape[2]] = parameters
        return next_word


def _choose(weights: Float[np.ndarray, "rules k"], rng: np.random.Generator) -> Int[np.ndarray, " k"]:
    """Draw the index of the rule that replaces each symbol; -1 where none applies."""
    cumulative = np.cumsum(weights, axis=0)
    inapplicable = cumulative[-1] <= 0
    # Without a choice no random number is drawn: deterministic letters leave the others' numbers as they are.
    if np.all(np.count_nonzero(weights, axis=0) <= 1):
        return np.where(inapplicable, -1, np.argmax(weights > 0, axis=0))
    # Inverse of the distribution function. `uniform` is below 1 and the comparison strict, so that a rule of
    # zero weight is never chosen.
    threshold = rng.uniform(size=inapplicable.size) * cumulative[-1]
    return np.where(inapplicable, -1, np.argmax(cumulative > threshold, axis=0))


def _successor(
    items: str | Iterable[Item], count: int, name: str
) -> tuple[UInt32[np.ndarray, " m"], Int[np.ndarray, " m"], Float[np.ndarray, "{count} m p"]]:
    """Codes, arities and parameters of `count` words of the same m letters; `name` is for error messages."""
    symbols: list[tuple[Any, ...]] = []
    for item in (items,) if isinstance(items, str) else items:
        symbols += [(letter,) for letter in item] if isinstance(item, str) else [item]
    width = max((len(symbol) - 1 for symbol in symbols), default=0)
    parameters = np.full((count, len(symbols), width), np.nan)
    for i, (letter, *values) in enumerate(symbols):
        _check_symbol(letter, f"symbol in {name}")
        for j, value in enumerate(values):
            parameters[:, i, j] = value
            if not np.all(np.isfinite(parameters[:, i, j])):
                inadmissible = parameters[~np.isfinite(parameters[:, i, j]), i, j][0]
                raise ValueError(
                    f"parameter {j + 1} of {letter!r} in {name} = {inadmissible:g}"
                    " is outside the admissible range (-inf, inf)"
                )
    codes = np.array([ord(letter) for letter, *_ in symbols], dtype=np.uint32)
    return codes, np.array([len(symbol) - 1 for symbol in symbols], dtype=int), parameters


def _check_symbol(symbol: Any, name: str) -> None:
    if not isinstance(symbol, str) or len(symbol) != 1:
        raise ValueError(f"{name} = {symbol!r} is not one character")
