"""mkdocs hooks that build the documentation site. mkdocs.yml refers to this file.

- A directive line ``::: package.module:name`` is replaced by the source of that function or class.
  The source is read when the site is built, so excerpts are always current. Indented lines below
  the directive name tests of the function: ``tests/path.py::test_name``.
- Links to repository files outside docs/ lead to generated pages that show the files.
- Formulas are converted to MathML, which browsers display without scripts.
- In the navigation, ``folder/*`` stands for all pages of a folder.
- CHANGELOG.md becomes a page of the site.
"""

from __future__ import annotations

import ast
import posixpath
import re
from collections.abc import Iterator
from html import unescape
from pathlib import Path
from typing import Any, NamedTuple

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

REPOSITORY = Path(__file__).resolve().parent.parent
SOURCES = "source"
"""Folder of the site for pages that show repository files."""

DIRECTIVE = re.compile(
    r"^::: (?P<module>[\w.]+):(?P<name>[\w.]+)\n(?P<checks>(?: {4}\S+\n)*)", re.M
)
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](?P<latex>.*?)\\[)\]]</\1>', re.DOTALL)
Definition = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
_LINK = re.compile(r"\]\((?P<target>\.\./[^)#\s]+)(?P<anchor>#[^)\s]*)?\)")
_LANGUAGES = {".py": "python", ".toml": "toml", ".yml": "yaml", ".json": "json", ".sh": "sh"}


class Excerpt(NamedTuple):
    """The source of a function or class.

    Attributes:
        path: path of the module, relative to the repository.
        first: number of the first line in the module.
        text: source text.
    """

    path: str
    first: int
    text: str


def module_path(module: str) -> str:
    """Return the path of a module's file, relative to the repository.

    Raises:
        PluginError: the module does not exist.
    """
    base = module.replace(".", "/")
    for path in (f"{base}.py", f"{base}/__init__.py"):
        if (REPOSITORY / path).is_file():
            return path
    raise PluginError(f"cannot take an excerpt: module {module} does not exist")


def excerpt(module: str, name: str) -> Excerpt:
    """Return the source of a function, method or class of the repository.

    Raises:
        PluginError: the module does not exist, or it does not contain the name.
    """
    path = module_path(module)
    text = (REPOSITORY / path).read_text(encoding="utf-8")
    scope: ast.Module | Definition = ast.parse(text)
    for part in name.split("."):
        named = [n for n in scope.body if isinstance(n, Definition) and n.name == part]
        if not named:
            raise PluginError(f"{module} has no function or class {name}")
        scope = named[0]
    assert not isinstance(scope, ast.Module)
    first = min([scope.lineno, *(decorator.lineno for decorator in scope.decorator_list)])
    lines = text.splitlines()[first - 1 : scope.end_lineno]
    indent = len(lines[0]) - len(lines[0].lstrip())
    return Excerpt(path, first, "\n".join(line[indent:] for line in lines))


def checks(match: re.Match[str]) -> list[tuple[str, str]]:
    """Return (path, test name) of each test that a directive names."""
    return [(path, test) for path, _, test in (c.partition("::") for c in match["checks"].split())]


# ------------------------------------------------------------------------------------- hooks


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Replace ``folder/*`` in the navigation by the pages of the folder."""
    config.nav = [_expanded(entry, Path(config.docs_dir)) for entry in config.nav or []]
    return config


def _expanded(entry: Any, docs: Path) -> Any:
    if not isinstance(entry, dict):
        return entry
    ((title, target),) = entry.items()
    if isinstance(target, str) and target.endswith("/*"):
        folder = docs / target.removesuffix("/*")
        pages = sorted(folder.glob("*.md"), key=lambda page: (page.stem != "README", page.stem))
        return {title: [page.relative_to(docs).as_posix() for page in pages]}
    return entry


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the changelog to the site, and a page for each repository file that a page refers to."""
    changelog = (REPOSITORY / "CHANGELOG.md").read_text(encoding="utf-8").replace("](docs/", "](")
    files.append(File.generated(config, "changelog.md", content=changelog))
    pages = [(page.src_uri, page.content_string) for page in files.documentation_pages()]
    for path in sorted({path for uri, text in pages for path in _shown(uri, text)}):
        language = _LANGUAGES.get(Path(path).suffix, "text")
        source = (REPOSITORY / path).read_text(encoding="utf-8")
        # The source may contain a code fence of backticks, so this fence uses tildes.
        text = (
            f"---\ntitle: {path}\nsearch:\n  exclude: true\n---\n\n~~~~ {language}\n{source}~~~~\n"
        )
        page = File.generated(
            config, f"{SOURCES}/{path}.md", content=text, inclusion=InclusionLevel.NOT_IN_NAV
        )
        files.append(page)
    return files


def _shown(uri: str, text: str) -> Iterator[str]:
    """Iterate over the files outside docs/ that a page refers to, as paths in the repository."""
    for match in _LINK.finditer(text):
        if path := _outside(uri, match["target"]):
            yield path
    for match in DIRECTIVE.finditer(text):
        yield module_path(match["module"])
        yield from (path for path, _ in checks(match))


def _outside(uri: str, target: str) -> str | None:
    """Return the path of a link's target in the repository, or None.

    The result is None if the target is inside docs/ or is not a file of the repository.
    """
    path = posixpath.normpath(posixpath.join("docs", posixpath.dirname(uri), target))
    inside = path.startswith(("docs/", "../"))
    return path if not inside and (REPOSITORY / path).is_file() else None


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Replace directives by excerpts. Redirect links to files outside docs/ to generated pages."""
    del config, files
    uri = page.file.src_uri
    if uri.startswith(f"{SOURCES}/"):
        return markdown

    def source_page(path: str) -> str:
        return posixpath.relpath(f"{SOURCES}/{path}.md", posixpath.dirname(uri) or ".")

    def show(match: re.Match[str]) -> str:
        code = excerpt(match["module"], match["name"])
        tests = ", ".join(f"[`{test}`]({source_page(path)})" for path, test in checks(match))
        links = f"[`{code.path}`]({source_page(code.path)}), line {code.first}"
        if tests:
            links += f"; checked by {tests}"
        return f"~~~~ python\n{code.text}\n~~~~\n\n<small>{links}</small>\n"

    def lead(match: re.Match[str]) -> str:
        path = _outside(uri, match["target"])
        return f"]({source_page(path)})" if path else match[0]

    return DIRECTIVE.sub(show, _LINK.sub(lead, markdown))


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Convert formulas to MathML."""
    del page, config, files

    def draw(match: re.Match[str]) -> str:
        display = "block" if match[1] == "div" else "inline"
        return str(convert(unescape(match["latex"]).strip(), display=display))

    return FORMULA.sub(draw, html)
