"""Numbers, tables and paragraphs in Markdown, for pages that are made from records."""

from collections.abc import Iterable, Sequence


def number(x: float | None, digits: int = 2) -> str:
    """Format a number with some significant digits; an empty string for None."""
    if x is None:
        return ""
    short = f"{x:.{digits}g}"
    return f"{float(short):,g}" if 1e-3 <= abs(x) < 1e6 else short


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def page_of(*paragraphs: str) -> str:
    """Join paragraphs and tables by empty lines."""
    return "\n\n".join(paragraphs)
