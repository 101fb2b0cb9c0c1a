"""What the commands do, as functions; the package root exports them."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from csac_jax.agent.learner import Learner
from csac_jax.config import Config
from csac_jax.evaluation.policies import Policy
from csac_jax.replay.samplers import Sampler
from csac_jax.runtime import cache, signals
from csac_jax.sim import auto
from csac_jax.training import loop, memory, step
from csac_jax.training.loop import Record, Reporter, Summary
from csac_jax.training.step import TrainState

RUNS = Path("runs")
Callback = Callable[[Record], None]


class Run(NamedTuple):
    """A run that has ended or was stopped."""

    run_dir: Path
    cfg: Config
    summary: Summary
    parts: dict[str, Any]  # learner and network of your own, if any

    @property
    def policy(self) -> Policy:
        """The policy of the last checkpoint."""
        return load_policy(self.run_dir, **self.parts)


def train(
    cfg: Config,
    run_dir: str | Path | None = None,
    *,
    resume: bool = False,
    init: str | Path | None = None,
    sampler: Sampler | None = None,
    network: Any = None,
    learner: Learner | None = None,
    callbacks: Sequence[Callback] = (),
    reporter: Reporter | None = None,
    stop: signals.Stop | None = None,
) -> Run:
    """Trains a config in `run_dir` until its actions are done; prints progress and saves.

    Args: run_dir, a new folder, by default runs/PRESET-SEED-TIME. resume, goes on with the run in
    `run_dir`; its config must be the same but for more `train.actions`. init, a policy to start
    from: "shipped", a run's folder or a policy file; or torchvision's weights of DenseNet-121, a
    .safetensors file. sampler, `Sampler`; network, a Flax module, see `nets.networks`; learner,
    `Learner`: parts of your own, which a resumed run needs again. callbacks, called with the
    `Record` of each chunk. reporter, shows progress in place of the terminal. stop, see `signals`.
    Raises ValueError for what cannot be trained, FileExistsError for a folder that exists,
    TrainingError for a run that fails, CheckpointError for one that cannot be resumed.
    """
    cfg = auto.resolve(cfg)
    memory.check(cfg)
    folder = new_folder(f"{cfg.preset}-{cfg.seed}") if run_dir is None else Path(run_dir)
    begin = initial(cfg, init, network)
    program_of = _once(lambda: step.make(cfg, learner=learner, sampler=sampler, network=network))
    cache.enable()

    def first_state() -> TrainState:
        state = step.init(program_of())
        return state.replace(learner=begin(state.learner))

    summary = loop.run(
        cfg,
        folder,
        first_state,
        lambda num_steps: step.compile_chunk(program_of(), num_steps),
        _Reporters([reporter or _terminal(), *map(_Called, callbacks)]),
        stop or signals.Stop(),
        resume=resume,
    )
    own = {"learner": learner, "network": network}
    return Run(folder, cfg, summary, {name: part for name, part in own.items() if part is not None})
