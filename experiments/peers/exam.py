"""An exam by a peer's protocol: rounds of objects, each until the table is empty or two grasps in a
row failed."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from csac_jax.config import Config
from csac_jax.constants import Primitive
from csac_jax.deploy import CameraPolicy, decision
from csac_jax.deploy.decision import Choice, Decision
from csac_jax.errors import ViewError
from csac_jax.evaluation import policies
from csac_jax.evaluation.metrics import bootstrap_ratio
from csac_jax.sim.outcome import BARE
from csac_jax.vision.heightmap import Observation
from experiments.peers import clutter_removal
from experiments.peers.clutter_removal import Image, Peer, View

BASELINES = ("random", "geometric")  # policies without networks that need no more than an image
BASE = "shipped"  # whose config they take
FAILURES = 2  # in a row end a round

Decide = Callable[[jax.Array, Image], Decision | None]


@dataclasses.dataclass
class Round:
    """Counts of one round."""

    presented: int  # objects
    tried: int = 0  # grasps
    lifted: int = 0
    unseen: int = 0  # 1 if it ended as the policy saw nothing to grasp
    refused: int = 0  # 1 if it ended by an image that does not show enough of the workspace


class Options(NamedTuple):
    """Settings of an exam."""

    view: View
    noise: float  # m, standard deviation of the depth
    objects: int  # of a round
    rounds: int
    seed: int


def decider(source: str, sim: Any, changes: dict[str, Any]) -> Decide:
    """Makes what decides about an image: a policy's networks, `random` or `geometric`.

    It only grasps. `changes` are those of the config's `sim`, with the gripper's name.
    """
    baseline = policies.BASELINES[source] if source in BASELINES else None
    pose = clutter_removal.workspace(sim)
    hand = None if baseline else changes["gripper"]
    loaded = CameraPolicy.load(BASE if baseline else source, pose, hand)
    grasps: dict[str, Any] = {"policy": {"primitive": "grasp"}, "explore": {"push_fraction": 0.0}}
    cfg = loaded.cfg.change(sim=changes, **grasps)
    camera = dataclasses.replace(loaded, cfg=cfg)
    if baseline is None:
        return lambda key, image: next(iter(camera.decide(*image)), None)
    policy, choose = baseline(cfg), jax.jit(_choose, static_argnums=0)

    def decide(key: jax.Array, image: Image) -> Decision | None:
        obs = camera.observe(*image)
        if not np.any(obs.height > BARE):
            return None
        return decision.from_choice(choose(policy, key, obs), pose)

    return decide


def _choose(policy: Any, key: jax.Array, obs: Observation) -> Choice:
    cfg: Config = policy.cfg
    action = policy(obs, key)
    grasp = action.replace(primitive=jax.numpy.int32(Primitive.GRASP))
    stations = decision.stations(cfg, obs.height, grasp)
    return Choice(grasp, jax.numpy.float32(0.0), jax.numpy.bool(True), stations)


def play(peer: Peer, sim: Any, decide: Decide, options: Options, number: int) -> Round:
    """Plays one round. Its scene depends on seed and number alone, not on what decides."""
    sim.rng = np.random.RandomState([options.seed, number])
    rng = np.random.default_rng([options.seed, number])
    key = jax.random.fold_in(jax.random.key(options.seed), number)
    sim.reset(options.objects)
    counts, failures = Round(presented=sim.num_objects), 0
    while sim.num_objects and failures < FAILURES:
        pose = clutter_removal.camera(sim, options.view, rng)
        image = clutter_removal.photograph(peer, sim, pose, options.noise, rng)
        try:
            chosen = decide(jax.random.fold_in(key, counts.tried), image)
        except ViewError:
            counts.refused += 1
            break
        if chosen is None:
            counts.unseen += 1
            break
        with np.errstate(
            invalid="ignore"
        ):  # its angle to a straight-down hand is that of 1 + 1e-16
            label = sim.execute_grasp(clutter_removal.to_grasp(peer, sim, chosen))[0]
        counts.tried += 1
        counts.lifted += bool(label)
        failures = 0 if label else failures + 1
    return counts


def summarise(rounds: Sequence[Round]) -> dict[str, Any]:
    """Returns both shares with 95 % intervals, a bootstrap over rounds, and sums of all counts."""
    names = [field.name for field in dataclasses.fields(Round)]
    columns = {name: np.array([getattr(one, name) for one in rounds]) for name in names}
    lifted, tried, presented = (columns[name] for name in ("lifted", "tried", "presented"))
    return {
        "grasp_success": bootstrap_ratio(lifted, tried, int(tried.sum())),
        "declutter_rate": bootstrap_ratio(lifted, presented, int(presented.sum())),
        "counts": {"rounds": len(rounds)} | {name: int(columns[name].sum()) for name in names},
    }
