"""Files that appear whole or not at all, and paths that no link leads elsewhere."""

import errno
import json
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from csac_jax.errors import DataWarning
from csac_jax.io import files, lock
from csac_jax.io.files import LinkError
from csac_jax.io.lock import LockedError


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


_LINE = {"step": 1, "actions": 8, "grasps_counted": 2, "seconds": 0.5, "grasp_success": None}
BAD_LINES = (
    *("{", "3", "{}", '{"a":' * 700 + "1" + "}" * 700, "[" * 100_000, '"' + "a" * 2**22 + '"'),
    *(json.dumps(_LINE | {"step": "1"}), json.dumps(_LINE | {"seconds": 10**400})),
)


@pytest.mark.parametrize("bad", BAD_LINES, ids=range(len(BAD_LINES)))
def test_a_damaged_line_of_a_log_is_counted(tmp_path: Path, bad: str):
    """Claim: a line that is no record is left out and counted; the whole file is kept beside the
    log, in the place of a link. A last line that was cut off is no damage; old names are new."""
    path, copy = tmp_path / "metrics.jsonl", tmp_path / "metrics.damaged.jsonl"
    copy.symlink_to(tmp_path / "victim")
    (tmp_path / "victim").write_text("mine")
    old = json.dumps(_LINE | {"step": 2, "left": 1, "parts": {"own": 3}})
    text = f"{json.dumps(_LINE)}\n{bad}\n{old}\n{json.dumps(_LINE | {'step': 3})}\n" + '{"ste'
    path.write_text(text)
    with pytest.warns(DataWarning, match="1 of 4 lines are damaged and left out; the whole file"):
        files.truncate_log(path, 2)
    first, second = files.read_log(path)
    assert first == _LINE
    assert (second["blocks_lost"], second["parts"]) == (1, {"in_distribution": 3})
    assert copy.read_text() == text
    assert (tmp_path / "victim").read_text() == "mine"
    files.truncate_log(path, 0)
    assert path.read_text() == ""


def test_json_that_is_no_object_is_named(tmp_path: Path):
    """Claim: other JSON, deep nesting and a pipe are one line with the file's name."""
    for text, message in (("[]", "holds no JSON object"), ("[" * 10**5, "is not readable JSON")):
        (tmp_path / "a.json").write_text(text)
        with pytest.raises(ValueError, match=rf"a\.json {message}"):
            files.read_object(tmp_path / "a.json")
    files.write_json(tmp_path / "a.json", {"b": 1})
    assert files.read_object(tmp_path / "a.json") == {"b": 1}


def test_a_folder_is_written_by_one_process(tmp_path: Path):
    """Claim: a second holder is refused with the first one's name; one that another host did not
    release is warned of; after the end nobody holds it."""
    with lock.exclusive(tmp_path):
        with pytest.raises(LockedError, match=rf"in use by process {os.getpid()} on"):
            lock.exclusive(tmp_path).__enter__()
        (tmp_path / lock.HOLDER).write_bytes(b"\xff")
        with pytest.raises(LockedError, match="in use by a process"):
            lock.exclusive(tmp_path).__enter__()
    (tmp_path / lock.HOLDER).write_text("process 1 on another host")
    with pytest.warns(DataWarning, match="by process 1 on another host and not released"):
        lock.exclusive(tmp_path).__enter__()


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
