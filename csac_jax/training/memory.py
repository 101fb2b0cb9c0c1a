"""What a run will hold in memory, part by part, known before anything is compiled; a run that
cannot fit is refused.

State, ring and networks are exact: their shapes are traced. What a training step needs beside them
is a model: counts of the maps that are alive at once, times their sizes, with coefficients fitted
to what XLA reports for compiled stages on a CPU (jaxlib 0.10.1, small nets). Whole programs, to
which nothing was fitted, stand beside their predictions in
`experiments/results/bench-memory-cpu.json`. XLA shares memory between stages, so the largest need
counts. Where nothing was fitted, DenseNet-121's gradients and GPUs, expect less: for `paper` on an
H200 3.5 GB, where 2.6 were measured.
"""

import dataclasses
import math
import os
import types
from typing import Any

import jax
import jax.numpy as jnp

from csac_jax.config import Config
from csac_jax.nets import dense, networks
from csac_jax.replay import ring
from csac_jax.training import chunked_vmap, step

GIB = 2**30
FLOAT = 4  # bytes

# Fitted, in channels of the size of the net's maps: F of its features, S the sum of F over its
# layers, h of its head.
_LOOK = (2.0, 1.0)  # per pass: 2 F + 1, both the maps before and after a layer
_VALUE = (
    0.914,
    45.5,
)  # per pass whose gradient is taken: 0.914 S + 45.5 (stride / 2)^2, maps of its input's size
_ACTOR = (1.5, 3.28, 18.9)  # per pass of the actor's update: 1.5 F + 3.28 h + 18.9
_VIEW = 22  # fitted, per scene while it is cast into a view: maps of the size of the height map


def limit() -> int:
    """Bytes that the first device can have: its own limit, or all of this machine's memory if it
    states none (CPUs).

    All, not what is free: the system gives up its caches for a run, so that a smaller number would
    refuse too much.
    """
    stats = jax.devices()[0].memory_stats() or {}
    return stats.get("bytes_limit") or os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def predict(cfg: Config) -> dict[str, int]:
    """Bytes by part: `replay`, `scenes` and `networks` are the run's state, `step` the largest need
    of a stage."""
    state = step.abstract_state(cfg)
    exact = {
        "replay": _bytes(state.replay),
        "scenes": _bytes(state.scenes),
        "networks": _bytes(state.learner),
    }
    return {**exact, "step": _largest_need(stages(cfg))}


def _largest_need(needs: dict[str, int]) -> int:
    """Of a step's stages. As XLA orders it, features of a look are held while the scenes move;
    learning is apart."""
    return max(needs["learn"], needs["look"] + needs["simulate"])


def _bytes(tree: Any) -> int:
    return sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def stages(cfg: Config, fitted_only: bool = False) -> dict[str, int]:
    """Temporary bytes of a training step's stages: `look`, `simulate`, `learn`; E, B and K as in
    the package.

    fitted_only: leave out what nothing was fitted to, the gradient of DenseNet-121.
    """
    passes, critics, unit = cfg.net.rotations // 2, cfg.learn.critics, _pass_unit(cfg)
    features, saved = _pass_channels(cfg)
    if fitted_only and cfg.net.kind != "small":
        saved = 0.0
    look = passes * (_LOOK[0] * critics * features + _LOOK[1])
    seen = (cfg.net.stride / 2) ** 2 if cfg.net.kind == "small" else 1.0
    value = 2 * (_VALUE[0] * critics * saved + _VALUE[1] * seen * 0.5 * (1 + critics))
    actor = passes * (_ACTOR[0] * critics * features + _ACTOR[1] * cfg.net.head + _ACTOR[2])
    if (
        not cfg.learn.actor or cfg.net.kind != "small"
    ):  # DenseNet-121's features are 1/32 as wide: next to nothing
        actor = 0.0
    actor *= (cfg.learn.actor_batch or cfg.learn.batch) / cfg.learn.batch
    if (
        cfg.learn.updates == 1
    ):  # no loop in between: the actor's update shares time with the critic's
        actor += value
    group = networks.states_at_once(cfg.net, _canvas(cfg))
    looked, drawn = (min(count, group or count) for count in (cfg.train.scenes, cfg.learn.batch))
    return {
        "look": round(looked * unit * look),
        "simulate": cfg.train.scenes * _scene(cfg),
        "learn": round(unit * max(drawn * look + cfg.learn.batch * value, cfg.learn.batch * actor)),
    }


def _canvas(cfg: Config) -> int:
    return round(cfg.heightmap.size * (1.0 + cfg.net.margin) / 2.0) * 2


def _pass_unit(cfg: Config) -> float:
    """Bytes of one channel of a pass, in the type that it computes in: the small net's maps,
    DenseNet-121's input."""
    cells = (
        _canvas(cfg) // cfg.net.stride if cfg.net.kind == "small" else _canvas(cfg) * cfg.net.zoom
    )
    return jnp.dtype(dense.compute_dtype(cfg.net)).itemsize * cells**2


def _pass_channels(cfg: Config) -> tuple[float, float]:
    """Channels of a pass: of the features, and over all layers, whose inputs the gradient needs."""
    net = cfg.net
    if net.kind == "small":
        widths = [net.stem + i * net.growth for i in range(len(net.dilations) + 1)]
        return widths[-1], sum(widths)
    trunks = int(net.colour) + 1 + int(cfg.task.kind == "target")
    alive = (
        trunks * 28.0
    )  # half of what a look takes on an H200: the stem's maps, before and after their norm
    return alive, trunks * (
        _densenet_kept(net.block_layers, net.block_growth) + 300.0
    )  # 2 and 3 transitions on an H200


def _densenet_kept(layers: tuple[int, ...], growth: int) -> float:
    """Channels of the size of the input that a DenseNet trunk keeps for its gradient: what its
    convolutions made."""
    width, cells = 2 * growth, 16
    total = width / 4 + width / cells
    for count in layers:
        total += count * 5 * growth / cells
        width, cells = (width + count * growth) // 2, cells * 4
        total += width / cells
    return total


def _scene(cfg: Config) -> int:
    """Bytes that one scene needs while it moves, or after that while it is seen, whichever is more.

    Moving, it holds an engine's data: constraint rows, matrices of the solver. Seen, maps of its
    view.
    """
    freedoms, contacts = 6 * len(cfg.scene.slots) + 6, cfg.sim.contacts
    data = (
        4 * FLOAT * contacts * freedoms + 2 * FLOAT * freedoms**2 + 350 * contacts + 4500
    )  # fitted to mjx.Data
    return max(data, _VIEW * FLOAT * cfg.heightmap.size**2)


def check(cfg: Config) -> None:
    """Raises ValueError, with the setting to change and the largest value that fits, if a run is
    too large.

    In seconds: networks, which take long to trace and little room, are left out, and so is what was
    not fitted.
    """
    available, total = limit(), sure(cfg)
    if total <= available:
        return
    too_large = f"a run takes {total / GIB:.1f} GiB, there are {available / GIB:.1f}"
    for name in sorted(
        KNOBS, key=lambda name: sure(_with(cfg, name, KNOBS[name]))
    ):  # what most depends on comes first
        value = _largest(cfg, name, available)
        if value:
            raise ValueError(
                f"{name}: {too_large}; lower --{name} from {_value(cfg, name)} to {value} at the very most"
            )
    raise ValueError(f"heightmap.size: {too_large}; lower it, or several of: {', '.join(KNOBS)}")


KNOBS = {"replay.capacity": 2, "learn.batch": 1, "train.scenes": 1}
"""Settings that memory falls with, and their least values."""


def sure(cfg: Any, members: int = 1, alike: bool = True) -> int:
    """Bytes that a run takes for sure, or several side by side; if `alike` but for seeds, networks
    may take turns."""
    slot = ring.bytes_needed(1, step.example(cfg))
    at_once = (alike and chunked_vmap.at_once(cfg, members)) or members
    return members * cfg.replay.capacity * slot + at_once * _largest_need(
        stages(cfg, fitted_only=True)
    )


def _value(cfg: Config, name: str) -> int:
    section, field = name.split(".")
    return getattr(getattr(cfg, section), field)


def _with(cfg: Config, name: str, value: int) -> Any:
    """What has the fields of `cfg`, one of them changed, whatever the others have against it."""
    section, field = name.split(".")
    sections = {part.name: getattr(cfg, part.name) for part in dataclasses.fields(cfg)}
    return types.SimpleNamespace(
        **{**sections, section: dataclasses.replace(sections[section], **{field: value})}
    )


def _largest(cfg: Config, name: str, available: int) -> int:
    """The largest value of a setting with which the run fits, all else as it is; 0 if there is
    none."""
    needed = max(cfg.train.scenes, cfg.learn.batch) if name == "replay.capacity" else KNOBS[name]
    low, high = KNOBS[name] - 1, _value(cfg, name)  # high does not fit
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if sure(_with(cfg, name, middle)) <= available else (low, middle)
    return low if low >= needed else 0
