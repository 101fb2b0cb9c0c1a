"""Parts of one's own: their names, and what is refused."""

import dataclasses
import subprocess
import sys
from pathlib import Path
from typing import Any

import flax.linen as nn
import jax
import numpy as np
import pytest

import csac_jax as csac
from csac_jax import presets
from csac_jax.errors import DataWarning, SettingsError
from csac_jax.training import own_parts
from csac_jax.training.own_parts import OwnParts


@dataclasses.dataclass(frozen=True)
class Mine(csac.Sampler):
    """Uniform draws."""

    share: float = 0.2
    table: Any = None

    def sample(self, key: Any, state: Any, progress: Any, num: int) -> Any: ...


def _same(x: float) -> float:
    return x


def _other(x: float) -> float:
    return -x


class Child(Mine):
    """A sampler whose parent is one of its own."""


class Net(nn.Module):
    """A network by its attributes alone."""

    width: int = 4
    stride: int = 2


SOURCE = """import dataclasses
import csac_jax as csac
class Base(csac.Sampler):
    def sample(self, key, state, progress, num): return {value}
class Own(Base):
    other = lambda self: 1
"""
NAME = "import own; from csac_jax.training import own_parts; print(own_parts.name(own.Own()))"


def _named(folder: Path, value: int) -> str:
    (folder / "own.py").write_text(SOURCE.format(value=value))
    command = [sys.executable, "-B", "-c", NAME]
    return subprocess.check_output(command, text=True, cwd=folder).strip()


def test_name_follows_the_source(tmp_path: Path):
    """Claim: a part's name has module, class and a digest of its source, that of its own parents
    too, the same in every process."""
    one, again, other = (_named(tmp_path, value) for value in (1, 1, 2))
    assert one == again != other
    assert one.partition("@")[0] == other.partition("@")[0] == "own.Own "


def test_name_has_what_a_part_was_made_with():
    """Claim: parts of one class with other numbers, or other arrays, have other names; plain
    numbers are shown."""
    one, two = own_parts.name(Mine()), own_parts.name(Mine(share=0.5))
    assert one.startswith(f"{__name__}.Mine(share=0.2) @")
    assert two.startswith(f"{__name__}.Mine(share=0.5) @")
    tables = [own_parts.name(Mine(table=np.full(3, value))) for value in (0, 0, 1)]
    assert len({one, two, *tables}) == 4
    held = [{"a": 1}, {"a": 2}, {"b": 1}, (1, [2]), (1, [3]), Mine(), Mine(0.5), jax.random.key(0)]
    held += [_same, _other, np.float32(1.0), np.float32(2.0), object(), None]
    names = [own_parts.name(Mine(table=value)) for value in held]
    assert len(set(names)) == len(held)
    assert names == [own_parts.name(Mine(table=value)) for value in held]
    assert own_parts.name(Child()).partition("@")[2] != one.partition("@")[2]
    assert own_parts.name(Net()).startswith(f"{__name__}.Net(width=4, stride=2) @")
    assert OwnParts(Mine(), Net()).names() == f"sampler {one}; network {own_parts.name(Net())}"
    assert OwnParts().names() == ""


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"sampler": object()}, "sampler: object lacks init, sample, update; derive it from csac"),
        ({"sampler": Mine}, r"sampler: Mine is a class; give Mine\(\)"),
        ({"network": nn.Dense(3)}, "network: Dense lacks stride; derive it from flax.linen.Module"),
        ({"learner": Mine()}, "learner: Mine lacks act, reward; derive it from csac_jax.Learner"),
        ({"network": Net(), "init": "shipped"}, "init: has the config's own networks"),
    ],
)
@pytest.mark.parametrize("call", [csac.train, csac.sweep])
def test_what_is_no_part_is_refused(
    call: Any, given: dict[str, Any], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Claim: what is no part, a class in place of an instance, and `init` with a network of one's
    own are one line, before there is a folder."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SettingsError, match=f"^{message}"):
        call(presets.smoke(), run_dir="run", verbose=False, **given)
    assert not list(tmp_path.iterdir())


def test_settings_that_a_part_does_not_read_cannot_be_varied():
    """Claim: a sweep of settings that a part of one's own takes the place of is refused."""
    own_parts.check_varied(OwnParts(Mine()), ["learn.tau", "replay.capacity"])
    own_parts.check_varied(OwnParts(), ["replay.end"])
    for parts, name in ((OwnParts(Mine()), "replay.end"), (OwnParts(network=Net()), "net.growth")):
        with pytest.raises(SettingsError, match=f"^vary: your .* does not read {name}"):
            own_parts.check_varied(parts, [name])


def test_policies_need_their_own_parts():
    """Claim: a run's policy needs the network or learner of the run, not its sampler; one of
    another source is a warning. Older runs name none."""
    sampled, own = (
        own_parts.named(presets.smoke(), parts)
        for parts in (OwnParts(Mine()), OwnParts(network=Net()))
    )
    for cfg, parts in (
        (sampled, OwnParts()),
        (own, OwnParts(network=Net())),
        (presets.smoke(), OwnParts()),
    ):
        own_parts.check_loadable("run", cfg, parts)
    with pytest.raises(SettingsError, match=r"^run was trained with network .*; give it: csac_jax"):
        own_parts.check_loadable("run", own, OwnParts())
    with pytest.warns(DataWarning, match=r"^run was trained with network .*width=4.*width=5"):
        own_parts.check_loadable("run", own, OwnParts(network=Net(width=5)))
