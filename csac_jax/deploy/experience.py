"""From a record to transitions for a learner. It sees the height maps that were decided on.

The learner's modules need MuJoCo installed, though nothing is simulated. n = transitions.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.agent.learner import Learner, Transition
from csac_jax.agent.rewards import ActionResult
from csac_jax.config import Config
from csac_jax.constants import CHANGE_AREA, OUTCOMES, Outcome, Primitive
from csac_jax.deploy import CameraPolicy
from csac_jax.deploy.record import PUSHED, Entry
from csac_jax.errors import FailedError, SettingsError
from csac_jax.robot.primitives import Action
from csac_jax.vision import heightmap
from csac_jax.vision.heightmap import PackedObservation

_AT_ONCE = 32  # transitions that are rewarded together: their maps fill the memory


class Experience(NamedTuple):
    """The content of a record. NumPy leaves [n, ...]."""

    obs: PackedObservation
    action: Action
    outcome: Any  # [n] int32, Outcome; NOTHING of pushes
    next_obs: PackedObservation
    terminated: Any  # [n] bool


def load(policy: CameraPolicy, entries: list[Entry]) -> Experience:
    """Loads the actions whose outcome is known, seen as `policy` sees.

    The next entry shows what an action led to. An action without one is left out, unless its scene
    ended. Raises SettingsError for damaged entries, and if no action is left.
    """
    by_number = {int(entry.path.name): entry for entry in entries}
    maps: dict[int, PackedObservation] = {}

    def seen(number: int) -> PackedObservation:
        if number not in maps:
            maps[number] = _observed(policy, by_number[number])
        return maps[number]

    rows = []
    for number, entry in by_number.items():
        ended = entry.outcome is not None and entry.outcome.ended
        if entry.outcome is None or not (ended or number + 1 in by_number):
            continue
        after = seen(number) if ended else seen(number + 1)
        rows.append(Experience(seen(number), *_done(entry), after, np.bool_(ended)))
    if not rows:
        raise SettingsError(
            "the record has no action with an outcome and an image after it; post outcomes, "
            "see docs/robot.md"
        )
    return jax.tree.map(lambda *leaves: np.stack(leaves), *rows)


def _observed(policy: CameraPolicy, entry: Entry) -> PackedObservation:
    """Returns the policy's view of an entry's image. The mask counts in the task `target`."""
    rgb, depth, lens, pose, mask = entry.image
    try:
        marked = mask if policy.cfg.task.kind == "target" else None
        obs = policy.observe(rgb, depth, lens, pose, marked)
    except (SettingsError, FailedError) as error:
        raise SettingsError(f"{entry.path}: {error}") from None
    return jax.device_get(heightmap.pack(obs))


def _done(entry: Entry) -> tuple[Action, Any]:
    """Returns the action of an entry and its outcome, NumPy leaves [...]."""
    primitive, place = entry.action
    pose: Any = np.array(place, np.float32)
    name = entry.outcome.outcome if entry.outcome else PUSHED
    kind: Any = np.int32(Primitive.PUSH if primitive == "push" else Primitive.GRASP)
    level = Outcome.NOTHING if name == PUSHED else Outcome(OUTCOMES.index(name))
    return Action(kind, pose), np.int32(level)


def transitions(
    policy: CameraPolicy, learner: Learner, state: Any, experience: Experience
) -> Transition:
    """Returns the transitions of an experience, rewarded as in training, leaves [n, ...]."""
    parts = []
    for i in range(0, len(experience.outcome), _AT_ONCE):
        part = jax.tree.map(lambda leaf, i=i: leaf[i : i + _AT_ONCE], experience)
        parts.append(jax.device_get(_rewarded(policy.cfg, learner, state, part)))
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _rewarded(cfg: Config, learner: Learner, state: Any, part: Experience) -> Transition:
    """Computes the rewards of a part; lost blocks and distances are unknown and cost 0."""
    unknown = jnp.zeros(part.outcome.shape)
    obs, after = heightmap.unpack(part.obs), heightmap.unpack(part.next_obs)
    moved = jax.vmap(heightmap.moved_area, (None, 0, 0))(cfg.heightmap, obs.height, after.height)
    result = ActionResult(
        primitive=part.action.primitive,
        outcome=part.outcome,
        distance=unknown,
        phi_before=unknown,
        phi_after=unknown,
        changed=moved > CHANGE_AREA,
        blocks_lost=jnp.zeros(part.outcome.shape, jnp.int32),
    )
    reward, better = learner.reward(cfg.reward, state, obs, after, result)
    label = better if cfg.reward.relabels else None
    end = part.terminated
    if cfg.target.bootstrap == "continuing":  # nothing follows an action without any effect
        end |= ~(result.changed | (part.outcome == Outcome.LIFTED))
    return Transition(part.obs, part.action, reward, part.next_obs, end, label)
