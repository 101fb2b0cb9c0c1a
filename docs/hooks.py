"""What `mkdocs build` adds: pages of source files, references from the code, mathematics."""

import contextlib
import dataclasses
import html
import inspect
import io
import json
import os
import posixpath
import re
import shutil
import sys
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # the package of this checkout, even where another is installed

from latex2mathml.converter import convert  # noqa: E402
from mkdocs.plugins import event_priority  # noqa: E402
from mkdocs.structure.files import File  # noqa: E402
from tyro import _docstrings  # noqa: E402

import csac_jax  # noqa: E402
from csac_jax import cli  # noqa: E402
from csac_jax.config import Config  # noqa: E402
from csac_jax.evaluation import metrics, suites  # noqa: E402
from csac_jax.section import ALTERNATIVES, Section  # noqa: E402
from csac_jax.training import loop  # noqa: E402

SOURCES = ROOT / "build" / "sources"  # mkdocs.yml names it, too
PAGES = ROOT / "build" / "pages"
APP = ROOT / "build" / "browser" / "app.js"  # of the page that `make docs` bundles where node is
BUILT = {"All results": "all-results.md", "Records": "records.md"}
LANGUAGES = {".py": "python", ".json": "json", ".toml": "toml"}
OUTSIDE = re.compile(r"(?<!!)\[([^\]]*)\]\((\.\./[^)#\s]+)(#[^)\s]*)?\)")
EQUATION = re.compile(r'<(div|span) class="arithmatex">\\([\[(])(.*?)\\[\])]</\1>', re.DOTALL)
FIELD = re.compile(r"^(    \w+: [^#\n]+?)  # (?!type|noqa)(.+)$", re.MULTILINE)
WIDTH = 100  # characters of a line of help


def on_config(config: Any) -> Any:
    """Adds the pages that `make docs` wrote before the build: all results, and their index."""
    pages = [{title: name} for title, name in BUILT.items() if (PAGES / name).exists()]
    next(item for item in config.nav if "Results" in item)["Results"].extend(pages)
    return config


def on_startup(command: str, dirty: bool) -> None:
    """Copies the package for mkdocstrings, which reads no folder without `__init__.py` and no
    comment next to a field, only a docstring below it."""
    shutil.rmtree(SOURCES, ignore_errors=True)
    shutil.copytree(ROOT / "csac_jax", SOURCES / "csac_jax", ignore=shutil.ignore_patterns("__py*"))
    for path in list(SOURCES.rglob("*.py")):
        path.write_text(FIELD.sub(r'\1\n    """\2"""', path.read_text()))
        (path.parent / "__init__.py").touch()
    _name_homes()


def _name_homes() -> None:
    """Writes into the copy where each public name is defined: mkdocstrings follows imports, and no
    assignment to another name."""
    named = [(name, getattr(csac_jax, name)) for name in csac_jax.__all__]
    lines = [
        f"from {value.__module__} import {value.__qualname__} as {name}\n"
        for name, value in named
        if not inspect.ismodule(value)
    ]
    with (SOURCES / "csac_jax" / "__init__.py").open("a") as file:
        file.writelines(lines)


def on_files(files: Any, config: Any) -> Any:
    """Adds a page for each source file outside docs that a page links to."""
    pages = [file for file in files if file.is_documentation_page()]
    linked = {path for page in pages for _, path in _outside(page.src_uri, page.content_string)}
    for name in filter(lambda name: (PAGES / name).exists(), BUILT.values()):
        files.append(File.generated(config, name, abs_src_path=str(PAGES / name)))
    if APP.exists():
        files.append(File.generated(config, "browser.js", abs_src_path=str(APP)))
    for path in sorted(linked):
        if (ROOT / path).is_file() and (text := _as_markdown(ROOT / path)):
            files.append(File.generated(config, _source_page(path), content=text))
    return files


def _as_markdown(path: Path) -> str | None:
    """Returns a source file as a page, a notebook cell by cell; None for files of other kinds."""
    if path.suffix == ".ipynb":
        cells = json.loads(path.read_text())["cells"]
        sources = [(cell["cell_type"], "".join(cell["source"])) for cell in cells]
        parts = [text if kind == "markdown" else _code("python", text) for kind, text in sources]
        return "\n\n".join(parts)
    if language := LANGUAGES.get(path.suffix):
        return f"# {path.relative_to(ROOT)}\n\n{_code(language, path.read_text())}"
    return None


def _code(language: str, text: str) -> str:
    return f"````{language}\n{text}\n````"


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Sends links that leave docs to the pages of `on_files`, and fills in the references."""
    if not page.file.src_uri.startswith("source/"):
        for link, path in _outside(page.file.src_uri, markdown):
            known = files.get_file_from_path(_source_page(path)) is not None
            folder = posixpath.dirname(page.file.src_uri) or "."
            here = posixpath.relpath(_source_page(path), folder)
            new = f"[{link[1]}]({here})" if known else link[1]
            markdown = markdown.replace(link[0], new)
    return re.sub(r"<!-- insert: (\w+) -->", lambda found: INSERTS[found[1]](), markdown)


def on_page_content(content: str, page: Any, config: Any, files: Any) -> str:
    """Turns equations into MathML, which browsers draw without a script."""
    return EQUATION.sub(_mathml, content)


@event_priority(-100)  # after the plugin that writes the index
def on_post_build(config: Any) -> None:
    """Writes the search index as a script, too: pages of the file system may read no other file."""
    index = Path(config.site_dir, "search", "search_index.json")
    index.with_suffix(".js").write_text(f"var __index = {index.read_text()}")


def _mathml(found: re.Match) -> str:
    display = "block" if found[2] == "[" else "inline"
    return convert(html.unescape(found[3]).strip(), display=display)


def _outside(page: str, markdown: str) -> Iterator[tuple[re.Match, str]]:
    """Links of a page that leave docs, and the paths in the repository that they lead to."""
    for link in OUTSIDE.finditer(markdown):
        path = posixpath.normpath(posixpath.join("docs", posixpath.dirname(page), link[2]))
        if not path.startswith("docs/"):
            yield link, path


def _source_page(path: str) -> str:
    return f"source/{path}.md"


def settings_tables() -> str:
    """Lists every section of a config: its settings with defaults, ranges, units and meaning."""
    parts = []
    for field in dataclasses.fields(Config):
        if not isinstance(field.default, Section):
            continue
        tag, kinds = ALTERNATIVES.get(field.name, ("", (type(field.default),)))
        for kind in kinds:
            title = f"{field.name}, {getattr(kind, tag)}" if tag else field.name
            parts.append(f"## {title}\n\n{_text(kind.__doc__)}\n\n{_settings_of(field.name, kind)}")
    return "\n\n".join(parts)


def _settings_of(section: str, kind: Any) -> str:
    docs = _field_docs(kind)
    rows = [
        (f"`{section}.{field.name}`", _value(field.default), _allowed(field), docs[field.name])
        for field in dataclasses.fields(kind)
    ]
    return _table(("setting", "default", "allowed", "meaning"), rows)


def _field_docs(kind: Any) -> dict[str, str]:
    """Returns the text beside or below each field of a dataclass, as the help shows it."""
    docs = {
        f.name: _docstrings.get_field_docstring(kind, f.name, ()) for f in dataclasses.fields(kind)
    }
    return {name: " ".join((text or "").split()) for name, text in docs.items()}


def _value(value: Any) -> str:
    items = value if isinstance(value, tuple) else (value,)
    return " ".join(f"{item:g}" if isinstance(item, float) else str(item) for item in items)


def _allowed(field: Any) -> str:
    kind = field.type
    kind = typing.get_args(kind)[0] if typing.get_origin(kind) is tuple else kind
    if typing.get_origin(kind) is typing.Literal:
        return ", ".join(f"`{choice}`" for choice in typing.get_args(kind))
    low, high, above = field.metadata.get("bounds", (None, None, None))
    if low is None:
        return "true, false" if kind is bool else ""
    most = "" if high == float("inf") else f", at most {high:.10g}"
    return f"{'above' if above else 'at least'} {low:g}{most}"


def commands() -> str:
    """Returns the help of every command, as it is printed."""
    parts = [f"```text\n{cli.USAGE}```"]
    for name in cli.COMMANDS:
        parts.append(f"## {name}\n\n```text\n{printed_help(name)}```")
    return "\n\n".join(parts)


def printed_help(command: str) -> str:
    """Returns what `csac-jax COMMAND --help` prints."""
    before, out = dict(os.environ), io.StringIO()
    os.environ.update(COLUMNS=str(WIDTH), NO_COLOR="1")
    try:
        with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
            cli.main([command, "--help"])
    finally:
        os.environ.clear()
        os.environ.update(before)
    return re.sub(r"\x1b\[[0-9;]*m", "", out.getvalue())


def record_table() -> str:
    """Returns a table of the fields of a line of metrics.jsonl."""
    docs = _field_docs(loop.Record)
    fields = dataclasses.fields(loop.Record)
    return _table(("field", "meaning"), [(f"`{f.name}`", docs.get(f.name, "")) for f in fields])


def browser() -> str:
    """Returns the place of the page's script, or one line where the script was not built."""
    if not APP.exists():
        return "This site was built without node. `make docs` adds the page's script where node is."
    return '<div id="demo"></div>\n<script src="browser.js"></script>'


def described(module: Any) -> Callable[[], str]:
    """Makes a table of the names that a module's docstring describes, in columns."""
    found = re.findall(r"(?m)^(`?\w[\w ]*`?)  +(.*(?:\n  +.*)*)", module.__doc__)
    rows = [(name, _text(text)) for name, text in found]
    return lambda: _table(("name", "is"), rows)


def _table(heads: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [heads, ("---",) * len(heads), *rows]
    cells = [[_text(cell).replace("|", r"\|") for cell in line] for line in lines]
    return "\n".join(f"| {' | '.join(line)} |" for line in cells)


def _text(text: str) -> str:
    return " ".join(text.split())


INSERTS: dict[str, Callable[[], str]] = {
    "settings": settings_tables,
    "commands": commands,
    "browser": browser,
    "record": record_table,
    "metrics": described(metrics),
    "suites": described(suites),
}
