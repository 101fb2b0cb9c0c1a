"""The first command of a new user."""

from pathlib import Path

import imageio.v3 as imageio
import pytest

from csac_jax import cli
from csac_jax.cli import play
from csac_jax.evaluation.policies import PlannerPolicy


def test_demo_is_an_episode_of_play(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    """Claim: `demo` is one command of `play`, which it prints, with a shipped policy whose actions
    physics chooses among; it says where the video is. --out names another file, of a known kind."""
    played = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(play, "run", lambda arguments: played.append(arguments) or 0)
    assert cli.main(["demo"]) == cli.main(["demo", "--out", "new/a.gif"]) == 0
    first, second = capsys.readouterr().out.split("csac-jax play --scene")[1:]
    assert f"wrote {tmp_path / 'demo.webp'}" in first
    assert f"wrote {tmp_path / 'new/a.gif'}" in second
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    options = [play.settings.parse_view(play.PlayOptions, "play", words)[0] for words in played]
    assert [str(one.video) for one in options] == ["demo.webp", "new/a.gif"]
    assert cli.main(["demo", "--out", "demo.txt"]) == 2
    policy = play._policy(options[0])
    assert isinstance(policy, PlannerPolicy)
    assert policy.proposer.cfg == play._policy(play.PlayOptions(policy="shipped")).cfg


@pytest.mark.slow
@pytest.mark.mjx
def test_demo_pushes_and_clears(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    """Claim: the arm of `demo` begins with a push and clears the table, in a film."""
    monkeypatch.chdir(tmp_path)
    assert cli.main(["demo"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].startswith("  1 push")
    assert any(line.startswith("the table is clear") for line in lines)
    assert len(imageio.imread("demo.webp")) > 100
