"""The recorded results and the documents that are written from them."""

import fnmatch
import json
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from csac_jax.errors import SettingsError
from csac_jax.io import configs
from experiments import figures, index, summary

ROOT = Path(__file__).parents[2]
ARCHIVES = sorted(index.RESULTS.rglob("*.tar.xz"))
FORMER = ("cem.start: must be", "replay.rank_by: must be", "replay.start: must be")
PAGES = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]


def test_pages_are_as_written():
    """Claim: the tables of docs/results.md are generated; README and docs/study.md say how many
    runs the study has."""
    assert summary.page() == summary.PAGE.read_text()
    names = [name for path in index.STUDY.glob("[1-7]-*") for name in index.contents(path)]
    runs = sum(name.endswith("metrics.jsonl") for name in names)
    assert f" of {runs:,} runs " in (ROOT / "README.md").read_text()
    assert f" in {runs:,} runs of" in (ROOT / "docs" / "study.md").read_text()


def test_figure_of_suites_has_the_recorded_numbers():
    """Claim: README's figure has the completion of its floor, policy and ceiling of every suite, as
    the page on suites that need pushes."""
    shares = figures.completions()
    page = (ROOT / "docs" / "benchmarks" / "policies.md").read_text()
    for suite, (floor, ceiling) in [*figures.BOUNDS.items()][:3]:
        names = (floor, ceiling, figures.RECORDED)
        values = [f"{100 * shares[suite, name]['value']:.0f}" for name in names]
        (row,) = re.findall(rf"(?m)^\| {suite} \|(.*)\|$", page)
        cells = [(cell.split() or ["-"])[0] for cell in row.split("|")]
        assert [cells[0], cells[-1]] == values[:2]
        assert values[2] in cells
    bars = figures.suites().axes[0].get_lines()
    drawn = [line.get_xdata().tolist() for line in bars if line.get_linestyle() == "None"][:2]
    assert [len(values) for values in drawn] == [len(figures.BOUNDS)] * 2


@pytest.mark.parametrize("path", ARCHIVES, ids=lambda path: path.stem)
def test_archives_say_what_they_hold(path: Path):
    """Claim: an archive names each of its folders and nothing else, holds no path of a machine and
    no damaged record, and its configs load, but those of a network of an earlier version or with
    another value of a setting that is a constant today."""
    contents = index.contents(path)
    folders = {name.split("/seed-")[0] for name in contents if "/seed-" in name}
    about = json.loads(contents[index.ABOUT])
    assert path.parent.name == "study" or folders <= about.keys()
    assert all(any(name.startswith(key) for name in contents) for key in about if key != ".")
    text = b"\n".join(contents.values())
    assert not re.search(rb'"(?:/|~/|[A-Z]:\\)|"host', text)
    for text in {content for name, content in contents.items() if name.endswith("config.json")}:
        if (config := json.loads(text))["net"]["kind"] != "offset":
            refusal = _refusal(config)
            assert not refusal or refusal.startswith(FORMER)


def _refusal(config: Any) -> str:
    try:
        configs.from_dict(config)
    except SettingsError as error:
        return str(error)
    return ""


def test_benchmarks_and_configs_are_records():
    """Claim: a benchmark's record says what it shows and its command; the configs that docs name
    load; there are few files."""
    tracked = subprocess.run(
        ["git", "ls-files", index.RESULTS], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert len(tracked.stdout.splitlines()) <= 90
    for path in index.RESULTS.glob("bench/*.json"):
        for one in json.loads(path.read_text()).values():
            assert one["about"]
            assert one["command"].startswith("csac-jax ")
    for path in index.RESULTS.glob("configs/*.json"):
        configs.from_dict(json.loads(path.read_text()))


def test_figures_and_pictures_are_linked_and_small():
    """Claim: docs/figures and docs/pictures hold what README and docs show, and nothing else;
    stills have 960 x 720 pixels or more and less than 400 KB, the animation less than 4 MB."""
    assert {path.stem for path in figures.FIGURES.iterdir()} == figures.linked()
    linked = {name for page in PAGES for name in re.findall(r"pictures/([\w.]+)", page.read_text())}
    folder = ROOT / "docs" / "pictures"
    assert {path.name for path in folder.iterdir()} == linked
    for path in folder.iterdir():
        with Image.open(path) as picture:
            moving = picture.n_frames > 1 if path.suffix == ".webp" else False
            assert moving or (picture.width >= 960 and picture.height >= 720), path
        assert path.stat().st_size < (4e6 if moving else 4e5), path
    assert all(path.stat().st_size < 4e5 for path in figures.FIGURES.iterdir())


def test_links_lead_somewhere():
    """Claim: README and docs link to files that exist."""
    links = [(page, to) for page in PAGES for to in re.findall(r"\]\(([^)#\s]+)", page.read_text())]
    local = [(page, target) for page, target in links if not target.startswith("http")]
    assert len(local) > 50
    assert not [link for link in local if not (link[0].parent / link[1]).exists()]


def test_records_that_pages_name_exist():
    """Claim: each benchmark's record that README and docs name, as `bench/decide.json`, `cpu`, is
    there; so is each folder of runs, as `fast/csac_beta`."""
    text = "\n".join(page.read_text() for page in PAGES)
    pattern = r"`(bench/\w+\.json)`(?:, `([\w*/.-]+)`)?(?: and `([\w-]+)`)?"
    benchmarks = re.findall(pattern, text)
    assert len(benchmarks) > 40
    for path, *names in benchmarks:
        records = json.loads((index.RESULTS / path).read_text())
        assert all(fnmatch.filter(records, name) for name in names if name), (path, names)
    families = [path for path in ARCHIVES if path.parent == index.RESULTS]
    runs = [name for path in families for name in index.contents(path)]
    named = re.findall(
        r"`((?:fast|general|grippers|objects|paper|quick)/[\w*/-]+)`", re.sub(pattern, "", text)
    )
    assert len(named) > 20
    assert not [name for name in named if not fnmatch.filter(runs, f"{name}*")]
