"""The site of docs/, built as `make docs` does."""

import dataclasses
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

import csac_jax
from csac_jax import cli
from csac_jax.config import Config, Section
from csac_jax.training.loop import Record

pytest.importorskip("mkdocs")
ROOT = Path(csac_jax.__file__).parents[1]
LOADED = {"script": "src", "img": "src", "iframe": "src", "source": "src", "video": "src"}
ELSEWHERE = re.compile(r"(https?:)?//")
LINKED = ("stylesheet", "preload", "preconnect", "icon", "manifest", "prefetch", "modulepreload")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Builds the site; returns its folder."""
    folder = tmp_path_factory.mktemp("site")
    unreachable = {f"{name}_proxy": "http://127.0.0.1:9" for name in ("http", "https")}
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", folder],
        cwd=ROOT,
        env=os.environ | unreachable | {"NO_MKDOCS_2_WARNING": "1", "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return folder


class _Loads(HTMLParser):
    """The addresses that a page loads as it opens, without links that a reader may follow."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list) -> None:
        values = dict(attrs)
        if tag in LOADED and LOADED[tag] in values:
            self.addresses.append(values[LOADED[tag]])
        if tag == "link" and set((values.get("rel") or "").split()) & set(LINKED):
            self.addresses.append(values["href"])


def test_nothing_is_loaded_from_elsewhere(site: Path):
    """Claim: no page or style of the site loads a script, style, font or picture from a host; what
    pages load is in the site."""
    pages = list(site.rglob("*.html"))
    assert len(pages) > 30
    for page in pages:
        addresses = _Loads(page.read_text()).addresses
        assert len(addresses) > 3
        assert not list(filter(ELSEWHERE.match, addresses)), page
        paths = [re.split(r"[?#]", address)[0] for address in addresses]
        for path in paths if page.name != "404.html" else ():
            assert path.startswith("data:") or (page.parent / path).exists(), (page, path)
    for style in site.rglob("*.css"):
        urls = re.findall(r"""(?:@import\s+|url\()\s*["']?([^"')\s]+)""", style.read_text())
        assert not list(filter(ELSEWHERE.match, urls)), style


def test_references_are_complete(site: Path):
    """Claim: the reference has every setting, each command's own help, each field of a record and
    each public name, functions with their arguments."""
    text = {path.stem: path.read_text() for path in (site / "reference").glob("*.html")}
    settings = [
        f"<code>{section}.{field.name}</code>"
        for section, value in vars(Config()).items()
        if isinstance(value, Section)
        for field in dataclasses.fields(value)
    ]
    assert not [one for one in settings if one not in text["settings"]]
    commands = [f"usage: csac-jax {command}" for command in cli.COMMANDS]
    assert not [one for one in commands if one not in text["commands"]]
    fields = [f"<code>{field.name}</code>" for field in dataclasses.fields(Record)]
    assert not [one for one in fields if one not in text["metrics"]]
    names = [f'id="csac_jax.{name}"' for name in {*csac_jax.__all__} - {"deploy"}]
    assert not [one for one in (*names, "init, networks to start from") if one not in text["api"]]
    assert "completion_reachable" in text["metrics"]


def test_inserts_and_equations_are_filled_in(site: Path):
    """Claim: no page shows a mark of the build or the source of an equation."""
    for page in site.rglob("*.html"):
        text = page.read_text()
        assert "<!-- insert:" not in text, page
        assert 'class="arithmatex"' not in text, page
    assert "<math" in (site / "explanation" / "algorithm.html").read_text()
