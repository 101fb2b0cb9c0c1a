"""`csac-jax report` from recorded files to tables, figures and page."""

import base64
import hashlib
import json
import os
import re
import subprocess
import sys
import tarfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.axes import Axes

from csac_jax import algorithms, cli, presets
from csac_jax.cli import settings, train
from csac_jax.cli.evaluate import EvalOptions
from csac_jax.evaluation import metrics, statistics
from csac_jax.io import configs, files, seal
from csac_jax.report import comparison, figures, result_tables, results, variants
from csac_jax.report.comparison import ResultReport

CASES = ("hole", "row")
PUSHES = Path(__file__).parents[2] / "experiments" / "results" / "bench" / "push_suites.json"
MANY = {"net__head": 16, "learn__batch": 4, "learn__tau": 0.5, "cem__start": "actor"}
MANY |= {"learn__updates_per_step": 9, "target__gamma": 0.1, "train__actions": 90}


def _config(algo: str, seed: int, **changed: Any) -> dict[str, Any]:
    config = configs.to_dict(algorithms.configure(presets.get("paper"), algo)) | {"seed": seed}
    for name, value in changed.items():
        section, _, field = name.partition("__")
        config[section][field] = value
    return config


def _run(folder: Path, config: dict[str, Any], success: list[float], record: Any = None) -> None:
    """Writes a run as `train` does: 100 actions and 10 s a chunk, no grasp in the first."""
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(config))
    if record is not None:
        content = {"wall_seconds": 77.0, "config": config, **record}
        (folder / "train.json").write_text(json.dumps(content))
    names = ("step", "actions", "seconds", "grasp_success", "grasps_counted")
    rows = [(i, 100 * i, 10.0 * i, value, 200) for i, value in enumerate([None, *success], 1)]
    lines = [json.dumps(dict(zip(names, row, strict=True))) + "\n" for row in rows]
    (folder / "metrics.jsonl").write_text("".join(lines) + '{"actions": 9')


def _evaluation(
    path: Path, config: Any, lifted: int, suite: str = "cases", episodes: int = 10
) -> None:
    """Writes what `eval --json` does: 10 grasps in each case, so many of them lifts."""
    share = metrics.wilson(lifted, 10)
    part = dict.fromkeys(results.METRICS, share) | {"counts": {"episodes": episodes}}
    content = {"policy": "learned", "suite": suite, "seed": 5, "seconds": 3.0, "device": "a card"}
    content |= {"parts": dict.fromkeys(CASES, part), "config": config}
    path.write_text(json.dumps(content))


@pytest.fixture(autouse=True)
def close_figures() -> Iterator[None]:
    """Closes the figures of a test."""
    yield
    plt.close("all")


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    """Writes two seeds of CSAC-beta, one of which ended early, one of VPG, one ablation, and the
    evaluations of the first three."""
    root, physics = tmp_path / "sweep", {"sim__physics": "c"}
    card = {"device": "a card", "commit": "abc"}
    _run(root / "beta" / "seed-0", _config("csac_beta", 0), [0.5, 0.8, 0.95], card)
    _run(root / "beta" / "seed-1", _config("csac_beta", 1), [0.7, 0.9])
    sweep = {"settings": [], "wall_seconds": 99.0, "device": "two cards"}
    (root / "train.json").write_text(json.dumps(sweep))
    _run(root / "vpg", _config("vpg", 0), [0.2, 0.3, 0.4])
    _run(root / "max", _config("csac_beta", 0, target__value="max"), [0.1, 0.2, 0.3])
    for seed, lifted in enumerate((10, 8)):
        path = root / f"beta/seed-{seed}/eval.json"
        _evaluation(path, _config("csac_beta", seed, **physics), lifted)
    _evaluation(root / "vpg" / "eval.json", _config("vpg", 0, **physics), 5)
    (root / "max" / "checkpoints").mkdir()
    (root / "vpg" / "checkpoints").mkdir()
    (root / "vpg" / "checkpoints" / "metrics.jsonl").write_text("not a log\n")
    return root


def _report(*paths: Path, reference: str | None = None) -> ResultReport:
    return comparison.build(results.read(paths), reference)


def _scored(report: ResultReport, algo: str) -> list[comparison.Score]:
    return [score for score in report.scores if score.variant.algo == algo]


def test_runs_are_grouped_by_what_they_are(recorded: Path):
    """Claim: runs that differ in their seed alone are one curve, the IQM of both up to where the
    shorter ends."""
    curves = {comparison.label(one.variant, False): one for one in _report(recorded).curves}
    assert set(curves) == {"CSAC-beta", "VPG", "CSAC-beta, target.value max"}
    both = curves["CSAC-beta"]
    actions, success = both.points()
    assert actions.tolist() == [200, 300]
    assert [band.value for band in success] == pytest.approx([0.6, 0.85])
    assert (success[0].low, success[0].high) == pytest.approx((0.5, 0.7))
    assert statistics.band([both.final]).value == pytest.approx(0.925)
    # to 300 actions: first value held to 200, then linear
    areas = [(200 * 0.5 + 100 * 0.65) / 300, (200 * 0.7 + 100 * 0.8) / 300]
    assert np.concatenate(both.area) == pytest.approx(areas)
    assert [run.seconds[-1] for run in both.runs] == [40.0, 30.0]


def test_one_policy_measured_twice_is_not_two_runs(recorded: Path):
    """Claim: evaluations of other lengths, and so of other scenes, are not averaged."""
    _evaluation(recorded / "vpg/long.json", _config("vpg", 0, sim__physics="c"), 9, episodes=40)
    scores = _scored(_report(recorded), "vpg")
    values = {one.episodes: [one.only(c).band("completion").value for c in CASES] for one in scores}
    assert values == {10: [0.5] * 2, 40: [0.9] * 2}


def test_command_loads_the_modules(tmp_path: Path):
    """Claim: a recorded command loads the modules of one's own that the run or evaluation had."""
    own = {"modules": {"mine": "0123456789ab"}}
    _run(tmp_path / "a", _config("vpg", 0), [0.5], own)
    _evaluation(tmp_path / "a" / "eval.json", _config("vpg", 0), 5)
    content = json.loads((tmp_path / "a" / "eval.json").read_text()) | own
    (tmp_path / "a" / "eval.json").write_text(json.dumps(content))
    rows = result_tables.provenance(_report(tmp_path))
    assert len(rows) == 2
    assert all(row["settings as a command"].endswith(" --import mine") for row in rows)


def test_own_parts_are_other_variants(tmp_path: Path):
    """Claim: runs and evaluations with parts of one's own are named by them and not pooled with
    others of the same config; with a learner of one's own no algorithm is named. Their command says
    that an option does not make them."""
    for name, parts in (("plain", {}), ("a", {"parts": "sampler my.Mine @0123456789ab"})):
        for seed in range(2):
            _run(tmp_path / name / f"seed-{seed}", _config("csac_beta", seed) | parts, [0.5, 0.6])
            path = tmp_path / name / f"seed-{seed}/eval.json"
            _evaluation(path, _config("csac_beta", seed) | parts, 5)
    _run(tmp_path / "b", _config("csac_beta", 0) | {"parts": "learner my.Own @0123456789ab"}, [0.5])
    report = _report(tmp_path)
    names = {variants.label(curve.variant): len(curve.runs) for curve in report.curves}
    mine = "CSAC-beta (paper), sampler my.Mine @0123456789ab"
    own = "own learner (paper), learner my.Own @0123456789ab"
    assert names == {"CSAC-beta (paper)": 2, mine: 2, own: 1}
    assert {score.name: score.seeds for score in report.scores} == {"CSAC-beta (paper)": 2, mine: 2}
    rows = result_tables.provenance(report)
    commands = {row["file"]: row["settings as a command"] for row in rows}
    by = ", by csac_jax.train with sampler my.Mine @0123456789ab"
    assert commands["a/seed-0/metrics.jsonl"].endswith(by)
    assert "parts" not in commands["a/seed-0/metrics.jsonl"]  # no option makes them
    assert "parts" not in commands["a/seed-0/eval.json"]
    assert " by " not in commands["plain/seed-0/metrics.jsonl"]
    both = _report(tmp_path / "plain", tmp_path / "b")
    charts = {chart.name: chart.figure for chart in figures.draw(both)}
    legend = charts["variants-paper"].axes[0].get_legend()
    assert legend.get_texts()[0].get_text() == "CSAC-beta (2)"


def test_numbers_as_json(recorded: Path):
    """Claim: the JSON has every curve and score with its seeds, and where each number comes
    from."""
    content = json.loads(json.dumps(result_tables.as_json(_report(recorded))))
    beta = next(c for c in content["curves"] if c["algo"] == "csac_beta" and not c["changed"])
    assert (beta["seeds"], beta["seconds_to_90"]) == ([0, 1], [40.0, 30.0])
    scores = {(score["algo"], score["part"]): score for score in content["scores"]}
    assert set(scores) == {(algo, case) for algo in ("csac_beta", "vpg") for case in CASES}
    hole, alone = scores["csac_beta", "hole"], scores["vpg", "row"]["metrics"]["completion"]
    assert (hole["physics"], hole["seed"], hole["seeds"]) == ("c", 5, [0, 1])
    wanted = {"value": 0.9, "low": 0.8, "high": 1.0, "n": 2}
    assert hole["metrics"]["completion"] == pytest.approx(wanted)
    assert alone == pytest.approx(metrics.wilson(5, 10) | {"n": 1})
    rows = {row["file"]: row for row in content["provenance"]}
    first, swept, single = (
        rows[f"{name}/metrics.jsonl"] for name in ("beta/seed-0", "beta/seed-1", "vpg")
    )
    assert (first["wall time"], single["wall time"]) == ("77 s", "40 s")  # the log's last time
    assert (swept["device"], swept["wall time"]) == ("two cards", "99 s, whole sweep")
    command = "csac-jax train paper --algo csac_beta --seed 0 --sim.physics c"
    assert first["settings as a command"] == command


def test_evaluation_ends_with_the_mean_of_the_parts(recorded: Path):
    """Claim: after the parts of a suite a row has their mean, over all episodes."""
    rows = result_tables.evaluation(_report(recorded))
    beta = [row for row in rows if row["policy"] == "CSAC-beta (paper)"]
    assert [row["part"] for row in beta] == ["cases: hole", "cases: row", "cases: mean of 2 parts"]
    assert (beta[-1]["runs"], beta[-1]["episodes"]) == ("2", "40")
    assert beta[-1]["completion"].startswith("90.0 % (")


def test_differences_are_of_several_seeds_in_the_same_scenes(recorded: Path):
    """Claim: the reference is compared with every other variant of which several seeds were
    measured in the same scenes, part by part and over all; `--reference` names another one."""
    assert not result_tables.differences(_report(recorded))  # VPG has one seed
    for seed, lifted in ((1, 3), (2, 4)):
        config = _config("vpg", seed, sim__physics="c")
        _evaluation(recorded / "vpg" / f"more-{seed}.json", config, lifted)
        config = _config("csac_beta", seed, sim__physics="c", target__value="max")
        _evaluation(recorded / "max" / f"other-{seed}.json", config, lifted, episodes=20)
    report = _report(recorded)
    pairs = list(comparison.pairs(report))
    assert [tuple(theirs.parts) for _, theirs in pairs] == [("hole",), ("row",), CASES]
    for ours, theirs in pairs:
        assert (ours.variant.algo, ours.variant.changed) == ("csac_beta", ())
        assert (theirs.variant.algo, tuple(ours.parts)) == ("vpg", tuple(theirs.parts))
        band = comparison.compared(ours, theirs, statistics.difference, results.METRICS)
        value, low, high, _ = band["grasp_success"]
        assert value == pytest.approx(0.9 - 0.4)  # 10 and 8 of 10, and 5, 3 and 4
        assert 0.3 <= low < 0.5 < high <= 0.7
    cells = [row["grasp success"] for row in result_tables.differences(report)]
    assert all(one.startswith("+50.0 (+") and one.endswith(", P 100 %") for one in cells)
    other = result_tables.differences(_report(recorded, reference="vpg"))
    assert [row["grasp success"][:5] for row in other] == ["-50.0"] * 3
    with pytest.raises(ValueError, match="no result of csac_per; there are: csac_beta, vpg"):
        _report(recorded, reference="csac_per")


def test_training_is_compared_where_it_is_alike(tmp_path: Path):
    """Claim: the reference's lead in training is over variants of several seeds that were trained
    as long in the same scenes and task, and no others."""
    others = {"base": {}, "max": {"target__value": "max"}, "clear": {"task__kind": "clear"}}
    others["packed"] = {"scene__packed_fraction": 0.5}
    for name, changed in others.items():
        for seed, last in enumerate((0.9, 0.8) if name == "base" else (0.5, 0.6)):
            _run(tmp_path / name / str(seed), _config("csac_beta", seed, **changed), [0.5, last])
    for seed in range(2):
        _run(tmp_path / "short" / str(seed), _config("csac_per", seed), [0.5])
    _run(tmp_path / "once", _config("vpg", 0), [0.5, 0.5])
    (row,) = result_tables.training_differences(_report(tmp_path))
    assert row["of"] == "CSAC-beta (paper), target.value max"
    assert row["final success"] == "+30.0 (+20.0 to +40.0), P 100 %"
    assert row["area under the curve"].startswith("+5.0 (")  # of the last third, 15 points


def test_repeats_of_a_seed_are_no_seeds(recorded: Path):
    """Claim: a run repeated on another host is no further seed: it counts in its seed's mean, and
    two hosts of one seed are not compared with others and get no band."""
    _run(recorded / "again" / "seed-1", _config("csac_beta", 1), [0.7, 0.5])
    _run(recorded / "vpg-again", _config("vpg", 0), [0.2, 0.3, 0.5])
    for name in "ab":  # as long as the shorter of CSAC-beta's
        _run(recorded / f"per-{name}", _config("csac_per", 0), [0.2, 0.3])
    _evaluation(recorded / "again" / "eval.json", _config("csac_beta", 1, sim__physics="c"), 2)
    report = _report(recorded)
    curves = {comparison.label(one.variant): one for one in report.curves}
    final = sorted(sorted(one.tolist()) for one in curves["CSAC-beta (paper)"].final)
    assert final == [[0.5, 0.9], [0.95]]
    rows = {row["method"]: row for row in result_tables.training(report)}
    assert (rows["VPG (paper)"]["runs"], rows["VPG (paper)"]["final success"]) == ("2", "45.0 %")
    assert not result_tables.training_differences(report)
    (score,) = _scored(report, "csac_beta")
    assert (score.seeds, score.band("completion").value) == (2, pytest.approx((1.0 + 0.5) / 2))


def test_rates_of_training_stand_side_by_side(tmp_path: Path):
    """Claim: the training table has blocks per action, lifts per grasp, actions and pushes per
    episode, over all of training; a dash where a run has not recorded them."""
    counts = {"pushes": 4, "grasps": 6, "outcomes": {"lifted": 3}, "cleared": 5}
    ends = {"terminated": 1, "truncated": 1}
    _run(tmp_path / "with", _config("vpg", 0), [0.5, 0.5])
    log = tmp_path / "with" / files.METRICS
    lines = [json.loads(line) | counts for line in log.read_text().splitlines()[:-1]]
    lines = [line | (ends if i else dict.fromkeys(ends, 0)) for i, line in enumerate(lines)]
    log.write_text("".join(json.dumps(line) + "\n" for line in lines))
    _run(tmp_path / "without", _config("csac_per", 0), [0.5, 0.5])
    rows = result_tables.training(_report(tmp_path))
    cells = [[row[name] for name in result_tables.RATES] for row in rows]
    # 3 chunks of 10 actions: 15 blocks, 9 lifts of 18 grasps, 12 pushes, 4 episodes
    assert cells == [["0.500", "50.0 %", "7.50", "3.00"], ["-"] * 4]


def test_older_evaluations_give_actions_and_pushes_by_their_counts(tmp_path: Path):
    """Claim: an evaluation without metrics per episode gets them from its counts, without an
    interval; one that has them keeps its own."""
    path = tmp_path / "eval.json"
    _evaluation(path, _config("vpg", 0), 5)
    content = json.loads(path.read_text())
    for part in content["parts"].values():
        part["counts"] |= {"pushes": 30, "grasps": 20}
        del part["pushes_per_episode"]
    path.write_text(json.dumps(content))
    row = result_tables.evaluation(_report(path))[0]
    assert row["pushes / episode"] == "3.00"
    assert row["actions / episode"].startswith("0.50 (")  # what `_evaluation` wrote


def test_old_names_are_read_as_todays(tmp_path: Path):
    """Claim: logs, evaluations and configs with former names say what they would say now, a config
    of a network that is gone, too."""
    old = _config("csac_beta", 0) | {"net": {"kind": "offset"}}
    old["scene"]["arranged"] = 0.5
    del old["scene"]["packed_fraction"]
    _run(tmp_path / "run", old, [0.5])
    (run,) = results.read([tmp_path / "run"]).runs
    assert dict(run.variant.changed).items() >= {"scene.packed_fraction": "0.5"}.items()
    line = {"step": 1, "actions": 8, "grasps_counted": 0, "seconds": 1.0}
    log = tmp_path / "run" / "metrics.jsonl"
    log.write_text(json.dumps({**line, "ill": 1, "left": 2, "saturated": 3}) + "\n")
    new = {"physics_diverged": 1, "blocks_lost": 2, "contact_overflow": 3}
    assert files.read_log(log) == [{**line, **new}]
    share = metrics.wilson(1, 10)
    part = {"completion": share, "counts": {"left": 2}}
    content = {"policy": "learned", "suite": "own", "parts": {"own": part}, "config": old}
    (tmp_path / "eval.json").write_text(json.dumps(content))
    (one,) = results.read([tmp_path / "eval.json"]).evaluations
    assert (one.suite, one.part) == ("in_distribution", "in_distribution")
    assert one.metrics["counts"] == {"blocks_lost": 2}
    assert one.config["scene"]["packed_fraction"] == 0.5


def test_robots_of_training_are_told_apart(tmp_path: Path):
    """Claim: runs with another robot are another variant; an evaluation with another robot stays
    of its run's variant."""
    for robot in ("hand", "ur5"):
        _run(tmp_path / robot, _config("csac_beta", 0, sim__robot=robot), [0.5])
        for other in ("hand", "ur5"):
            config = _config("csac_beta", 0, sim__robot=other)
            _evaluation(tmp_path / robot / f"eval-{other}.json", config, 5)
    found = results.read([tmp_path])
    trained = {run.path.parent.name: run.variant for run in found.runs}
    changed = {name: variant.changed for name, variant in trained.items()}
    assert changed == {"hand": (), "ur5": (("sim.robot", "ur5"),)}
    assert all(one.variant == trained[one.path.parent.name] for one in found.evaluations)


def test_command_gives_the_config_back():
    """Claim: the command in the provenance, parsed, is the run's config."""
    changed = {"learn__augment": False, "policy__place": "argmax", "train__actions": 900}
    changed |= {"reward__grasp_levels": [-1.5, -1.5, -1.5, -1.0, 1.0], "net__head": 16}
    config = _config("csac_per", 7, **changed)
    program, command, *flags = variants.train_command(config).split()
    assert (program, command) == ("csac-jax", "train")
    assert configs.to_dict(train.read(flags)[1]) == config


SEEN = {"size": [320, 240], "focal": [309.0, 309.5], "centre": [159.5, 119.5]}
SEEN = {f"camera__{name}": value for name, value in SEEN.items()}
OBJECTS = {"scene__slots": ["object"], "scene__min_blocks": 1, "scene__split": "all"}
TWO, OTHER = (OBJECTS | {"scene__objects": f"procedural:{seed}:9"} for seed in (2, 1))


@pytest.mark.parametrize(
    ("trained", "evaluated", "options"),
    [
        ({}, {"sim__gripper": "2f85"}, "--sim.gripper 2f85"),
        ({}, {"policy__augment": True}, "--augment on"),
        ({"policy__augment": True}, {}, "--augment off"),
        ({}, {"policy__height_bonus": 3.0}, "--height-bonus 3.0"),
        ({"policy__retry_temperature": 0.1}, {}, "--retry-temperature 0.0"),
        (OTHER, TWO, "--objects procedural:2:9 --split all"),
        ({"heightmap__view": "oblique", "sensor__kind": "d415"}, SEEN, None),
        (SEEN, SEEN, ""),
    ],
)
def test_options_of_an_evaluation(trained: Any, evaluated: Any, options: str | None):
    """Claim: an evaluation's command has the options whose settings differ from the policy's
    config, and no others; parsed, they give its view back."""
    before, seen = (
        _config("csac_beta", 0, **({"policy__augment": False} | one))
        for one in (trained, evaluated)
    )
    asked = "--policy learned --suite random10 --episodes 5 --seed 3"
    start = f"csac-jax eval RUN {asked} --physics c --robot hand"
    command = variants.eval_command(asked, seen, before)
    assert command.startswith(start)
    assert options in (None, command.removeprefix(start).strip())
    parsed, view = settings.parse_view(EvalOptions, "eval", command.split()[2:])
    assert (parsed.episodes, parsed.seed, parsed.suites) == (5, 3, ("random10",))
    if evaluated is SEEN:
        assert configs.to_dict(configs.from_dict(before).change(**view)) == seen
    if evaluated is TWO:
        assert (parsed.objects, parsed.split) == ("procedural:2:9", "all")


def _entry(path: Path, name: str, completed: int) -> None:
    """Writes what `eval --out` does for a suite, with its digest."""
    share = metrics.wilson(completed, 10)
    content = {"policy": "learned", "name": name, "suite": "blocked", "seed": 0, "episodes": 10}
    content |= dict.fromkeys(results.METRICS, share) | {"config": _config("csac_beta", 0)}
    files.write_json(path, seal.seal(content))


def test_results_of_others_are_one_table(tmp_path: Path, capsys: pytest.CaptureFixture):
    """Claim: results with digests and a benchmark's record make one table by suite and policy, what
    completes most first, each result once. One that was changed is refused in one line."""
    mine, theirs = tmp_path / "mine", tmp_path / "theirs"
    for folder, completed in ((mine, 8), (theirs, 5)):
        _entry(folder / "blocked.json", folder.name, completed)
    command = ["report", str(mine), str(theirs), str(theirs), str(PUSHES)]
    assert cli.main(command) == 0
    table = re.search(r"## Suites\n\n(.*?)\n\n", capsys.readouterr().out, re.DOTALL)
    assert table is not None
    cells = [[cell.strip() for cell in row.split("|")] for row in table[1].splitlines()]
    names = [row[2] for row in cells if row[1] == "blocked"]
    assert names.count("theirs") == 1
    assert names.index("planner") < names.index("mine") < names.index("theirs")
    assert names.index("theirs") < names.index("random")
    digest = json.loads((mine / "blocked.json").read_text())["sha256"]
    assert [row[9] for row in cells if row[2] == "mine"] == [digest[:12]]
    text = (mine / "blocked.json").read_text()
    (mine / "blocked.json").write_text(text.replace('"seed": 0', '"seed": 1', 1))
    assert cli.main(command) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{mine}/blocked.json: was changed after it was measured" in line


def test_what_looks_alike_says_how_it_differs(tmp_path: Path, capsys: pytest.CaptureFixture):
    """Claim: rows of one suite that were measured by another record, hand or setting say so, and
    what each record is about; a baseline in another world is no second run of it. Where nothing
    differs there is no such column."""
    share = metrics.wilson(8, 10)
    row = {"suite": "pile", "policy": "a", "episodes": 10, "seed": 0, "completion": share}
    record = {
        "weak": {"about": "of 20 N", "results": [{"opening": "full", **row}]},
        "strong": {"about": "of 100 N", "results": [{"opening": "fit", **row}, row | {"seed": 1}]},
    }
    files.write_json(tmp_path / "record.json", record)
    for opening in ("full", "fit"):
        config = _config("csac_beta", 0, sim__opening=opening)
        content = {"policy": "random", "suite": "blocked", "seed": 0, "episodes": 10}
        content |= dict.fromkeys(results.METRICS, share) | {"config": config}
        files.write_json(tmp_path / f"{opening}.json", seal.seal(content))

    def told(*names: str) -> str:
        assert cli.main(["report", *(str(tmp_path / name) for name in names)]) == 0
        return capsys.readouterr().out

    shown = told(".")
    column = [line.split("|")[10].strip() for line in shown.splitlines() if "| pile | a" in line]
    assert column == ["record weak, opening full", "record strong, opening fit", "record strong"]
    assert "- record strong: of 100 N" in shown
    assert [shown.count(f"| sim.opening {opening} |") for opening in ("full", "fit")] == [1, 1]
    evaluated = [line.split("|") for line in shown.splitlines() if line.startswith("| random")]
    assert len(evaluated) == 2
    assert {cells[3].strip() for cells in evaluated} == {"c, hand, 0"}
    assert {cells[4].strip() for cells in evaluated} == {"1"}
    assert "differs in" not in told("fit.json")


def test_digest_covers_the_content(tmp_path: Path):
    """Claim: the digest is SHA-256 of the rest as JSON with sorted keys and no spaces, whatever the
    order and the indentation of the file; content without one passes."""
    sealed = seal.seal({"b": (1, 0.1), "a": {"é": None}})
    rest = b'{"a":{"\\u00e9":null},"b":[1,0.1]}'
    assert sealed["sha256"] == hashlib.sha256(rest).hexdigest()
    assert seal.is_intact(dict(reversed(json.loads(json.dumps(sealed, indent=7)).items())))
    assert not seal.is_intact({**sealed, "b": [1, 0.2]})
    assert not seal.is_intact({**sealed, "c": 0})
    assert seal.is_intact({"b": 1})


def test_missing_things_are_noted(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture):
    """Claim: an empty folder, runs of different lengths, one of a kind, one not evaluated: one line
    each."""
    for name in ("empty", "bare"):
        (tmp_path / name).mkdir()
    line = {"step": 1, "actions": 8, "grasps_counted": 1, "seconds": 1.0, "grasp_success": 1.0}
    (tmp_path / "bare" / "metrics.jsonl").write_text(json.dumps(line) + "\n")
    assert cli.main(["report", str(recorded), str(tmp_path / "empty"), str(tmp_path / "bare")]) == 0
    notes = [line for line in capsys.readouterr().out.splitlines() if line.startswith("- ")]
    wanted = (
        "empty: holds no metrics.jsonl",
        "bare/metrics.jsonl: no readable config",
        "bare: holds no metrics.jsonl",
        "max: not evaluated; run: csac-jax eval",
        "CSAC-beta (paper): runs end at 300, 400 actions",
        "VPG (paper): one run only",
        "CSAC-beta (paper), target.value max: one run only",
    )
    assert [sum(text in note for note in notes) for text in wanted] == [1] * len(notes)


@pytest.mark.parametrize(
    ("place", "code"),
    [(None, 2), ("nowhere", 2), (".", 1), ("pipes", 1), ("pipes/eval.json", 1), ("/dev/zero", 1)],
)
def test_nothing_to_report(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
    place: str | None,
    code: int,
):
    """Claim: without anything to report there is one line that says so, and an exit code; a named
    pipe or a device, which never ends, is skipped at once."""
    monkeypatch.chdir(tmp_path)
    Path("pipes").mkdir()
    for name in ("metrics.jsonl", "eval.json", "config.json"):
        os.mkfifo(f"pipes/{name}")
    Path("pipes/zero.json").symlink_to("/dev/zero")
    begun = time.monotonic()
    assert cli.main(["report", *([place] if place else [])]) == code
    complaint = capsys.readouterr().err
    assert (place or "at least one folder") in complaint
    assert complaint.count("\n") == 1
    assert time.monotonic() - begun < 10.0


def _drawn(report: ResultReport) -> dict[str, list[Axes]]:
    return {chart.name: chart.figure.axes for chart in figures.draw(report)}


def _marks(panel: Axes) -> list[float]:
    lines = [line for line in panel.get_lines() if line.get_marker() in figures.MARKERS]
    values = np.concatenate([line.get_ydata() for line in lines])
    return sorted(values[np.isfinite(values)].tolist())


def test_figures(recorded: Path):
    """Claim: the methods have a line each, at most six in a panel and of different colours; suites
    have a mark per part and their mean, profiles, of several seeds, the share above each value."""
    charts = {"methods-paper", "variants-paper", "four-cases-cases-paper"}
    assert set(_drawn(_report(recorded))) == charts
    _evaluation(recorded / "vpg" / "more.json", _config("vpg", 1, sim__physics="c"), 3)
    drawn = _drawn(_report(recorded))
    assert set(drawn) == {*charts, "profiles-cases-paper"}
    panel = drawn["methods-paper"][0]
    lines = {line.get_label(): line.get_ydata().tolist() for line in panel.get_lines()}
    assert lines["CSAC-beta (2)"] == pytest.approx([60, 85])
    assert lines["VPG (1)"] == pytest.approx([20, 30, 40])
    assert 20 - 12 <= panel.get_ylim()[0] <= 20 - 1  # a little below the lowest value
    completion = drawn["four-cases-cases-paper"][0]
    assert _marks(completion) == pytest.approx([40, 40, 40, 90, 90, 90])
    assert [text.get_text() for text in completion.get_xticklabels()] == [*CASES, "mean"]
    profiles = drawn["profiles-cases-paper"][0].get_lines()
    shares = {line.get_label().split(" (")[0]: line.get_ydata() for line in profiles}
    at = {name: [share[i] for i in (20, 40, 60, 90)] for name, share in shares.items()}
    assert at == {"VPG": [100, 50, 0, 0], "CSAC-beta": [100, 100, 100, 50]}  # 5, 3; 10, 8
    found = _report(recorded).curves
    panels = figures.training([found[0]] * 7 + found[1:]).axes
    colours = [[line.get_color() for line in panel.get_lines()] for panel in panels]
    assert (list(map(len, colours)), len(set(colours[1]))) == ([6, 3], 3)


def test_page_needs_nothing_else(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture):
    """Claim: `report --out` writes one page with its figures and media inside, and the tables as
    text; `--json` the numbers."""
    out, numbers = tmp_path / "out", tmp_path / "report.json"
    for name in ("max/episode.webp", "max/checkpoints/no.png", "max/no.txt"):
        (recorded / name).write_bytes(b"picture")
    assert cli.main(["report", str(recorded), "--out", str(out), "--json", str(numbers)]) == 0
    assert {path.name for path in out.iterdir()} == {"index.html", "results.md"}
    html = (out / "index.html").read_text()
    assert re.search("<td>92.5 %", html)  # of CSAC-beta
    assert not re.findall('(?:src|href)="(?!#|data:)', html)
    assert html.index("<h2>Summary</h2>") < html.index('id="curves"') < html.index('id="tables"')
    drawn = [
        base64.b64decode(one).decode() for one in re.findall(r"svg\+xml;base64,([^\"]+)", html)
    ]
    assert len(drawn) == 3
    assert "CSAC-beta (2)" in drawn[0]  # text is text
    assert html.count(base64.b64encode(b"picture").decode()) == 1
    printed = capsys.readouterr().out
    assert (out / "results.md").read_text() in printed
    assert len(json.loads(numbers.read_text())["curves"]) == 3


def test_page_is_a_file_or_a_folder(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
):
    """Claim: `--out` of a name in .html writes that file, and of another name a folder. What is
    there as the other kind is one line, and so are relative and absolute runs together read."""
    monkeypatch.chdir(recorded)
    assert cli.main(["report", "vpg", str(recorded / "beta"), "--out", "new/page.html"]) == 0
    text = capsys.readouterr().out
    assert "| vpg/metrics.jsonl |" in text
    assert "| beta/seed-0/metrics.jsonl |" in text
    assert Path("new/page.html").read_text().startswith("<!doctype html>")
    assert cli.main(["report", "vpg", "--out", "new"]) == 0
    assert {path.name for path in Path("new").iterdir()} == {
        "page.html",
        "index.html",
        "results.md",
    }
    Path("folder.html").mkdir()
    capsys.readouterr()
    for out, message in (("folder.html", "is a folder"), ("new/results.md", "is a file")):
        assert cli.main(["report", "vpg", "--out", out]) == 2
        assert f"--out: {out} {message}; name another" in capsys.readouterr().err


def test_reads_without_jax(recorded: Path):
    """Claim: a report needs no JAX and no MuJoCo."""
    code = (
        "import sys; from csac_jax import cli; code = cli.main(['report', sys.argv[1]]); "
        "sys.exit(code or 3 * bool({'jax', 'mujoco'} & set(sys.modules)))"
    )
    command = [sys.executable, "-c", code, str(recorded)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("eval.json", "[" * 100_000),
        ("eval.json", '{"policy": "learned", "config": {}, "parts": {"a": {"completion": 3}}}'),
        ("train.json", '{"versions": 3}'),
        ("train.json", '{"config": []}'),
        ("config.json", '{"preset": ["paper"]}'),
        ("config.json", '{"sim": 0.5}'),
    ],
)
def test_damaged_record_is_left_out_with_a_note(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture, name: str, content: str
):
    """Claim: a record with damage of any kind is left out with a note, and the others are shown."""
    bad = tmp_path / "bad"
    _run(bad, _config("csac_beta", 9), [0.5])
    _evaluation(bad / "eval.json", _config("csac_beta", 9), 5)
    (bad / name).write_text(content)
    assert cli.main(["report", str(recorded), str(bad)]) == 0
    printed, complaint = capsys.readouterr()
    assert any(line.startswith(f"- {bad}") and "damaged" in line for line in printed.splitlines())
    assert "| CSAC-beta" in printed
    assert complaint == ""


def test_archive_is_read_as_its_folder(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture
):
    """Claim: an archive of runs, and a folder with one, give the tables of the folder; what it
    would write elsewhere, and links, are skipped; one that is cut off is one line and exit code
    2."""
    (recorded / "max" / "checkpoints").rmdir()  # of networks, which no archive holds
    path = tmp_path / "archives" / "runs.tar.xz"
    path.parent.mkdir()
    with tarfile.open(path, "w:xz") as archive:
        archive.add(recorded, "sweep")
        archive.add(recorded / "vpg" / "metrics.jsonl", "../outside.jsonl")
        link = tarfile.TarInfo("link.json")
        link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
        archive.addfile(link)
    printed = []
    for place in (recorded, path, path.parent):
        assert cli.main(["report", str(place)]) == 0
        printed.append(capsys.readouterr().out)
    assert len(set(printed)) == 1
    assert not list(tmp_path.rglob("outside.jsonl"))
    path.write_bytes(path.read_bytes()[:-400])
    assert cli.main(["report", str(path)]) == 2
    assert "is no archive of runs" in capsys.readouterr().err
