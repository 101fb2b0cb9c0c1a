"""`csac-jax scenes certify`: files that can be trusted, stops that lose nothing."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from csac_jax import cli
from csac_jax.cli import scenes
from csac_jax.errors import SettingsError
from csac_jax.scenes import certify
from csac_jax.scenes.certify import Certificate

COMMAND = ["scenes", "certify", "bars", "--count", "6", "--jobs", "1", "--out"]


@pytest.fixture
def judged(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Seeds that are judged, in place of judging: every third is refused. The fifth is stopped."""
    seeds: list[int] = []

    def judge(_: Any, cfgs: Any, generator: str, seed: int, scene: Any) -> tuple[Any, Any]:
        seeds.append(seed)
        if len(seeds) == 5:
            raise KeyboardInterrupt
        refused = seed % 3 == 2
        certificate = Certificate(generator, seed, 0.001 * seed, 0.25, -1 if refused else 7 + seed)
        return certificate, None if refused else scene

    monkeypatch.setattr(scenes, "_judge", judge)
    return seeds


def test_resume_is_one_go(tmp_path: Path, judged: list[int], capsys: pytest.CaptureFixture):
    """Claim: a search that was stopped goes on where it was; the file has the bytes of one go."""
    stopped, whole = tmp_path / "stopped.npz", tmp_path / "whole.npz"
    assert cli.main([*COMMAND, str(stopped)]) == 130
    assert len(certify.load(stopped).kept) == 3
    assert cli.main([*COMMAND, str(stopped)]) == 0
    assert judged == [0, 1, 2, 3, 4, 4, 5]
    assert cli.main([*COMMAND, str(whole)]) == 0
    assert stopped.read_bytes() == whole.read_bytes()
    assert f"{whole}: 4 scenes, 2 candidates refused" in capsys.readouterr().out
    loaded = certify.load(whole)
    assert [one.seed for one in loaded.kept] == [0, 1, 3, 4]
    assert loaded.scenes.position.shape[:2] == (4, len(loaded.scenes.in_play[0]))
    assert len({leaf.tobytes() for leaf in loaded.scenes.half_size}) == 4


@pytest.mark.parametrize("name", ["scene.position", "scene.target", "after", "push", "settings"])
def test_changed_byte_is_refused(tmp_path: Path, judged: list[int], name: str):
    """Claim: a scene, a certificate or settings of which one byte was changed are refused, in one
    line that names file and scene."""
    path = tmp_path / "some.npz"
    judged += [0] * 9
    assert cli.main([*COMMAND, str(path)]) == 0
    with np.load(path) as file:
        arrays = dict(file)
    changed = arrays[name].reshape(-1).view(np.uint8)
    changed[-4 if name == "settings" else 0] ^= 1
    np.savez(path, **arrays)
    with pytest.raises(SettingsError, match=r"some\.npz: scene bars 0: .*digest") as error:
        certify.load(path)
    assert "\n" not in str(error.value)


def test_damaged_file_is_refused(tmp_path: Path, judged: list[int], capsys: pytest.CaptureFixture):
    """Claim: a file that is cut off, or of other settings, is refused in one line, and kept."""
    path = tmp_path / "some.npz"
    judged += [0] * 9
    assert cli.main([*COMMAND, str(path)]) == 0
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    assert cli.main([*COMMAND, str(path)]) == 2
    assert f"{path}: is no sound file of certified scenes" in capsys.readouterr().err
    other = certify.CertifiedScenes("other", {})
    path.write_bytes(certify.encode(other))
    assert cli.main([*COMMAND, str(path)]) == 2
    assert "--out: " in capsys.readouterr().err
    assert certify.load(path) == other


def test_case_files_are_candidates(tmp_path: Path, judged: list[int]):
    """Claim: the case files of a folder are candidates of one suite, with slots for all."""
    cube = {"shape": "cube", "colour": "red", "quaternion": [1, 0, 0, 0]}
    for name, number in (("one", 1), ("two", 2)):
        blocks = [{**cube, "position": [0.06 * i, 0, 0.025]} for i in range(number)]
        content = {"name": name, "blocks": blocks}
        (tmp_path / f"{name}.json").write_text(json.dumps(content))
    out = tmp_path / "cases.npz"
    assert cli.main(["scenes", "certify", str(tmp_path), "--jobs", "1", "--out", str(out)]) == 0
    loaded = certify.load(out)
    assert [one.generator for one in loaded.kept] == ["one", "two"]
    assert loaded.scenes.in_play.tolist() == [[True, False], [True, True]]
