"""`csac-jax report` from recorded files to tables, figures and page."""

import base64
import dataclasses
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes

from csac_jax import algorithms, cli, presets
from csac_jax.cli import settings, train
from csac_jax.cli.evaluation import EvalOptions
from csac_jax.evaluation import metrics, statistics
from csac_jax.io import configs, files
from csac_jax.report import charts, comparison, curves, page, results, tables, wording

CASES = ("hole", "row")


def _config(algo: str, seed: int, **changed: Any) -> dict[str, Any]:
    config = configs.to_dict(algorithms.configure(presets.get("paper"), algo))
    config["seed"] = seed
    for name, value in changed.items():
        section, _, field = name.partition("__")
        config[section][field] = value
    return config


def _run(
    folder: Path, config: dict[str, Any], success: list[float], record: dict[str, Any] | None = None
) -> None:
    """A run's folder as `train` writes it: 100 actions and 10 s a chunk, none but pushes in the
    first."""
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(config))
    if record is not None:
        (folder / "train.json").write_text(
            json.dumps({"wall_seconds": 77.0, "config": config, **record})
        )
    lines = [
        {
            "step": i + 1,
            "actions": 100 * (i + 1),
            "seconds": 10.0 * (i + 1),
            "grasp_success": value,
            "grasps_counted": 200,
        }
        for i, value in enumerate([None, *success])
    ]
    (folder / "metrics.jsonl").write_text(
        "".join(json.dumps(line) + "\n" for line in lines) + '{"actions": 9'
    )


def _evaluation(
    path: Path,
    config: dict[str, Any],
    lifted: int,
    suite: str = "cases",
    policy: str = "learned",
    episodes: int = 10,
) -> None:
    """What `eval --json` writes: 10 grasps in each case, so many of them lifts."""
    share = metrics.wilson(lifted, 10)
    part = dict.fromkeys(results.METRICS, share) | {"counts": {"episodes": episodes}}
    part["failures"] = {"grasp_dropped": metrics.wilson(10 - lifted, 10)}
    asked = {
        "policy": policy,
        "suite": suite,
        "seed": 5,
        "seconds": 3.0,
        "device": "a card",
        "commit": "0123456789abc",
    }
    path.write_text(json.dumps({**asked, "parts": dict.fromkeys(CASES, part), "config": config}))


@pytest.fixture(autouse=True)
def close_figures() -> Iterator[None]:
    """Closes what a test drew."""
    yield
    charts.plt.close("all")


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    """Two seeds of CSAC-beta, one of which ended early; one of VPG; one ablation; evaluations of
    the first three."""
    root = tmp_path / "sweep"
    _run(
        root / "beta" / "seed-0",
        _config("csac_beta", 0),
        [0.5, 0.8, 0.95],
        {"device": "a card", "commit": "abc"},
    )
    _run(root / "beta" / "seed-1", _config("csac_beta", 1), [0.7, 0.9])
    (root / "train.json").write_text(
        json.dumps({"settings": [], "wall_seconds": 99.0, "device": "two cards"})
    )
    _run(root / "vpg", _config("vpg", 0), [0.2, 0.3, 0.4])
    _run(root / "max", _config("csac_beta", 0, target__value="max"), [0.1, 0.2, 0.3])
    (root / "max" / "checkpoints").mkdir()
    for name, algo, seed, lifted in (
        ("beta/seed-0", "csac_beta", 0, 10),
        ("beta/seed-1", "csac_beta", 1, 8),
    ):
        _evaluation(root / name / "eval.json", _config(algo, seed, sim__physics="c"), lifted)
    _evaluation(root / "vpg" / "eval.json", _config("vpg", 0, sim__physics="c"), 5)
    (root / "vpg" / "checkpoints").mkdir()
    (root / "vpg" / "checkpoints" / "metrics.jsonl").write_text("not a log\n")
    return root


def test_band_covers_the_truth():
    """Claim: of ten seeds, the band holds the mean of a symmetric law in about 9 of 10
    repetitions."""
    drawn = np.random.default_rng(0)
    covered = 0
    for _ in range(200):
        found = statistics.band([drawn.normal(0.6, 0.1, 10), drawn.normal(0.4, 0.1, 10)])
        assert found.low is not None
        assert found.high is not None
        covered += found.low <= 0.5 <= found.high
    assert 165 <= covered <= 198


def test_band_draws_within_strata():
    """Claim: seeds are drawn anew within each task: tasks that differ add nothing to the band, and
    none is left out."""
    found = statistics.band([np.full(5, 0.1), np.full(5, 0.9), np.full(5, 0.8), np.full(5, 0.8)])
    assert found == pytest.approx((0.65, 0.65, 0.65, 5))


def test_one_seed_has_no_band():
    """Claim: with one seed there is a value and no band, with none an error."""
    assert statistics.band([np.array([0.7])]) == (0.7, None, None, 1)
    with pytest.raises(ValueError, match="no values"):
        statistics.band([np.zeros(0)])


def test_runs_are_grouped_by_what_they_are(recorded: Path):
    """Claim: runs that differ in their seed alone are one curve, the IQM of both up to where the
    shorter ends."""
    found = comparison.build(results.read([recorded]))
    curves = {comparison.label(curve.variant, preset=False): curve for curve in found.curves}
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
    """Claim: evaluations of other lengths, and so of other scenes, stand beside each other and are
    not averaged."""
    _evaluation(
        recorded / "vpg" / "longer.json", _config("vpg", 0, sim__physics="c"), 9, episodes=40
    )
    scores = [
        one
        for one in comparison.build(results.read([recorded])).scores
        if one.variant.algo == "vpg"
    ]
    assert [(one.episodes, tuple(one.parts)) for one in scores] == [(10, CASES), (40, CASES)]
    assert [
        (case, one.episodes, len(one.parts[case]), one.only(case).band("completion").value)
        for case in CASES
        for one in scores
    ] == [(case, n, 1, value) for case in CASES for n, value in ((10, 0.5), (40, 0.9))]


def test_numbers_as_json(recorded: Path):
    """Claim: the JSON has every curve and score with its seeds, and where each number comes
    from."""
    content = json.loads(json.dumps(tables.as_json(comparison.build(results.read([recorded])))))
    beta = next(c for c in content["curves"] if c["algo"] == "csac_beta" and not c["changed"])
    assert (beta["seeds"], beta["seconds_to_90"]) == ([0, 1], [40.0, 30.0])
    scores = {(score["algo"], score["part"]): score for score in content["scores"]}
    assert set(scores) == {(algo, case) for algo in ("csac_beta", "vpg") for case in CASES}
    hole = scores["csac_beta", "hole"]
    assert (hole["physics"], hole["seed"], hole["seeds"]) == ("c", 5, [0, 1])
    assert hole["metrics"]["completion"] == pytest.approx(
        {"value": 0.9, "low": 0.8, "high": 1.0, "n": 2}
    )
    alone, wilson = scores["vpg", "row"]["metrics"]["completion"], metrics.wilson(5, 10)
    assert alone == pytest.approx(
        {"value": 0.5, "low": wilson["low"], "high": wilson["high"], "n": 1}
    )
    rows = {row["file"]: row for row in content["provenance"]}
    trained = rows["beta/seed-0/metrics.jsonl"]
    assert (trained["device"], trained["commit"], trained["wall time"]) == ("a card", "abc", "77 s")
    swept = rows["beta/seed-1/metrics.jsonl"]
    assert (swept["device"], swept["wall time"]) == ("two cards", "99 s, whole sweep")
    assert rows["vpg/metrics.jsonl"]["wall time"] == "40 s"  # no record: the log's last time
    assert (
        trained["settings as a command"]
        == "csac-jax train paper --algo csac_beta --seed 0 --sim.physics c"
    )
    assert rows["max/metrics.jsonl"]["settings as a command"].endswith(
        "--sim.physics c --target.value max"
    )


def test_provenance_has_what_an_evaluation_changes(tmp_path: Path):
    """Claim: the command of an evaluation in a run's folder names the gripper and the library that
    are not the run's; and it is the one that is named by its file, if the run changes much."""
    many = {"net__head": 16, "learn__batch": 4, "learn__tau": 0.5, "cem__rounds": 1}
    config = _config("csac_beta", 0, **many, learn__updates=9, target__gamma=0.1, train__actions=90)
    _run(tmp_path / "wide" / "seed-0", config, [0.5])
    config["sim"] = {**config["sim"], "gripper": "2f85"}
    _evaluation(tmp_path / "wide" / "seed-0" / "eval-2f85.json", config, 5)
    report = comparison.build(results.read([tmp_path]))
    commands = {row["file"]: row["settings as a command"] for row in tables.provenance(report)}
    assert commands["eval-2f85.json"].endswith(" --sim.gripper 2f85")
    assert {row["policy"] for row in tables.evaluation(report)} == {
        f"CSAC-beta ({config['preset']}), wide, eval-2f85"
    }
    assert report.curves[0].variant.source == "wide"


def test_evaluation_ends_with_the_mean_of_the_parts(recorded: Path):
    """Claim: after the parts of a suite a row has their mean, over all episodes."""
    rows = tables.evaluation(comparison.build(results.read([recorded])))
    beta = [row for row in rows if row["policy"] == "CSAC-beta (paper)"]
    assert [row["part"] for row in beta] == ["cases: hole", "cases: row", "cases: mean of 2 parts"]
    assert (beta[-1]["runs"], beta[-1]["episodes"]) == ("2", "40")
    assert beta[-1]["completion"].startswith("90.0 % (")


def test_differences_are_of_several_seeds_in_the_same_scenes(recorded: Path):
    """Claim: CSAC-beta is set against every other variant of which several seeds were measured in
    the same scenes, part by part and over all parts; what was measured once, or in other scenes, is
    not."""
    alone = comparison.build(results.read([recorded]))
    assert not list(comparison.pairs(alone))  # VPG has one seed
    for seed, lifted in ((1, 3), (2, 4)):
        config = _config("vpg", seed, sim__physics="c")
        _evaluation(recorded / "vpg" / f"more-{seed}.json", config, lifted)
        config = _config("csac_beta", seed, sim__physics="c", target__value="max")
        _evaluation(recorded / "max" / f"other-{seed}.json", config, lifted, episodes=20)
    whole = comparison.build(results.read([recorded]))
    found = list(comparison.pairs(whole))
    assert [(theirs.variant.algo, theirs.suite, tuple(theirs.parts)) for _, theirs in found] == [
        ("vpg", "cases", (case,)) for case in CASES
    ] + [("vpg", "cases", CASES)]
    for ours, theirs in found:
        bands = comparison.compared(ours, theirs, statistics.difference, results.METRICS)
        assert ours.variant.algo == "csac_beta"
        assert not ours.variant.changed
        assert tuple(ours.parts) == tuple(theirs.parts)
        band = bands["grasp_success"]
        assert band.value == pytest.approx(0.9 - 0.4)  # 10 and 8 of 10, and 5, 3 and 4
        assert band.low is not None
        assert band.high is not None
        assert 0.3 <= band.low < 0.5 < band.high <= 0.7
    rows = tables.differences(whole)
    assert [row["part"] for row in rows] == ["cases: hole", "cases: row", "cases: mean of 2 parts"]
    assert rows[0]["grasp success"].startswith("+50.0 (+")
    written = tables.as_json(whole)["differences"]
    assert [row["improvement"]["completion"]["value"] for row in written] == [1.0] * 3
    assert tables.improvements(whole)[0]["completion"] == "100.0 % (100.0 to 100.0)"


def test_training_is_compared_where_it_is_alike(tmp_path: Path):
    """Claim: how far CSAC-beta ends ahead is said of every variant of several seeds that was
    trained as long in the same scenes and task: not of another task, of other scenes, of a shorter
    run, nor of one seed."""
    others = {
        "base": {},
        "max": {"target__value": "max"},
        "clear": {"task__kind": "clear"},
        "packed": {"scene__arranged": 0.5},
    }
    for name, changed in others.items():
        for seed, last in enumerate((0.9, 0.8) if name == "base" else (0.5, 0.6)):
            _run(tmp_path / name / str(seed), _config("csac_beta", seed, **changed), [0.5, last])
    for seed in range(2):
        _run(tmp_path / "short" / str(seed), _config("csac_per", seed), [0.5])
    _run(tmp_path / "once", _config("vpg", 0), [0.5, 0.5])
    found = comparison.build(results.read([tmp_path]))
    ((variant, lead),) = comparison.leads(found).items()
    band = lead.final
    assert lead.improvement == (1.0, 1.0, 1.0, 2)
    assert lead.area.value == pytest.approx((0.675 - 0.525) / 3)  # of the last third
    assert (variant.algo, variant.changed) == ("csac_beta", (("target.value", "max"),))
    assert band.value == pytest.approx(0.85 - 0.55)
    assert band.low == pytest.approx(0.2)
    assert band.high == pytest.approx(0.4)
    assert sorted(row["CSAC-beta ahead by"] for row in tables.training(found)) == [
        "+30.0 (+20.0 to +40.0)",
        *["-"] * 5,
    ]
    assert sum(curve["ahead"] is not None for curve in tables.as_json(found)["curves"]) == 1


def test_repeats_of_a_seed_are_no_seeds(recorded: Path):
    """Claim: a run repeated on another host is no further seed: it counts in its seed's mean, and
    two hosts of one seed are neither set against others nor given a band."""
    _run(recorded / "again" / "seed-1", _config("csac_beta", 1), [0.7, 0.5])
    _run(recorded / "vpg-again", _config("vpg", 0), [0.2, 0.3, 0.5])
    for name in "ab":  # as long as the shorter of CSAC-beta's
        _run(recorded / f"per-{name}", _config("csac_per", 0), [0.2, 0.3])
    _evaluation(recorded / "again" / "eval.json", _config("csac_beta", 1, sim__physics="c"), 2)
    report = comparison.build(results.read([recorded]))
    curves = {curve.variant.algo: curve for curve in report.curves if not curve.variant.changed}
    final = curves["csac_beta"].final
    assert sorted(sorted(one.tolist()) for one in final) == [[0.5, 0.9], [0.95]]
    assert statistics.band([final]).value == pytest.approx((0.7 + 0.95) / 2)
    rows = {row["method"]: row for row in tables.training(report)}
    assert (rows["VPG (paper)"]["runs"], rows["VPG (paper)"]["final success"]) == ("2", "45.0 %")
    assert not comparison.leads(report)
    scores = {(one.variant.algo, one.seeds): one for one in report.scores}
    assert scores["csac_beta", 2].band("completion").value == pytest.approx((1.0 + 0.5) / 2)


def test_rates_of_training_stand_side_by_side(tmp_path: Path):
    """Claim: beside success the training table has blocks per action, lifts per grasp, actions and
    pushes per episode, over all of training; a dash where a run has not recorded them."""
    counts = {"pushes": 4, "grasps": 6, "outcomes": {"lifted": 3}, "cleared": 5}
    ends = {"terminated": 1, "truncated": 1}
    _run(tmp_path / "told", _config("vpg", 0), [0.5, 0.5])
    log = tmp_path / "told" / files.METRICS
    lines = [json.loads(line) for line in log.read_text().splitlines()[:-1]]
    told = [line | counts | (ends if i else dict.fromkeys(ends, 0)) for i, line in enumerate(lines)]
    log.write_text("".join(json.dumps(line) + "\n" for line in told))
    _run(tmp_path / "untold", _config("csac_per", 0), [0.5, 0.5])
    rows = tables.training(comparison.build(results.read([tmp_path])))
    cells = [[row[name] for name in tables.RATES] for row in rows]
    # 3 chunks of 10 actions: 15 blocks, 9 lifts of 18 grasps, 12 pushes, 4 episodes
    assert cells == [["0.500", "50.0 %", "7.50", "3.00"], ["-"] * 4]


def test_older_evaluations_tell_actions_and_pushes_by_their_counts(tmp_path: Path):
    """Claim: an evaluation that has no metrics per episode gets them of its counts, without an
    interval; one that has them keeps its own."""
    path, config = tmp_path / "eval.json", _config("vpg", 0)
    _evaluation(path, config, 5)
    content = json.loads(path.read_text())
    for part in content["parts"].values():
        part["counts"] |= {"pushes": 30, "grasps": 20}
        del part["pushes_per_episode"]
    path.write_text(json.dumps(content))
    row = tables.evaluation(comparison.build(results.read([path])))[0]
    assert row["pushes / episode"] == "3.00"
    assert row["actions / episode"].startswith("0.50 (")  # what `_evaluation` wrote


def test_profiles_are_drawn_of_several_seeds(recorded: Path):
    """Claim: performance profiles are drawn of two methods with several seeds each, as the share of
    the seeds above each value; of a single seed there is none."""
    name = "profiles-cases-paper"
    alone = comparison.build(results.read([recorded]))
    assert name not in {chart.name for chart in charts.draw(alone)}
    _evaluation(recorded / "vpg" / "more.json", _config("vpg", 1, sim__physics="c"), 3)
    report = comparison.build(results.read([recorded]))
    drawn = {chart.name: chart.figure for chart in charts.draw(report)}
    lines = drawn[name].axes[0].get_lines()
    shares = {line.get_label().split(" (")[0]: line.get_ydata() for line in lines}
    at = {name: [share[i] for i in (20, 40, 60, 90)] for name, share in shares.items()}
    assert at == {"VPG": [100, 50, 0, 0], "CSAC-beta": [100, 100, 100, 50]}  # 5, 3 and 10, 8 of 10


def test_labels():
    """Claim: settings that no result depends on name no variant; a label in a figure names as many
    as it is told to; one of more than six is named by its folder where none is told."""
    assert results.variant(_config("vpg", 0, train__chunk=7, train__save_every=3)).changed == ()
    changed = {"net__head": 16, "net__zoom": 1, "learn__batch": 4, "learn__tau": 0.5}
    variant = results.variant(_config("vpg", 0, **changed))
    assert set(comparison.label(variant).split(", ")[1:]) == {
        "net.head 16",
        "net.zoom 1",
        "learn.batch 4",
        "learn.tau 0.5",
    }
    many = changed | {"cem__rounds": 1, "learn__updates": 9, "target__gamma": 0.1}
    variant_of_many = results.variant(_config("vpg", 0, **many))
    assert comparison.label(variant_of_many).count(", ") == 7
    own = dataclasses.replace(variant_of_many, source="own")
    assert comparison.label(own) == f"VPG ({variant.preset}), own"
    assert comparison.label(dataclasses.replace(variant, source="own")).count(", ") == 4
    short = comparison.label(variant, preset=False, most=3)
    assert (short.count(", "), short[-12:]) == (4, ", others (1)")
    assert comparison.label(variant, preset=False, most=4) == comparison.label(
        variant, preset=False
    )


def test_old_names_are_read_as_todays(tmp_path: Path):
    """Claim: logs, evaluations and configs with the names of before say what they would say now."""
    config = _config("csac_beta", 0, reward__lost_block_penalty=0.5)
    old = json.loads(json.dumps(config))
    old["target"]["samples"] = 8  # a setting that is gone
    assert results.variant(old) == results.variant(config)
    assert results.variant(old).changed == (("reward.lost_block_penalty", "0.5"),)
    share = metrics.wilson(1, 10)
    part = {"completion": share, "failures": {"block_left": share, "episode_ill": share}}
    content = {"policy": "learned", "suite": "own", "parts": {"own": part}, "config": old}
    (tmp_path / "eval.json").write_text(json.dumps(content))
    _run(tmp_path / "run", old, [0.5])
    log = tmp_path / "run" / "metrics.jsonl"
    line = {"step": 1, "actions": 8, "grasps_counted": 0, "seconds": 1.0}
    log.write_text(json.dumps({**line, "ill": 1, "left": 2, "saturated": 3}) + "\n")
    new = {"physics_diverged": 1, "blocks_lost": 2, "contact_overflow": 3}
    assert files.read_log(log) == [{**line, **new}]
    one = results.read([tmp_path / "eval.json"]).evaluations[0]
    assert (one.suite, one.part) == ("in_distribution", "in_distribution")
    assert set(one.metrics["failures"]) == {"block_lost", "episode_physics_diverged"}


def test_robots_of_training_are_told_apart(tmp_path: Path):
    """Claim: runs with another robot are another variant, and so are their evaluations; what is
    evaluated with another robot than it was trained with stays of its run's variant."""
    for robot in ("hand", "ur5"):
        config = _config("csac_beta", 0, sim__robot=robot)
        _run(tmp_path / robot, config, [0.5])
        for other in ("hand", "ur5"):
            seen = _config("csac_beta", 0, sim__robot=other)
            _evaluation(tmp_path / robot / f"eval-{other}.json", seen, 5)
    found = results.read([tmp_path])
    trained = {run.path.parent.name: run.variant for run in found.runs}
    assert (trained["hand"].changed, trained["ur5"].changed) == ((), (("sim.robot", "ur5"),))
    assert all(one.variant == trained[one.path.parent.name] for one in found.evaluations)
    (run,) = (run for run in found.runs if run.path.parent.name == "ur5")
    assert results.command(run).count("--sim.robot ur5") == 1


def test_command_gives_the_config_back():
    """Claim: the command in the provenance, parsed, is the run's config."""
    changed = {
        "learn__augment": False,
        "policy__place": "argmax",
        "reward__grasp_levels": [-1.5, -1.5, -1.5, -1.0, 1.0],
        "train__actions": 900,
        "net__head": 16,
    }
    config = _config("csac_per", 7, **changed)
    variant = results.variant(config)
    run = results.RecordedRun(Path("x"), config, variant, *[np.zeros(1)] * 4, record={}, totals={})
    program, command, *flags = results.command(run).split()
    assert (program, command) == ("csac-jax", "train")
    assert configs.to_dict(train.read(flags)[1]) == config


def test_command_of_an_evaluation_gives_its_view_back():
    """Claim: an evaluation's command has the settings of its camera that are not the policy's, and
    no others."""
    noisy = _config("csac_beta", 0, heightmap__view="oblique", sensor__kind="d415")
    lens = {"size": [320, 240], "focal": [309.0, 309.5], "centre": [159.5, 119.5]}
    seen = _config("csac_beta", 0, **{f"camera__{name}": value for name, value in lens.items()})
    given = (Path("x"), seen, results.variant(seen), "learned", "random10", "random10", 3)
    one = results.Evaluation(*given, {"counts": {"episodes": 5}}, {})
    program, command, run, *flags = results.command(one, noisy).split()
    assert (program, command, run) == ("csac-jax", "eval", "RUN")
    asked, view = settings.parse_view(EvalOptions, "eval", ["RUN", *flags])
    assert (asked.episodes, asked.seed, asked.suite) == (5, 3, "random10")
    assert configs.to_dict(configs.from_dict(noisy).change(**view)) == seen
    assert "--camera" not in results.command(one, seen)


def test_command_of_an_evaluation_says_how_it_decides():
    """Claim: an evaluation's command has `--augment`, `--height-bonus` and `--retry` where the
    policy's config is another, also one from before those settings."""
    on, off = (_config("csac_beta", 0, policy__augment=one) for one in (True, False))
    high = _config("csac_beta", 0, policy__height_bonus=3.0)
    bold = _config("csac_beta", 0, policy__retry=0.1)
    before = {**off, "policy": {"place": "cem"}}

    def command(seen: Any, trained: Any) -> list[str]:
        given = (Path("x"), seen, results.variant(seen), "learned", "random10", "random10", 3)
        one = results.Evaluation(*given, {"counts": {"episodes": 5}}, {})
        return results.command(one, trained).split()

    for seen, trained, expected in ((on, off, "on"), (on, before, "on"), (off, on, "off")):
        _, _, *flags = command(seen, trained)
        assert settings.parse_view(EvalOptions, "eval", flags)[0].augment == expected
    for seen, trained, expected in ((high, off, 3.0), (high, before, 3.0), (off, high, 0.0)):
        _, _, *flags = command(seen, trained)
        asked, _ = settings.parse_view(EvalOptions, "eval", flags)
        assert (asked.height_bonus, asked.augment, asked.retry) == (expected, None, None)
    for seen, trained, expected in ((bold, off, 0.1), (bold, before, 0.1), (off, bold, 0.0)):
        _, _, *flags = command(seen, trained)
        asked, _ = settings.parse_view(EvalOptions, "eval", flags)
        assert (asked.height_bonus, asked.augment, asked.retry) == (None, None, expected)
    for seen, trained in ((on, on), (off, before), (before, off), (high, high), (bold, bold)):
        assert not {"--augment", "--height-bonus", "--retry"} & set(command(seen, trained))


def test_command_of_an_evaluation_names_its_objects():
    """Claim: an evaluation's command has the library that is not the policy's, and its split."""
    scene = {"scene__slots": ["object"], "scene__min_blocks": 1, "scene__split": "all"}
    trained = _config("csac_beta", 0, **scene, scene__objects="made:1:9")
    seen = _config("csac_beta", 0, **scene, scene__objects="made:2:9")
    given = (Path("x"), seen, results.variant(seen), "learned", "pile", "pile", 3)
    one = results.Evaluation(*given, {"counts": {"episodes": 5}}, {})
    assert results.command(one, trained).endswith(" --objects made:2:9 --split all")
    assert results.command(one, seen).endswith(" --split all")
    seen["scene"]["split"] = "held_out"
    assert results.command(one, trained).endswith(" --objects made:2:9")
    assert "--split" not in results.command(one, seen)


def test_what_is_missing_is_said(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture):
    """Claim: an empty folder, runs of different lengths, one of a kind, one not evaluated: one line
    each."""
    (tmp_path / "empty").mkdir()
    (tmp_path / "bare").mkdir()
    line = {"step": 1, "actions": 8, "grasps_counted": 1, "seconds": 1.0, "grasp_success": 1.0}
    (tmp_path / "bare" / "metrics.jsonl").write_text(json.dumps(line) + "\n")
    assert cli.main(["report", str(recorded), str(tmp_path / "empty"), str(tmp_path / "bare")]) == 0
    notes = [line for line in capsys.readouterr().out.splitlines() if line.startswith("- ")]
    wanted = (
        "empty: holds no metrics.jsonl",
        "bare/metrics.jsonl: no readable config",
        "bare: holds no metrics.jsonl",
        "max: not evaluated; run: csac-jax eval",
        "CSAC-beta (paper): runs end at 300, 400 actions; their curve is drawn up to 300",
        "VPG (paper): one run only",
        "CSAC-beta (paper), target.value max: one run only",
    )
    assert len(notes) == len(wanted)
    for text in wanted:
        assert sum(text in note for note in notes) == 1, text


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        ([], 2, "at least one folder"),
        (["nowhere"], 2, "no file or folder nowhere"),
        (["."], 1, "holds no metrics.jsonl"),
    ],
)
def test_nothing_to_report(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
    arguments: list,
    code: int,
    said: str,
):
    """Claim: without anything to report there is one line that says so, and an exit code."""
    monkeypatch.chdir(tmp_path)
    assert cli.main(["report", *arguments]) == code
    complaint = capsys.readouterr().err
    assert said in complaint
    assert complaint.count("\n") == 1


def test_figures(recorded: Path):
    """Claim: figure 6 has a line per method and the paper's marks at 2,500 actions, figure 9 a mark
    per case."""
    found = comparison.build(results.read([recorded]))
    drawn = {chart.name: chart.figure for chart in charts.draw(found)}
    assert set(drawn) == {"methods-paper", "variants-paper", "four-cases-cases-paper"}
    lines = drawn["methods-paper"].axes[0].get_lines()
    marks = [
        line.get_xydata()[0]
        for line in lines
        if line.get_marker() == "D" and len(line.get_xydata())
    ]
    np.testing.assert_allclose(sorted(mark.tolist() for mark in marks), [[2500, 75], [2500, 90]])
    drawn_curves = {
        line.get_label(): line.get_ydata().tolist() for line in lines if line.get_marker() != "D"
    }
    assert drawn_curves["CSAC-beta (2)"] == pytest.approx([60, 85])
    assert drawn_curves["VPG (1)"] == pytest.approx([20, 30, 40])
    completion = drawn["four-cases-cases-paper"].axes[0]
    assert sorted(y for _, y in _marks(completion)) == pytest.approx(
        [50] * 3 + [90] * 3
    )  # two cases and their mean, two methods
    ticks = [text.get_text() for text in completion.get_xticklabels()]
    assert ticks == [*CASES, "mean"]


def _marks(panel: Axes) -> list[list[float]]:
    """The places of the marks that are seen."""
    lines = [line.get_xydata() for line in panel.get_lines() if line.get_marker() in charts.MARKERS]
    return [mark for mark in np.concatenate(lines).tolist() if np.isfinite(mark).all()]


def test_cases_of_each_preset_and_task(recorded: Path):
    """Claim: figure 9 is drawn of each preset by itself, with the paper's two means, in the target
    task without."""
    other = _config("csac_beta", 0) | {"preset": "fast"}
    _evaluation(recorded / "fast.json", other, 7)
    _evaluation(recorded / "target.json", other, 3, suite="target")
    drawn = {
        chart.name: chart.figure
        for chart in charts.draw(comparison.build(results.read([recorded])))
    }
    for name, marks, lines in (("cases-paper", 6, 2), ("cases-fast", 3, 2), ("target-fast", 3, 0)):
        shown = drawn[f"four-cases-{name}"].axes[0].get_lines()
        assert len(_marks(drawn[f"four-cases-{name}"].axes[0])) == marks
        assert sum(line.get_linestyle() == "--" for line in shown) == lines


def test_samplers_are_drawn_where_there_are_several(recorded: Path):
    """Claim: figure 7 is drawn of two samplers, not of one that was trained for two lengths."""
    _run(recorded / "long", _config("csac_beta", 0, train__actions=5000), [0.5])
    assert "samplers-paper" not in {
        chart.name for chart in charts.draw(comparison.build(results.read([recorded])))
    }
    _run(recorded / "per", _config("csac_per", 0), [0.5])
    assert "samplers-paper" in {
        chart.name for chart in charts.draw(comparison.build(results.read([recorded])))
    }


def _colours(panel: Axes) -> list[str]:
    """The colours of the curves."""
    return [line.get_color() for line in panel.get_lines() if line.get_marker() != "D"]


def test_panels_have_few_curves(recorded: Path):
    """Claim: a panel has at most six curves of different colours; of more, the variant of most
    runs is in every panel, and each other in one."""
    found = comparison.build(results.read([recorded])).curves
    most, other = sorted(found, key=lambda curve: -len(curve.runs))[:2]
    alone = curves.success([most, *[other] * (curves.MOST - 1)], paper=False).axes
    assert len(alone) == 1
    panels = curves.success([other] * 6 + [most] + [other] * 6, paper=True).axes
    counts = [len(_colours(panel)) for panel in panels]
    assert counts == [6, 6, 3]
    for panel in panels:
        colours = _colours(panel)
        assert colours[0] == curves.REFERENCE
        assert len(set(colours)) == len(colours)
        assert f"({len(most.runs)})" in panel.get_lines()[0].get_label()


def test_axes_lie_where_the_data_are(recorded: Path):
    """Claim: the axis of success begins a little below the lowest value, and shows all marks."""
    report = comparison.build(results.read([recorded]))
    drawn = {chart.name: chart.figure for chart in charts.draw(report)}
    panel = drawn["methods-paper"].axes[0]
    values = [line.get_ydata() for line in panel.get_lines() if len(line.get_ydata())]
    lowest = np.concatenate(values).min()
    assert lowest - 12 <= panel.get_ylim()[0] <= lowest - 1
    panel.figure.draw_without_rendering()  # no legend hides a curve or a mark
    assert panel.get_legend().get_window_extent().x0 > panel.get_window_extent().x1


def test_figures_of_values_that_are_not_there():
    """Claim: an axis has a beginning where no value is there."""
    nothing = np.full(3, np.nan)
    assert (curves.lowest(nothing), curves.lowest([*nothing, 42.0])) == (100.0, 42.0)
    assert (curves.floor(100.0), curves.floor(42.0), curves.floor(0.5)) == (90.0, 40.0, 0.0)


def test_what_all_share_is_said_once(recorded: Path):
    """Claim: a change that all variants of a figure make stands above it and in no legend."""
    for algo in ("vpg", "csac"):
        _run(recorded / f"tau-{algo}", _config(algo, 0, learn__tau=0.5), [0.5, 0.6])
    found = comparison.build(results.read([recorded])).curves
    chosen = [curve for curve in found if ("learn.tau", "0.5") in curve.variant.changed]
    figure = curves.success(chosen, paper=False)
    assert figure.get_suptitle() == "all with learn.tau 0.5"
    names = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert len(names) == 2
    assert not [name for name in names if "tau" in name]


def _drawn(page: str) -> list[Any]:
    """The figures that a page gives to plotly."""
    return json.loads(re.search(r"^const figures = (.*);$", page, re.MULTILINE)[1])


def test_page_needs_nothing_else(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture):
    """Claim: `report --out` writes one page with its curves inside, and the tables as text;
    `--json` the numbers."""
    out, numbers = tmp_path / "out", tmp_path / "report.json"
    assert cli.main(["report", str(recorded), "--out", str(out), "--json", str(numbers)]) == 0
    assert {path.name for path in out.iterdir()} == {"index.html", "results.md"}
    html = (out / "index.html").read_text()
    own = html.split("<script>")[0] + html.split("</script>")[-1]
    assert not re.findall('(?:src|href)="(?!#|data:)', own)
    assert html.index("<h2>Summary</h2>") < html.index('id="curves"') < html.index('id="tables"')
    shown = capsys.readouterr().out
    assert (out / "results.md").read_text() in shown
    assert "grasp dropped" in shown
    assert "2 / 20" in shown  # of CSAC-beta: 0 and 2 of 10 grasps in each case
    assert len(json.loads(numbers.read_text())["curves"]) == 3


def test_curves_of_the_page_are_the_reports(recorded: Path):
    """Claim: the page draws each curve and each part's values, by the numbers of `--json`."""
    for path in recorded.rglob("*.json"):
        content = json.loads(path.read_text())
        for one in content.get("parts", {}).values():
            one["completion"] = metrics.wilson(9, 20)  # another than grasp success
        path.write_text(json.dumps(content))
    report = comparison.build(results.read([recorded]))
    figures, numbers = _drawn(page.render(report, [])), tables.as_json(report)
    lines = [trace for _, data, _ in figures for trace in data if trace.get("mode") == "lines"]
    named = [trace for trace in lines if "name" in trace]
    assert len(named) == len(numbers["curves"])
    for curve in numbers["curves"]:
        wanted = [100 * band["value"] for band in curve["success"]]
        found = [one for one in named if one["x"] == curve["actions"]]
        assert any(np.allclose(one["y"], wanted, atol=1e-3) for one in found)
    marks = [trace for _, data, _ in figures for trace in data if "error_y" in trace]
    done = [score["metrics"]["completion"] for score in numbers["scores"]]
    values = sorted(value for trace in marks if trace["visible"] for value in trace["y"])
    assert np.allclose(values, sorted(100 * band["value"] for band in done if band), atol=1e-3)


_VPG = results.Variant("paper", "vpg", ())


def test_best_is_bold_among_the_alike():
    """Claim: bold is the largest value of a column among learned methods of one preset in the same
    scenes; a value that nothing is compared with is not, nor is one that is not there."""
    names = ("ours", "theirs", "theirs", "ours", "oracle", "ours", "ours", "theirs")
    parts = ("row", "row", "hole", "hole", "row", "tower", "bin", "bin")
    values = ("90.0 % (1 to 2)", "80.0 %", "60.0 %", "50.0 %", "99.0 %", "70.0 %", "-", "40.0 %")
    table = [
        {"policy": name, "part": part, "runs": "3", "completion": value}
        for name, part, value in zip(names, parts, values, strict=True)
    ]
    named = {"ours": results.Variant("paper", "csac", ()), "theirs": _VPG}
    assert page._best(table, named) == {(0, "completion"), (2, "completion")}
    table[1]["policy"] = "another preset's"
    named["another preset's"] = results.Variant("quick", "vpg", ())
    assert page._best(table, named) == {(2, "completion")}


def test_rows_are_grouped_by_method_and_settings_are_words(recorded: Path):
    """Claim: rows of one method stand together, settings are words, and the pointer shows flags."""
    report = comparison.build(results.read([recorded]))
    table = tables.tables(report)["Training"]
    for rows in (table, table[::-1], table[1:] + table[:1]):
        groups = [row.group for row in page._table(report, "Training", rows).rows]
        assert groups == sorted(groups, key=list(comparison.NAMES.values()).index)
    assert len(set(groups)) > 1
    variant = results.Variant("paper", "vpg", (("learn.tau", "0.5"), ("learn.augment", "False")))
    assert wording.name_of(variant) == "VPG, target update share 0.5, augment off"
    cell = page._cell({"x": variant}, "x", False)
    assert cell.title == "paper --algo vpg --learn.tau 0.5 --learn.augment False"


def test_pictures_of_the_folders_are_in_the_page(recorded: Path):
    """Claim: a picture or video in a run's folder is in the page; one in its checkpoints, or of
    another kind, is not."""
    (recorded / "max/checkpoints").mkdir(exist_ok=True)
    for name in ("max/episode.webp", "max/checkpoints/no.png", "max/no.txt"):
        (recorded / name).write_bytes(b"picture")
    (one,) = page.media([recorded])
    assert (one.kind, one.name) == ("image", str(recorded / "max/episode.webp"))
    assert one.data == "data:image/webp;base64," + base64.b64encode(b"picture").decode()
    assert one.data in page.render(comparison.build(results.read([recorded])), [recorded])


WATCH = """<script>
const faults = [];
addEventListener("error", (event) => faults.push(event.message));
const told = console.error;
console.error = (...all) => { faults.push(all.join(" ")); told(...all); };
addEventListener("load", () => setTimeout(() => {
  const table = [...document.querySelectorAll("h2")].find((one) => one.textContent === "Training")
    .nextElementSibling.querySelector("table");
  const heads = [...table.tHead.rows[0].cells].map((head) => head.textContent);
  const at = heads.indexOf("final success"), rows = table.tBodies[0].rows;
  const column = () => [...rows].map((row) => row.cells[at].textContent);
  const click = () => table.tHead.rows[0].cells[at].firstChild.click();
  const seen = [column()];
  click(); seen.push(column()); click(); seen.push(column());
  const traces = (plot) => plot.querySelectorAll(".scatterlayer .trace").length;
  const drawn = [...document.querySelectorAll(".plot")].map(traces);
  const dark = getComputedStyle(document.body).backgroundColor;
  document.body.innerHTML = "<pre id=found></pre>";
  document.getElementById("found").textContent = JSON.stringify({ faults, seen, drawn, dark });
}, 500));
</script>"""


def test_page_works_in_a_browser(recorded: Path, tmp_path: Path):
    """Claim: in Chromium the page draws its curves and sorts its tables by a click, down and up,
    without an error; it is dark where the reader's system is."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        pytest.skip("no chromium here")
    report = comparison.build(results.read([recorded]))
    html, found = page.render(report, []), []
    (tmp_path / "page.html").write_text(html.replace("<title>", WATCH + "<title>", 1))
    off = ("gpu", "quic", "background-networking", "component-update", "sync")
    flags = ["--headless", "--no-sandbox", "--no-first-run", *(f"--disable-{one}" for one in off)]
    for scheme in (1, 0):  # light, dark
        own = [f"--user-data-dir={tmp_path / f'profile{scheme}'}", "--virtual-time-budget=20000"]
        own += [f"--blink-settings=preferredColorScheme={scheme}", "--dump-dom"]
        command = [chromium, *flags, *own, (tmp_path / "page.html").as_uri()]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
        text = re.search('<pre id="found">(.*?)</pre>', done.stdout)
        assert text is not None, done.stdout[-500:] + done.stderr
        found.append(json.loads(text[1]))
    light, dark = found
    assert light["faults"] == dark["faults"] == []
    assert light["drawn"] == [
        sum(one.get("visible", True) is True for one in data) for _, data, _ in _drawn(html)
    ]
    first, down, up = ([float(text.split()[0]) for text in rows] for rows in light["seen"])
    assert len(set(first)) > 1
    assert down == sorted(first, reverse=True)
    assert up == sorted(first)
    assert (light["dark"], dark["dark"]) == ("rgb(255, 255, 255)", "rgb(13, 17, 23)")


def test_reads_without_jax(recorded: Path):
    """Claim: a report needs no JAX and no MuJoCo."""
    code = (
        "import sys; from csac_jax import cli; code = cli.main(['report', sys.argv[1]]); "
        "sys.exit(code or 3 * bool({'jax', 'mujoco'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(recorded)], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr


def test_damaged_lines_are_counted(recorded: Path, capsys: pytest.CaptureFixture):
    """Claim: a log with damaged lines is used without them, and a note counts them."""
    log = recorded / "max" / "metrics.jsonl"
    lines = log.read_bytes().splitlines()
    log.write_bytes(b"\n".join([b"\xff\xfe", b"[]", b'{"step": "x"}', *lines]))
    assert cli.main(["report", str(recorded)]) == 0
    shown, complaint = capsys.readouterr()
    notes = [line for line in shown.splitlines() if "max/metrics.jsonl: 3 of" in line]
    assert len(notes) == 1
    assert "lines are damaged and left out" in notes[0]
    assert complaint == ""


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("eval.json", "{"),
        ("eval.json", "[" * 100_000),
        ("eval.json", '{"policy": [], "config": {}, "parts": {}}'),
        ("eval.json", '{"policy": "learned", "config": {"seed": "x"}, "parts": {"a": {}}}'),
        ("eval.json", '{"policy": "learned", "config": {}, "parts": {"a": {"completion": 3}}}'),
        ("train.json", '{"versions": 3}'),
        ("config.json", '{"preset": ["paper"]}'),
    ],
)
def test_damaged_record_is_left_out_with_a_note(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture, name: str, content: str
):
    """Claim: a record with damage of any kind is left out with a note, and the others are shown."""
    bad = tmp_path / "bad"
    _run(bad, _config("csac_beta", 9), [0.5])
    (bad / name).write_text(content)
    assert cli.main(["report", str(recorded), str(bad)]) == 0
    shown, complaint = capsys.readouterr()
    assert any(line.startswith(f"- {bad}") and "damaged" in line for line in shown.splitlines())
    assert "| CSAC-beta" in shown
    assert complaint == ""


def test_archive_is_read_as_its_folder(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture
):
    """Claim: an archive of runs gives the tables of the folder; what it would write elsewhere, and
    links, are passed over; one that is cut off is one line and exit code 2."""
    (recorded / "max" / "checkpoints").rmdir()  # of networks, which no archive holds
    path = tmp_path / "runs.tar.xz"
    with tarfile.open(path, "w:xz") as archive:
        archive.add(recorded, "sweep")
        archive.add(recorded / "vpg" / "metrics.jsonl", "../outside.jsonl")
        link = tarfile.TarInfo("link.json")
        link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
        archive.addfile(link)
    assert cli.main(["report", str(recorded)]) == 0
    wanted = capsys.readouterr().out
    assert cli.main(["report", str(path)]) == 0
    assert capsys.readouterr().out == wanted
    assert not list(tmp_path.rglob("outside.jsonl"))
    path.write_bytes(path.read_bytes()[:-400])
    assert cli.main(["report", str(path)]) == 2
    assert "is no archive of runs" in capsys.readouterr().err


def test_pipes_and_devices_are_not_read(tmp_path: Path, capsys: pytest.CaptureFixture):
    """Claim: a named pipe or a device, which never ends, is passed over at once."""
    for name in ("metrics.jsonl", "eval.json", "config.json"):
        os.mkfifo(tmp_path / name)
    (tmp_path / "zero.json").symlink_to("/dev/zero")
    begun = time.monotonic()
    for path in (tmp_path, tmp_path / "eval.json", Path("/dev/zero")):
        assert cli.main(["report", str(path)]) == 1
        assert capsys.readouterr().err.count("\n") == 1
    assert time.monotonic() - begun < 10.0
