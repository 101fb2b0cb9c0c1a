"""The command line with the toy's training in place of the real one.

python -m tests.faults.toy_cli train smoke ...
"""

import functools
import sys
from collections.abc import Callable

import csac_jax  # noqa: F401  (before JAX: it sets up the thread pool)
from csac_jax import cli
from csac_jax.config import Config
from csac_jax.training import memory, programs, split_step
from tests.faults import toy

OPTIONS = ("--train.scenes", f"{toy.E}", "--train.chunk", "1", "--train.save-every", "1")


def _make(cfg: Config, **_: object) -> Config:
    return cfg


def _compile_init(cfg: Config) -> Callable[[], toy.State]:
    return functools.partial(toy.first_state, cfg.seed)


def _compile_chunk(cfg: Config, num_steps: int, **_: object) -> object:
    return toy.compile_chunk(num_steps)


if __name__ == "__main__":
    programs.make, programs.compile_init = _make, _compile_init  # type: ignore
    split_step.compile_chunk = _compile_chunk  # type: ignore
    programs.prepare = lambda _: None
    memory.check = lambda *_: None  # type: ignore
    sys.exit(cli.main(sys.argv[1:]))
