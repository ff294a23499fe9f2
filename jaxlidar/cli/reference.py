"""`jaxlidar reference`."""

import inspect
import pkgutil
import re
import sys
import types
from importlib import metadata
from pathlib import Path

import click

from jaxlidar._fingerprint import version_of
from jaxlidar.cli.constants import COMMANDS
from jaxlidar.io import atomic_write

LINK = re.compile(r"(!?)\[([^]]*)\]\(([^)#\s]*)(#[^)]*)?\)")
# The folder of the web pages that are made from pages of documentation.
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

    The classes of results follow the public names. It covers this package and those that add commands to it.
    Needs pdoc (pip install 'jaxlidar[docs]').

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
    names = [name for name in extract.walk_specs(packages) if _is_module(name)]
    modules = {name: doc.Module(_with_classes_of_results(doc.Module.from_name(name).obj)) for name in names}
    pages = find_pages(packages)
    for name in packages:
        modules[name].docstring += _list_of_pages(pages)
    pictures: dict[str, Path] = {}
    for path, module_name in pages.items():
        modules[module_name] = doc.Module(_page_module(path, pages, pictures))
    render.configure(
        docformat="markdown", footer_text=f"jaxlidar {version_of('jaxlidar')}", show_source=False
    )
    for name, module in modules.items():
        _write(out / f"{name.replace('.', '/')}.html", render.html_module(module, modules).encode())
    _write(out / "index.html", render.html_index(modules).encode())
    _write(out / "search.js", render.search_index(modules).encode())
    for name, picture in pictures.items():
        _write(out / PAGES / name, picture.read_bytes())
    click.echo(f"{len(modules)} web pages: {out / 'jaxlidar.html'}")


def _write(path: Path, content: bytes) -> None:
    with atomic_write(path) as draft:
        draft.write_bytes(content)


def _is_module(name: str) -> bool:
    """Return whether a name is that of a module for users of its package.

    `jaxlidar.simulate` is not: there the function has hidden the module of the same name.
    """
    package, _, member = name.rpartition(".")
    return not package or isinstance(getattr(sys.modules[package], member), types.ModuleType)


def _with_classes_of_results(module: types.ModuleType) -> types.ModuleType:
    """Return a module whose public names include the classes of results, which users receive by functions."""
    if not hasattr(module, "__all__"):
        return module
    classes = classes_of_results(module)
    page = types.ModuleType(module.__name__, module.__doc__)
    vars(page).update({**vars(module), **classes, "__all__": [*module.__all__, *classes]})
    return page


def classes_of_results(module: types.ModuleType) -> dict[str, type]:
    """Find the classes that users receive from functions, by name: they have an example, as all that users
    see, and are no public names. Those of modules with public names of their own are left out.
    """
    public, classes = [getattr(module, name) for name in module.__all__], {}
    others = [value for value in public if hasattr(value, "__all__")]
    public += [getattr(other, name) for other in others for name in other.__all__]
    names_of_others = {name for other in others for name in _names_of_modules(other)}
    for module_name in _names_of_modules(module):
        if module_name in names_of_others:
            continue
        for name, value in vars(pkgutil.resolve_name(module_name)).items():
            is_defined_there = inspect.isclass(value) and value.__module__ == module_name
            if is_defined_there and value not in public and ">>>" in (value.__doc__ or ""):
                classes[name] = value
    return classes


def _names_of_modules(module: types.ModuleType) -> list[str]:
    """Return the names of the modules of a package, or of those whose names a module hands on."""
    if not hasattr(module, "__path__"):
        return sorted({getattr(module, name).__module__ for name in module.__all__})
    names = [info.name for info in pkgutil.walk_packages(module.__path__, module.__name__ + ".")]
    return [name for name in names if not name.endswith("__main__")]


def find_pages(packages: list[str]) -> dict[Path, str]:
    """Find the README.md of each imported package, and every page that these link to, directly or not.

    An installed package has its own pages alone; a checkout of the project has those of its examples too.

    **Returns:** names of modules for pdoc by path, in the order in which pages are met.
    """
    roots = [Path(str(sys.modules[name].__file__)).resolve().parent for name in packages]
    queue = [root / "README.md" for root in roots if (root / "README.md").exists()]
    pages: dict[Path, str] = {}
    while queue:
        page = queue.pop(0)
        if page in pages:
            continue
        place = page.relative_to(roots[0].parent) if page.is_relative_to(roots[0].parent) else page
        name = "_".join(place.parent.parts) if place.name == "README.md" else place.stem.lower()
        pages[page] = f"{PAGES}.{name or 'front'}"
        targets = [(page.parent / target).resolve() for _, _, target, _ in LINK.findall(page.read_text())]
        queue += [target for target in targets if target.suffix == ".md" and target.exists()]
    return pages


def _title(page: Path) -> str:
    return page.read_text().partition("\n")[0].lstrip("# ")


def _list_of_pages(pages: dict[Path, str]) -> str:
    links = [f"- [{_title(path)}]({name.replace('.', '/')}.html)" for path, name in pages.items()]
    return "\n".join(["\n\n## Pages\n", *links])


def _page_module(page: Path, pages: dict[Path, str], pictures: dict[str, Path]) -> types.ModuleType:
    """Return a page as the docstring of a module, and add the pictures that it shows to `pictures`.

    So pdoc gives pages the looks, the search and the links to functions that it gives to modules. Links to
    other files than pages and pictures become plain text, for the files do not come with the web pages.
    """

    def web_link(match: re.Match) -> str:
        mark, text, target, fragment = match[1], match[2], match[3], match[4] or ""
        path = (page.parent / target).resolve() if target else page
        if mark and path.exists():
            name = f"{path.parent.name}_{path.name}"
            pictures[name] = path
            return f"![{text}]({name})"
        if path in pages:
            return f"[{text}]({pages[path].removeprefix(PAGES + '.')}.html{fragment})"
        return text

    return types.ModuleType(pages[page], LINK.sub(web_link, page.read_text()))
