"""The runner and the tables of the second study."""

import itertools
import json
import operator
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from csac_jax import algorithms, presets
from csac_jax.cli import failures
from csac_jax.errors import SettingsError
from csac_jax.io import configs, files
from csac_jax.report import result_tables
from csac_jax.sweeps import runner
from experiments import index, second_study, second_tables

ROOT = Path(__file__).parents[2]
PROTOCOL = (ROOT / "docs" / "study-protocol.md").read_text()
METRICS = ("completion", "action_efficiency", "pushes_per_episode")


def _table(title: str) -> list[list[str]]:
    """Returns the cells of the first table below a title of the protocol."""
    section = PROTOCOL.split(f"## {title}\n")[1].split("\n## ")[0]
    rows = [line.strip("|").split("|") for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in row] for row in rows[2:]]


def test_arms_are_those_of_the_protocol():
    """Claim: parts, numbers of arms, minutes and order are the protocol's; what must run fits into
    150 minutes, each arm into a call of 10; seeds are others than those of the first study."""
    found: list[list[str]] = []
    alike = operator.attrgetter("part", "minutes")
    for (name, _), group in itertools.groupby(second_study.arms(), alike):
        arms = list(group)
        minutes = f"{sum(arm.minutes for arm in arms):.1f}"
        found.append([name, str(len(arms)), f"{arms[0].minutes:.1f}", minutes])
    costs = [row[1:] for row in _table("Cost")]
    *needed, total, optional = [[name.split(",")[0], *rest] for name, *rest in costs]
    assert found == [*needed, [optional[0], *optional[1:]]]
    assert f"{sum(float(row[3]) for row in needed):.1f}" == total[3]
    assert float(total[3]) < 150.0
    assert all(arm.minutes < 10.0 and arm.seeds[0] >= 1000 for arm in second_study.arms())
    assert second_study.ABOUT.keys() == {arm.part for arm in second_study.arms()}
    row_suites = {
        (place, row.suite)
        for rows in second_tables.hypotheses().values()
        for row in rows
        for place in (*row.ours, *row.theirs)
    }
    suites = {(arm.place, suite) for arm in second_study.arms() for suite in arm.suites}
    assert row_suites <= suites  # each row of a hypothesis is measured
    numbers = {arm.part: arm.seeds[1] for arm in second_study.arms()}
    assert numbers == {row[0]: int(row[4]) for row in _table("Arms")}
    assert len({arm.place for arm in second_study.arms()}) == len(second_study.arms())


def test_arms_can_begin(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Claim: the sweep's parser reads each arm. Two arms that a hypothesis compares differ in what
    it is about alone; the paper's rule is a setting of CSAC."""
    monkeypatch.setattr(failures, "check_physics", lambda *_: None)  # no GPU is needed to plan
    plain = [arm for arm in second_study.arms() if arm.part != "methods"]
    cfgs = {arm.place: second_study.plan_of(arm, tmp_path).points[0].cfg for arm in plain}

    def changed(ours: str, theirs: str) -> set[str]:
        first, second = (configs.flat(configs.to_dict(cfgs[name])) for name in (ours, theirs))
        names = {name for name in first | second if first.get(name) != second.get(name)}
        return names - {"seed", "algo"}

    grasps = {"policy.primitive", "explore.push_fraction"}
    assert changed("pushes/enclosed-pushes", "pushes/enclosed-none") == grasps
    assert changed("pushes/blocked-pushes", "pushes/blocked-none") == grasps
    assert changed("control/uniform-16", "replay/uniform-16") == set()
    assert changed("replay/uniform-2", "replay/uniform-16") == {"learn.updates_per_step"}
    assert changed("replay/reaper-16", "replay/uniform-16") == {"parts"}
    assert changed("replay/geometric-2", "replay/uniform-2") == {"parts"}
    sampler = {"replay.sampler", "replay.rank_by", "replay.start", "replay.middle", "replay.end"}
    assert "replay.sampler" in changed("replay/beta-16", "replay/uniform-16") <= sampler
    assert changed("contact/100N-none", "contact/20N-none") == {"sim.down_force"}
    assert changed("contact/20N-none", "replay/uniform-16") == grasps
    assert changed("guarded/pushes", "replay/uniform-16") == {"sim.approach"}
    assert changed("search/csac_rule", "search/csac") == {"policy.primitive"}
    volume = [c.learn.batch * c.learn.updates_per_step / c.train.scenes for c in cfgs.values()]
    assert {"replay/uniform-2": 2.0, "replay/uniform-16": 16.0}.items() <= dict(
        zip(cfgs, volume, strict=True)
    ).items()
    assert {arm.name for arm in plain if arm.part == "search"} == {
        *(algorithms.ALGORITHMS.keys() & {arm.name for arm in plain}),
        "csac_rule",
    }


def test_search_chooses_by_completion(tmp_path: Path):
    """Claim: a method has the searched setting with most completion over its seeds; of equal ones
    the first by name; without a search there is one clear line. The report names it, and that
    with most blocks per action."""
    arms = {arm.place: arm for arm in second_study.arms()}
    method, search = arms["methods/vpg"], arms["search/vpg"]
    with pytest.raises(SettingsError, match="run the search first"):
        second_study.plan_of(method, tmp_path)
    plan = second_study.plan_of(search, tmp_path)
    place = tmp_path / search.place
    place.mkdir(parents=True)
    (place / files.SWEEP_PLAN).write_text(runner.plan_text(plan))
    with pytest.raises(SettingsError, match="evaluate the search first"):
        second_study.plan_of(method, tmp_path)
    completion = [(0.5, 0.5, 0.5), (0.2, 0.2, 0.9), (0.5, 0.6, 0.6), (0.5, 0.6, 0.6)]
    for point, values in zip(plan.points, completion, strict=True):
        for seed, value in enumerate(values):
            path = place / point.name / f"seed-{seed}" / "eval.json"
            path.parent.mkdir(parents=True)
            means = {"completion": value, "action_efficiency": 0.9 - value}
            share = {"low": 0.0, "high": 1.0, "n": 100}
            metrics = {name: {"value": mean, **share} for name, mean in means.items()}
            asked = {"policy": "learned", "suite": "in_distribution", "seed": 0}
            content = {**asked, **metrics, "config": configs.to_dict(point.cfg)}
            path.write_text(json.dumps(content | {"grasp_success": metrics["completion"]}))
    (point,) = second_study.plan_of(method, tmp_path).points
    assert (point.cfg.learn.learning_rate, point.cfg.explore.epsilon_place) == (5e-4, (0.0, 0.0))
    assert (point.cfg.algo, point.cfg.train.actions, point.cfg.seed) == ("vpg", 2500, 1000)
    archive = tmp_path / "archives" / "second-search.tar.xz"
    second_study._write_archive(archive, "a test", place.parent, list(place.rglob("eval.json")))
    (row,) = second_tables.searched(archive.parent)
    names = [point.name for point in plan.points]
    best = {"completion": f"{names[3]}: 0.567", "blocks / actions": f"{names[1]}: 0.467"}
    assert row == {"searched": "vpg", **best}


@pytest.mark.slow
def test_smoke(tmp_path: Path):
    """Claim: `run` begins no arm that does not fit into its minutes; it trains an arm with a
    sampler of the study and evaluates its policies; once more it has nothing left. `pack` writes
    an archive that `report` reads and that holds no path of this machine."""

    def call(*words: str) -> subprocess.CompletedProcess:
        command = [sys.executable, "-m", "experiments.second_study", *words, "--smoke"]
        env = os.environ | {"PYTHONPATH": str(ROOT)}
        return subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True)

    early = call("run", "runs", "--minutes", "0.2", "--jobs", "1")
    assert (early.returncode, (tmp_path / "runs").exists()) == (3, False), early.stderr
    assert "replay/reaper-16: not begun" in early.stdout
    done = call("run", "runs", "--jobs", "1")
    assert done.returncode == 0, done.stderr
    assert "evaluated replay/reaper-16" in done.stdout
    again = call("run", "runs", "--jobs", "1")
    assert (again.returncode, again.stdout) == (0, ""), again.stderr
    assert "| replay/reaper-16 | 1000 to 1001 | 0.5 | done |" in call("status", "runs").stdout
    packed = call("pack", "runs", "--archives", "archives")
    archive = tmp_path / packed.stdout.strip()
    contents = index.contents(archive)
    runs = [f"reaper-16/base/seed-{seed}" for seed in (1000, 1001)]
    names = ("config.json", "eval.json", "metrics.jsonl")
    plan = {f"reaper-16/{name}" for name in ("sweep.json", "summary.json", "groups/0/done")}
    written = {f"{run}/{n}" for run in runs for n in names}
    assert contents.keys() == {"about.json", *plan, *written}
    assert call("unpack", "elsewhere", "--archives", "archives").returncode == 0
    there = call("run", "elsewhere", "--jobs", "1")
    assert (there.returncode, there.stdout) == (0, ""), there.stderr
    assert not re.search(rb'"(?:/|~/)|"host', b"\n".join(contents.values()))
    config = json.loads(contents[f"{runs[0]}/config.json"])
    assert config["parts"].startswith("sampler experiments.samplers.ReaPER(scenes=2")
    report = call("report", "--archives", "archives").stdout
    assert "| replay/reaper-16 | in_distribution |" in report


PAGE_ROWS = {  # of docs/study.md: pair of arms, suite, part
    "`enclosed`": ("enclosed", "enclosed", None),
    "`blocked`": ("blocked", "blocked", None),
    "`tray`": ("blocked", "tray", None),
    "`target`, ridge": ("enclosed", "target", "ridge"),
    "`target`, row": ("enclosed", "target", "row"),
    "`target`, random10": ("enclosed", "target", "random10"),
    "`random10`, cleared": ("blocked", "random10", None),
}


def _archived(arm: str, suite: str, part: str | None) -> float:
    """Returns an arm's completion, per cent, from the records alone."""
    contents = index.contents(index.STUDY / "second-pushes.tar.xz")
    names = [name for name in contents if re.fullmatch(rf"{arm}/.*/eval-{suite}\.json", name)]
    tables = [json.loads(contents[name]) for name in names]
    found = [(one["parts"][part] if part else one)["completion"]["value"] for one in tables]
    assert len(found) == 5
    return 100.0 * float(stats.trim_mean(found, 0.25))


def test_page_says_what_was_measured():
    """Claim: completions, differences and verdicts of docs/study.md are those of the archive;
    README has those of two rows."""
    readme = " ".join((ROOT / "README.md").read_text().split())
    page = (ROOT / "docs" / "study.md").read_text().split("## Does a push help?")[1]
    lines = [line for line in page.split("\n## ")[0].splitlines() if line.startswith("| `")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    named = second_tables.hypotheses()
    judged = [*named["H1"], *named["H2"]]
    found = {k: v for name in ("H1", "H2") for k, v in _judged(named[name]).items()}
    assert [name for name, *_ in cells] == list(PAGE_ROWS)
    for (name, ours, theirs, gap, verdict), row in zip(cells, judged, strict=True):
        where, suite, part = PAGE_ROWS[name]
        wanted = [_archived(f"{where}-{kind}", suite, part) for kind in ("pushes", "none")]
        assert [ours, theirs] == [f"{value:.1f} %" for value in wanted]
        assert gap.startswith(f"{wanted[0] - wanted[1]:+.1f} (")
        assert (gap, verdict) == (_shown(found[row.name]), found[row.name].verdict)
        if name in ("`enclosed`", "`blocked`"):
            assert re.search(rf"of {name} {wanted[0]:.0f}\D+{wanted[1]:.0f} %", readme)


def _judged(rows: list[second_tables.Row]) -> dict[str, second_tables.Difference]:
    return second_tables.judge(index.STUDY, rows)


def _shown(found: second_tables.Difference) -> str:
    return result_tables.shown(found.band, "+", "completion")


def _draw(place: str, suite: str, part: str, count: int) -> dict[str, np.ndarray]:
    """Returns a metric of each seed [count], the same for the same words."""
    rng = np.random.default_rng(list(f"{place} {suite} {part}".encode()))
    return {name: np.round(rng.uniform(0.3, 0.7, count), 2) for name in METRICS}


@pytest.fixture
def recorded(tmp_path: Path) -> Callable[..., Path]:
    """Returns a function that writes archives with an evaluation for each seed of arms."""

    def write(given: dict[tuple[str, str, str], dict[str, np.ndarray]]) -> Path:
        contents: dict[str, dict[Path, Any]] = {}
        config = configs.to_dict(presets.smoke())
        for (place, suite, part), columns in given.items():
            family, _, arm = place.partition("/")
            for i, row in enumerate(zip(*columns.values(), strict=True)):
                path = Path(arm, "base", f"seed-{1000 + i}", f"eval-{suite}.json")
                head = {"policy": "learned", "suite": suite, "seed": 0, "config": config}
                one = contents.setdefault(family, {}).setdefault(path, {**head, "parts": {}})
                share = {"low": 0.0, "high": 1.0, "n": 100}
                named = zip(columns, row, strict=True)
                one["parts"][part] = {name: {"value": value, **share} for name, value in named}
        for family, evaluations in contents.items():
            folder = tmp_path / "runs" / family
            for path, content in evaluations.items():
                files.write_json(folder / path, content)
            archive = tmp_path / "archives" / f"second-{family}.tar.xz"
            paths = [folder / path for path in evaluations]
            second_study._write_archive(archive, "a test", folder, paths)
        return tmp_path / "archives"

    return write


def _completion(values: Any) -> dict[str, np.ndarray]:
    return dict.fromkeys(METRICS, np.asarray(values, float))


def test_verdicts(recorded: Callable[..., Path]):
    """Claim: p is the share of all permutations of seeds with as large a difference of
    interquartile means; Holm counts every row of a hypothesis, also those to come; a seed counts
    with its mean over parts; a row waits for all of its arms."""
    low, high = np.array([0.1, 0.2, 0.3, 0.4, 0.2]), np.array([0.5, 0.6, 0.7, 0.8, 0.6])
    archives = recorded(
        {
            ("pushes/enclosed-pushes", "enclosed", "enclosed"): _completion(high),
            ("pushes/enclosed-none", "enclosed", "enclosed"): _completion(low),
            ("pushes/blocked-pushes", "blocked", "blocked"): _completion(low),
            ("pushes/blocked-none", "blocked", "blocked"): _completion(high),
            ("methods/csac_rule", "target", "hole"): _completion(low),
            ("methods/csac_rule", "target", "row"): _completion(1.0 - low),
            ("methods/csac", "target", "hole"): _completion(high),
            ("methods/csac", "target", "row"): _completion(1.0 - high),
        }
    )
    rows = second_tables.hypotheses()
    found = second_tables.judge(archives, rows["H1"])
    everyone, middle = np.concatenate([high, low]), lambda x: stats.trim_mean(x, 0.25)
    gaps = [
        middle(everyone[list(ours)]) - middle(np.delete(everyone, list(ours)))
        for ours in itertools.combinations(range(10), 5)
    ]
    observed = middle(high) - middle(low)
    p = np.mean(np.abs(gaps) >= observed - 1e-12)
    assert_allclose(found["enclosed"].p, p)
    assert_allclose(found["enclosed"].band.value, observed)
    assert {name: one.verdict for name, one in found.items()} == {
        "enclosed": "leads",
        "blocked": "lags",
    }
    crowd = [*rows["H1"], *(rows["H1"][0]._replace(name=f"to come {i}", ours=()) for i in range(9))]
    assert second_tables.judge(archives, crowd)["enclosed"].verdict == "open"
    assert second_tables.judge(archives, rows["H5"])["target"].verdict == "equal"
    assert second_tables.judge(archives, rows["H2"]) == {}
    two_arms = ("pushes/enclosed-pushes", "settings/to come")
    assert second_tables.judge(archives, [rows["H1"][0]._replace(ours=two_arms)]) == {}


def test_a_control_that_differs_voids(recorded: Callable[..., Path]):
    """Claim: where uniform replay differs from its control, the report says that no row of samplers
    leads or lags."""
    column = np.linspace(0.1, 0.3, 8)
    given = {
        (f"replay/{name}-16", "enclosed", "enclosed"): _completion(column + gain)
        for name, gain in (("uniform", 0.0), ("reaper", 0.4))
    }
    for control, is_void in ((0.0, False), (0.5, True)):
        place = ("control/uniform-16", "enclosed", "enclosed")
        archives = recorded({**given, place: _completion(column + control)})
        second_tables.read.cache_clear()
        report = second_tables.report(archives, [])
        assert "| reaper, volume 16 | +40.0" in report
        assert ("**H3** (completion, points; the control differs" in report) == is_void


def test_claims_by_hand(recorded: Callable[..., Path], tmp_path: Path):
    """Claim: a method's row has completion and lifts per grasp over the parts of `target`, success
    over the last grasps of training, its area over the first 500 actions, and seconds."""
    lifts = {name: np.array([0.2, 0.6]) for name in (*METRICS, "action_efficiency_grasps")}
    parts = {("methods/vpg", "target", part): lifts for part in ("hole", "row")}
    archives = recorded(parts)
    config = configs.to_dict(algorithms.configure(presets.get("paper_small"), "vpg"))
    contents = {"config.json": json.dumps(config)}
    for seed, final in ((1000, 0.8), (1001, 0.6)):
        folder = tmp_path / "runs" / "methods" / "vpg" / "base" / f"seed-{seed}"
        rows = [(250, 0.2), (500, 0.4), (2500, final)]  # 0.2 before, and linear in between
        keys = ("actions", "grasp_success", "grasps_counted", "seconds", "step")
        lines = [dict(zip(keys, (n, share, 200, n / 10, n), strict=True)) for n, share in rows]
        contents["metrics.jsonl"] = "\n".join(map(json.dumps, lines)) + "\n"
        for name, text in contents.items():
            (folder / name).write_text(text)
    paths = list((tmp_path / "runs" / "methods").rglob("*.json*"))
    archive = archives / "second-methods.tar.xz"
    second_study._write_archive(archive, "a test", tmp_path / "runs" / "methods", paths)
    (row,) = second_tables.claims(archives)
    assert {title: cell.split(" (")[0] for title, cell in row.items()} == {
        "method": "vpg",
        "completion": "40.0 %",
        "lifts / grasp": "40.0 %",
        "training success": "70.0 %",
        "area, 500 actions": "25.0 %",
        "seconds": "250",
    }


def test_cells_are_recomputed(recorded: Callable[..., Path]):
    """Claim: ten cells of the tables follow from the archives by another way: plain JSON, SciPy's
    trimmed mean, a sorted quarter. Before the study has as many cells, from made archives."""
    places = [arm.place for arm in second_study.arms()]

    def rows_of(archives: Path) -> list[list[str]]:
        lines = second_tables.report(archives, places).splitlines()
        cells = [line.strip("| ").split(" | ") for line in lines if line.count("|") == 9]
        return [row for row in cells if "/" in row[0]]

    archives = index.STUDY
    if len(rows := rows_of(archives)) < 10:
        made = [place for place in places if place.startswith(("pushes", "settings"))]
        spots = [(place, s, "alike") for place in made for s in ("enclosed", "target")]
        archives = recorded({spot: _draw(*spot, 8) for spot in spots})
        rows = rows_of(archives)
    chosen = rows[:: max(1, len(rows) // 10)][:10]
    assert len(chosen) == 10
    for place, suite, part, *shown in chosen:
        values = _plainly(archives, place, suite, part)
        completion = values["completion"]
        expected = [np.mean(completion), stats.trim_mean(completion, 0.25)]
        expected += [np.mean(sorted(completion)[: -(-len(completion) // 4)])]
        texts = [f"{100 * value:.1f} %" for value in expected]
        texts += [f"{stats.trim_mean(values['action_efficiency'], 0.25):.3f}"]
        texts += [f"{stats.trim_mean(values['pushes_per_episode'], 0.25):.2f}"]
        assert [cell.split(" (")[0] for cell in shown] == texts, place


def _plainly(archives: Path, place: str, suite: str, part: str) -> dict[str, list[float]]:
    family, _, arm = place.partition("/")
    contents = index.contents(archives / f"second-{family}.tar.xz")
    found: dict[str, list[float]] = {name: [] for name in METRICS}
    for path, text in contents.items():
        if path.startswith(f"{arm}/") and "/eval" in path:
            content = json.loads(text)
            if content["suite"] == suite:
                table = content.get("parts", {part: content})[part]
                for name in METRICS:
                    found[name].append(table[name]["value"])
    return found
