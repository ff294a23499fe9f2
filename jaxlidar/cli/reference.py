"""`jaxlidar reference`."""

import importlib.util
import re
import types
from importlib import metadata
from pathlib import Path

import click

from jaxlidar.cli import COMMANDS, version

LINK = re.compile(r"(?<!!)\[([^]]*)\]\(([^)#\s]*)(#[^)]*)?\)")
# Of the web pages that are made from pages of documentation.
PAGES = "pages"


@click.command()
@click.option(
    "-o",
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default="jaxlidar-reference",
    help="Folder, in which files of an earlier reference are replaced.",
)
def reference(out: Path) -> None:
    """Build the API reference as web pages: public names by topic, and the pages of documentation.

    It covers this package and those that add commands to it. Needs pdoc (pip install 'jaxlidar[docs]').

    \b
    Example:
      jaxlidar reference -o reference
    """
    try:
        from pdoc import doc, extract, render
    except ImportError as error:
        raise click.ClickException(f"{error.name} is missing: pip install 'jaxlidar[docs]'") from None
    packages = ["jaxlidar", *(point.module for point in metadata.entry_points(group=COMMANDS))]
    packages = list(dict.fromkeys(name.partition(".")[0] for name in packages))
    modules = {name: doc.Module.from_name(name) for name in extract.walk_specs(packages)}
    pages = find_pages(packages)
    for name in packages:
        modules[name].docstring += _list_of_pages(pages)
    for path, module_name in pages.items():
        modules[module_name] = doc.Module(_page_module(path, pages))
    render.configure(docformat="markdown", footer_text=f"jaxlidar {version()}", show_source=False)
    for name, module in modules.items():
        web_page = out / f"{name.replace('.', '/')}.html"
        web_page.parent.mkdir(parents=True, exist_ok=True)
        web_page.write_text(render.html_module(module, modules), encoding="utf-8")
    (out / "index.html").write_text(render.html_index(modules), encoding="utf-8")
    (out / "search.js").write_text(render.search_index(modules), encoding="utf-8")
    click.echo(f"{len(modules)} web pages: {out / 'jaxlidar.html'}")


def find_pages(packages: list[str]) -> dict[Path, str]:
    """Find the README.md of each package, and every page that these link to, directly or not.

    An installed package has its own pages alone; a checkout of the project has those of its examples too.

    **Returns:** names of modules for pdoc by path, in the order in which pages are met.
    """
    specs = (importlib.util.find_spec(name) for name in packages)
    roots = [Path(spec.origin).resolve().parent for spec in specs if spec and spec.origin]
    queue = [root / "README.md" for root in roots if (root / "README.md").exists()]
    pages: dict[Path, str] = {}
    while queue:
        page = queue.pop(0)
        if page in pages:
            continue
        place = page.relative_to(roots[0].parent) if page.is_relative_to(roots[0].parent) else page
        name = "_".join(place.parent.parts) if place.name == "README.md" else place.stem.lower()
        pages[page] = f"{PAGES}.{name or 'front'}"
        targets = [(page.parent / target).resolve() for _, target, _ in LINK.findall(page.read_text())]
        queue += [target for target in targets if target.suffix == ".md" and target.exists()]
    return pages


def _title(page: Path) -> str:
    return page.read_text().partition("\n")[0].lstrip("# ")


def _list_of_pages(pages: dict[Path, str]) -> str:
    links = [f"- [{_title(path)}]({name.replace('.', '/')}.html)" for path, name in pages.items()]
    return "\n".join(["\n\n## Pages\n", *links])


def _page_module(page: Path, pages: dict[Path, str]) -> types.ModuleType:
    """Return a page as the docstring of a module, whose links lead to web pages.

    So pdoc gives pages the looks, the search and the links to functions that it gives to modules. Links to
    other files than pages become plain text, for web pages do not come with them.
    """

    def web_link(match: re.Match) -> str:
        text, target, fragment = match[1], match[2], match[3] or ""
        name = pages.get((page.parent / target).resolve()) if target else pages[page]
        return text if name is None else f"[{text}]({name.removeprefix(PAGES + '.')}.html{fragment})"

    module = types.ModuleType(pages[page], LINK.sub(web_link, page.read_text()))
    # pdoc looks for the pictures of a docstring beside its file.
    module.__file__ = str(page)
    return module
