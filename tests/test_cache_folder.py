"""The user's cache folder."""

import os
import pathlib
import stat
from pathlib import Path
from unittest import mock

import pytest

from csac_jax import cache_folder
from csac_jax.runtime import cache


@pytest.fixture(autouse=True)
def home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """The user's cache directory."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_only_the_user_can_read_it(home: Path):
    """Claim: every folder below the cache directory is made with mode 0700."""
    folder = cache_folder.private("xla", "a")
    assert folder == home / "csac_jax" / "xla" / "a"
    for level in (folder, folder.parent, folder.parent.parent):
        assert stat.S_IMODE(level.stat().st_mode) == 0o700


@pytest.mark.parametrize(
    ("level", "mode"), [(0, 0o770), (1, 0o707), (2, 0o777), (0, None), (2, None)]
)
def test_folder_that_others_can_write_is_not_used(level: int, mode: int | None):
    """Claim: where others can write into the folder, or one above it, or own it, nothing is
    cached."""
    folder = cache_folder.private("xla", "a")
    assert folder is not None
    path = [folder, *folder.parents][level]
    if mode is not None:
        path.chmod(mode)
    elif os.getuid() == 0:
        os.chown(path, 12345, 12345)
    else:
        pytest.skip("only root can give files away")
    assert cache_folder.private("xla", "a") is None
    assert level == 0 or cache._folder() is None  # its folder is another machine's


def test_user_without_a_home_caches_nothing(monkeypatch: pytest.MonkeyPatch):
    """Claim: without HOME and without an entry in the system's list of users nothing is cached, and
    nothing fails."""
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.delenv("HOME", raising=False)
    monkeypatch.setattr(pathlib.Path, "home", mock.Mock(side_effect=RuntimeError("no home")))
    assert cache_folder.private("pools") is None
    assert cache._folder() is None
