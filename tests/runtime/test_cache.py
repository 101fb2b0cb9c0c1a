"""The cache of compiled programs, in fresh processes; the suite itself has one for a session."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from csac_jax.runtime import cache

ROOT = Path(cache.__file__).parents[2]
NO_FOLDER = {  # the session's is left out, and XLA logs what it would log to a user
    "JAX_COMPILATION_CACHE_DIR": "",
    "TF_CPP_MIN_LOG_LEVEL": "1",
}

PROGRAM = """
import csac_jax, hashlib, json
from csac_jax.runtime import cache
import jax, jax.numpy as jnp
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
folder = cache.enable()
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
rows = jnp.linspace(0.0, 1.0, 5000).reshape(50, 100)
def step(x, _):
    return jnp.tanh(x @ jnp.sort(x.T) / 50) @ x[:50] * 0.5 + jnp.cumsum(x, 1) * 0.01, x.sum()
scan = jax.jit(lambda x: jax.lax.scan(step, x, length=20), donate_argnums=0)
program = scan.lower(rows).compile()
before = cache.hits()
leaves = [bytes(memoryview(jax.device_get(leaf))) for leaf in program(rows)]
result = hashlib.sha256(b"".join(leaves)).hexdigest()
print(json.dumps({"folder": folder and str(folder), "hits": before, "result": result}))
"""


def _python(tmp_path: Path, *arguments: str, **variables: str) -> str:
    """The output of a program in a fresh process whose cache directory is `tmp_path`; nothing may
    be on stderr."""
    settings = {"XDG_CACHE_HOME": str(tmp_path), **NO_FOLDER, **variables}
    command = [sys.executable, "-W", "ignore", "-c", *arguments]
    pipes: Any = {"capture_output": True, "text": True, "timeout": 120, "cwd": ROOT}
    done = subprocess.run(command, env={**os.environ, **settings}, **pipes)
    assert done.returncode == 0, done.stderr
    assert done.stderr == "" or "corrupt" in done.stderr
    return done.stdout


def _run(tmp_path: Path, **variables: str) -> dict:
    return json.loads(_python(tmp_path, PROGRAM, **variables))


def test_second_process_finds_the_program(tmp_path: Path):
    """Claim: a second process takes the program from the cache and gets the same result, bit for
    bit; only the user can read the folder; damaged entries are compiled again."""
    first, second = _run(tmp_path), _run(tmp_path)
    assert first["hits"] == 0
    assert second["hits"] > 0
    assert first["result"] == second["result"]
    folder = Path(first["folder"])
    assert folder.parent == tmp_path / "csac_jax" / "xla"
    assert folder.parent.stat().st_mode & 0o77 == 0
    assert folder.stat().st_mode & 0o77 == 0
    for i, path in enumerate(sorted(folder.glob("*-cache"))):
        whole = bytearray(path.read_bytes())
        whole[len(whole) // 2] ^= 0xFF
        path.write_bytes(whole if i % 2 else whole[: len(whole) // 2])
    third = _run(tmp_path)
    assert third["hits"] == 0
    assert third["result"] == first["result"]


def test_folder_is_the_users_choice(tmp_path: Path):
    """Claim: JAX_COMPILATION_CACHE_DIR decides; JAX_ENABLE_COMPILATION_CACHE=0 switches the cache
    off; so does a folder that cannot be made."""
    chosen = tmp_path / "chosen"
    assert _run(tmp_path, JAX_COMPILATION_CACHE_DIR=str(chosen))["folder"] == str(chosen)
    assert list(chosen.glob("*-cache"))
    assert _run(tmp_path, JAX_ENABLE_COMPILATION_CACHE="0")["folder"] is None
    assert not (tmp_path / "csac_jax").exists()
    (tmp_path / "csac_jax").write_text("in the way")
    assert _run(tmp_path)["folder"] is None


LIMITED = """
import sys
import csac_jax
import jax, jax.numpy as jnp
from csac_jax.runtime import cache
cache.LARGEST, cache.SHORTEST = int(sys.argv[1]), 0.0
folder = cache.enable()
rows = jnp.arange(1000.0)
for power in map(int, sys.argv[2:]):
    before = cache.hits()
    jax.jit(lambda x, power=power: jnp.sort(x) ** power)(rows)
    print(cache.hits() - before, sum(path.stat().st_size for path in folder.glob("*-cache")))
"""


def _sizes(tmp_path: Path, limit: int, *powers: int) -> list[tuple[int, int]]:
    """Hits and bytes in the cache after each program of LIMITED."""
    lines = _python(tmp_path, LIMITED, str(limit), *map(str, powers)).splitlines()
    return [(int(hits), int(size)) for hits, size in map(str.split, lines)]


@pytest.mark.parametrize("dated", [True, False])
def test_full_cache_drops_what_is_unused_for_longest(tmp_path: Path, dated: bool):
    """Claim: the cache grows no larger than it may be, the entry that is unused for longest goes
    first; entries without a time of last use are the oldest, and no trouble."""
    (_, first), (_, second), (_, whole) = _sizes(tmp_path, 2**30, 2, 3, 4)
    if not dated:
        for path in (tmp_path / "csac_jax").rglob("*-atime"):
            path.unlink()
    used, new = _sizes(tmp_path, whole, 2, 5)
    assert used == (1, whole)
    assert new[0] == 0
    assert first < second < new[1] <= whole
    assert [hits for hits, _ in _sizes(tmp_path, whole, 2, 3)] == [1, 0]
