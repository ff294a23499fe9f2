"""Numbers, tables and pages of Markdown, for pages that are made from records."""

from collections.abc import Iterable, Sequence


def number(x: float | None, digits: int = 2) -> str:
    """To so many significant digits."""
    if x is None:
        return ""
    short = f"{x:.{digits}g}"
    return f"{float(short):,g}" if 1e-3 <= abs(x) < 1e6 else short


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def page_of(*paragraphs: str) -> str:
    """Paragraphs and tables with empty lines between."""
    return "\n\n".join(paragraphs)
