"""Files that appear whole or not at all, and paths that no link leads elsewhere."""

import errno
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from csac_jax.io import files, lock
from csac_jax.io.files import LinkError


def _names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_writers_at_once_do_not_meet(tmp_path: Path):
    """Claim: of many writers of one file at once none fails, and the file is one of theirs."""
    path, contents = tmp_path / "a.json", [str(number) * 10_000 for number in range(8)]
    with ThreadPoolExecutor(8) as threads:
        list(threads.map(lambda text: files.replace(path, text), 5 * contents))
    assert path.read_text() in contents
    assert _names(tmp_path) == ["a.json"]


@pytest.mark.parametrize("name", ["a.json", ".a.json.tmp"])
def test_a_planted_link_is_not_written_through(tmp_path: Path, name: str):
    """Claim: a link in the place of a file, or of a former draft, leaves its target as it was."""
    victim = tmp_path / "victim"
    victim.write_text("mine")
    (tmp_path / name).symlink_to(victim)
    files.replace(tmp_path / "a.json", "new")
    assert victim.read_text() == "mine"
    assert (tmp_path / "a.json").read_text() == "new"
    assert not (tmp_path / "a.json").is_symlink()


def test_a_name_that_is_no_utf8_appears_with_escapes(tmp_path: Path):
    """Claim: text with bytes that are no UTF-8, as of a folder's name, is written with escapes."""
    files.replace(tmp_path / "page.md", "run \udcff\n")
    assert (tmp_path / "page.md").read_bytes() == b"run \\udcff\n"


def test_a_log_that_is_a_link_is_refused(tmp_path: Path):
    """Claim: no line is added to what a link in the log's place leads to."""
    victim = tmp_path / "victim"
    victim.write_text("mine\n")
    (tmp_path / "log").symlink_to(victim)
    with pytest.raises(OSError, match="symbolic links"):
        files.append(tmp_path / "log", "line")
    assert victim.read_text() == "mine\n"
    files.append(tmp_path / "new", "line")
    assert (tmp_path / "new").read_text() == "line\n"


def test_a_write_that_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: where the disc is full the former file stays, and no draft."""
    files.replace(tmp_path / "a", "old")

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        files.replace(tmp_path / "a", "new")
    assert _names(tmp_path) == ["a"]
    assert (tmp_path / "a").read_text() == "old"


def test_drafts_of_killed_processes_are_removed_later(tmp_path: Path):
    """Claim: who takes the lock of a folder removes drafts of an hour ago, and nothing else."""
    stale, fresh, other = (files._DRAFT.format(name) for name in ("stale", "fresh", "link"))
    for name in (stale, fresh, "a.tmp"):
        (tmp_path / name).touch()
    (tmp_path / other).symlink_to(tmp_path / "a.tmp")
    for name in (stale, other, "a.tmp"):
        os.utime(tmp_path / name, (0, 0), follow_symlinks=False)
    with lock.exclusive(tmp_path):
        assert _names(tmp_path) == sorted([fresh, "a.tmp", lock.LOCK, lock.HOLDER])


def test_a_folder_may_be_a_link_but_none_below_it(tmp_path: Path):
    """Claim: a run may be named by a link; a link below it is refused, a ring of links too."""
    run, link = tmp_path / "run", tmp_path / "link"
    (run / "a").mkdir(parents=True)
    link.symlink_to(run)
    assert files.inside(link, "a", "new") == link / "a" / "new"
    (run / "out").symlink_to(tmp_path)
    (run / "within").symlink_to(run / "a")
    (run / "ring").symlink_to(run / "ring")
    for name in ("out", "within", "ring", "within/new", "../run2"):
        with pytest.raises(LinkError, match="is a link; put") as caught:
            files.inside(link, name)
        assert "\n" not in str(caught.value)


def test_the_lock_is_no_link(tmp_path: Path):
    """Claim: a link in the place of the lock is refused and its target stays."""
    victim = tmp_path / "victim"
    victim.write_text("mine")
    run = tmp_path / "run"
    run.mkdir()
    (run / lock.LOCK).symlink_to(victim)
    with pytest.raises(LinkError), lock.exclusive(run):
        pass
    assert victim.read_text() == "mine"
