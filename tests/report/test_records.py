"""The recorded results and the documents that are written from them."""

import json
import re
import tarfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from PIL import Image

from csac_jax import cli
from experiments import figures, records, study

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "experiments" / "results"
RUN = re.compile(r"[a-z_]+/[a-z_0-9]+(-\d)?/seed-\d+/(config|train|eval[\w-]*)\.json")
SWEEP = re.compile(r"[a-z_]+/[a-z_0-9]+(-\d)?/(sweep|summary|train)\.json")
SEARCH = re.compile(r"search/[a-z_]+/[a-z_]+\.json")
STUDY = re.compile(r"study/\d-[a-z]+(-\d+)?\.tar\.xz")
BENCH = re.compile(r"bench/[a-z_]+/(cpu|xeon|epyc|h100|h200)[\w-]*\.json")


def test_results_page_is_what_report_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: docs/results.md is what `csac-jax report` writes of the recorded results, and the
    study's section what `experiments.study` does."""
    monkeypatch.chdir(ROOT)
    page = tmp_path / "results.md"
    assert cli.main(["report", "experiments/results", "--markdown", str(page)]) == 0
    written = page.read_text().replace(str(page), "docs/results.md")
    assert study.with_study(written) == study.RESULTS_PAGE.read_text()
    assert study.without_study(study.RESULTS_PAGE.read_text()) == written


def test_index_is_what_records_writes():
    """Claim: the README of the recorded results is generated."""
    assert records.readme() == (RESULTS / "README.md").read_text()


def test_study_has_the_tables_of_its_archives():
    """Claim: the results in docs/study.md are generated; every archive is of a part that is named
    there, and of seeds that are the study's; README says how many runs they hold."""
    assert study.page() == study.PAGE.read_text()
    assert sorted(study.ARCHIVES.iterdir()) == sorted(study.archives().values())
    every = [study.read(path) for path in study.archives().values()]
    runs = sum(len(found.runs) for found in every)
    assert f" has {runs:,} runs." in (ROOT / "README.md").read_text()
    for found in every:
        assert {run.config["seed"] for run in found.runs} <= set(range(100, 150))
        assert not [note for note in found.notes if "damaged" in note or "not evaluated" in note]


@pytest.mark.parametrize(
    ("row", "extent", "reached"),
    [("15 blocks, dense", "0.18:0.18", 18), ("30 blocks, loose", "0.248:0.248", 10)],
)
def test_study_counts_actions_until_nine_of_ten_grasps_lift(row: str, extent: str, reached: int):
    """Claim: "actions to 90 %" of part 7 are the interquartile mean over seeds of the actions at
    which, by a run's log, nine of ten of its last 200 grasps first had lifted; a run that never
    gets there counts whole."""
    name = re.compile(rf"7-{row[:2]}/\S+={extent}/seed-\d+/metrics.jsonl")
    actions = []
    with tarfile.open(study.ARCHIVES / "7-clutter.tar.xz") as archive:
        for member in filter(lambda member: name.fullmatch(member.name), archive):
            log = [json.loads(line) for line in archive.extractfile(member) or ()]
            full = [line for line in log if line["grasps_counted"] == 200]
            good = [line["actions"] for line in full if line["grasp_success"] >= 0.9]
            actions.append((*good, 2500)[0])
    mean = sum(sorted(actions)[5:15]) / 10
    _, shown, there = study.PAGE.read_text().split(f"\n| {row} | ")[1].split(" | ")[:3]
    assert (shown.split(" (")[0], there) == (f"{mean:,.0f}", str(reached))


def test_study_takes_the_samplers_of_part_1():
    """Claim: at 2,500 actions the samplers of part 2 are the runs of part 1 with the study's first
    20 seeds, and their evaluations in scenes like the training's; its laws are its own."""
    found = study.found()["2-replay-2500"]
    for method, curve in found.curves.items():
        law, _, task = method.rpartition(", ")
        source = f"1-{task}" if law in study.LAWS and not study.LAWS[law][1] else "2-"
        assert all(run.path.parts[-4].startswith(source) for run in curve.runs), method
        assert sorted(curve.seeds) == list(range(100, 120)), method
    assert found.scores.keys() == {"in_distribution"}


def test_every_record_has_a_claim():
    """Claim: the index names every folder of runs and every benchmark, and nothing else."""
    runs = {path.parent.parent for path in RESULTS.glob("*/*/seed-*/*.json")}
    assert {path.relative_to(RESULTS).as_posix() for path in runs} == set(records.RUNS)
    benches = {path.relative_to(RESULTS / "bench") for path in RESULTS.glob("bench/*/*.json")}
    assert {path.with_suffix("").as_posix() for path in benches} == set(records.BENCHES)


def test_records_lie_in_one_layout():
    """Claim: a record is a run's, a sweep's, a search's, a benchmark's or one of the study's
    archives, each in its place."""
    files = [path for path in RESULTS.rglob("*") if path.is_file() and path.name != "README.md"]
    assert len(files) > 400
    for path in files:
        name = path.relative_to(RESULTS).as_posix().replace("metrics.jsonl", "config.json")
        assert any(pattern.fullmatch(name) for pattern in (RUN, SWEEP, SEARCH, BENCH, STUDY)), name
        if path.suffix == ".json":
            assert isinstance(json.loads(path.read_text()), dict)


def test_every_figure_is_linked():
    """Claim: docs/figures holds what README and docs show, and nothing else."""
    assert {path.stem for path in figures.FIGURES.iterdir()} == figures.linked()


def test_pictures_are_linked_large_and_small_in_bytes():
    """Claim: docs/pictures holds what README and docs show; stills have 960 x 720 pixels or more
    and less than 400 KB, the animation less than 4 MB."""
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    shown = {name for page in pages for name in re.findall(r"pictures/([\w.]+)", page.read_text())}
    folder = ROOT / "docs" / "pictures"
    assert {path.name for path in folder.iterdir()} == shown
    for path in folder.iterdir():
        with Image.open(path) as picture:
            moving = picture.n_frames > 1 if path.suffix == ".webp" else False
            assert moving or (picture.width >= 960 and picture.height >= 720), path
        assert path.stat().st_size < (4e6 if moving else 4e5), path
    for path in figures.FIGURES.iterdir():
        assert path.stat().st_size < 4e5, path


def _links() -> Iterator[tuple[Path, str]]:
    for page in [ROOT / "README.md", RESULTS / "README.md", *(ROOT / "docs").rglob("*.md")]:
        for target in re.findall(r"\]\(([^)#\s]+)", page.read_text()):
            if not target.startswith("http"):
                yield page, target


def test_links_lead_somewhere():
    """Claim: what README, docs and the index link to is there."""
    links = list(_links())
    assert len(links) > 50
    assert not [link for link in links if not (link[0].parent / link[1]).exists()]
