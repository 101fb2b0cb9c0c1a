"""Every Python block of README and docs runs."""

import re
from pathlib import Path

import pytest

import csac_jax
from csac_jax import presets

ROOT = Path(csac_jax.__file__).parents[1]
PAGES = [
    page
    for page in (ROOT / "README.md", *ROOT.glob("docs/**/*.md"))
    if "```python" in page.read_text()
]
NUMBERS = re.compile(r"\b(episodes|seeds)\s*=\s*\d+")


def blocks(page: Path) -> list[str]:
    """The Python code of a page, block by block."""
    return re.findall(r"^```python\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)


def test_readme_has_an_example():
    """Claim: the test below has something to run."""
    assert ROOT / "README.md" in PAGES


@pytest.mark.mjx
@pytest.mark.optax
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_blocks_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: the blocks of a page run, one after the other, with a small preset for `quick`, few
    episodes and few seeds."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(presets, "quick", presets.smoke)
    monkeypatch.setitem(presets.PRESETS, "quick", presets.smoke)
    namespace = {"__name__": page.stem}
    for block in blocks(page):
        small = NUMBERS.sub(r"\1=2", block)
        exec(compile(small, page.name, "exec"), namespace)
