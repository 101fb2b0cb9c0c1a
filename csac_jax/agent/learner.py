"""The interface between a training step and what learns from replayed transitions."""

import abc
from typing import Any, NamedTuple

import jax
from flax import struct

from csac_jax.agent import rewards
from csac_jax.config import RewardConfig
from csac_jax.robot.primitives import Action
from csac_jax.vision.heightmap import Observation, PackedObservation


@struct.dataclass
class Transition:
    """One action with its states and reward; a batch has a leading axis B."""

    obs: PackedObservation
    action: Action
    reward: jax.Array  # [] float32, R of CSAC eq. 12
    next_obs: PackedObservation
    terminated: jax.Array  # [] bool, a true end: nothing follows
    push_better: jax.Array | None = None  # [] bool, label in `reward`; None if it is not stored


class UpdateInfo(NamedTuple):
    """Losses and errors of one update."""

    critic_loss: jax.Array  # []
    q: jax.Array  # [] mean of Q(s, a)
    error: jax.Array  # [B] TD errors y - Q(s, a), for the sampler


class Learner(abc.ABC):
    """Pure functions of a state, any pytree of arrays; E scenes side by side, B transitions."""

    @abc.abstractmethod
    def init(self, key: jax.Array) -> Any:
        """Creates the state before the first update."""

    @abc.abstractmethod
    def act(
        self,
        key: jax.Array,
        state: Any,
        obs: Observation,
        steps_without_change: jax.Array,
        actions_taken: jax.Array | None = None,
    ) -> Action:
        """Chooses an action for every observation, leaves [E, ...]; steps_without_change [E] int32.

        Exploration decays with `actions_taken` [] int32, of the whole run; None: no exploration.
        """

    @abc.abstractmethod
    def update(
        self, key: jax.Array, state: Any, batch: Transition, weights: jax.Array
    ) -> tuple[Any, UpdateInfo]:
        """Makes one update on a batch, leaves [B, ...], whose losses count by `weights` [B]."""

    def reward(
        self,
        cfg: RewardConfig,
        state: Any,
        obs: Observation,
        next_obs: Observation,
        result: rewards.ActionResult,
    ) -> tuple[jax.Array, jax.Array]:
        """Computes rewards [E] float32 and which pushes were good [E] bool; `result` lacks phi.

        By default phi is 0: take `push_label` "map_changed" with it.
        """
        return rewards.rewards_of(cfg, result)
