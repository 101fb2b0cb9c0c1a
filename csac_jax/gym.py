"""Gymnasium's interface to the environment; needs `pip install 'csac-jax[gymnasium]'`.

    import csac_jax.gym
    env = gymnasium.make("csac_jax/Clutter-v0", config="quick", actions="dense")
    envs = gymnasium.make_vec("csac_jax/Clutter-v0", num_envs=64)  # one compiled call a step

Observations are dicts: `colour` [H, W, 3] uint8, `height` [H, W] float32 m, and in the target task
`target` [H, W] uint8, 1 where the wanted block is seen. The reward is 1 for a wanted block.
"""

import dataclasses
import functools
from typing import Any, Literal, get_args

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from csac_jax import geometry, presets
from csac_jax.config import CameraConfig, Config
from csac_jax.constants import OUTCOMES, Primitive
from csac_jax.env import AutoResetEnv, Env, Info, State, make_env
from csac_jax.robot.primitives import Action
from csac_jax.runtime import cache
from csac_jax.sim import backend
from csac_jax.vision import camera, observe
from csac_jax.vision.heightmap import Observation
from csac_jax.world.scene_state import SceneState

ActionKind = Literal["continuous", "dense"]
"""`continuous`: [4] in -1 .. 1: below 0 a grasp, else a push; x and y of half the workspace; yaw of
pi. `dense`: a number, the cell [P, K, H, W] of maps of P primitives, K = net.rotations yaws."""
PICTURE = CameraConfig(size=(640, 480), position=(-0.45, -0.25, 0.45))
_INFO = ("cleared", "blocks_lost", "physics_diverged")


@dataclasses.dataclass(frozen=True, eq=False)
class Interface:
    """An environment's spaces, and conversions to and from them."""

    env: Env
    actions: ActionKind

    @classmethod
    def make(cls, config: str | Config, actions: ActionKind, scenes: int) -> "Interface":
        """Makes the interface of a config or preset. Raises ValueError for bad arguments."""
        if scenes < 1:
            raise ValueError(f"num_envs: must be at least 1, not {scenes}")
        if actions not in get_args(ActionKind):
            raise ValueError(f"actions: {actions!r} is not one of: continuous, dense")
        cfg = presets.get(config) if isinstance(config, str) else config
        cache.enable()
        return cls(make_env(backend.resolve(cfg, runs=-(-scenes // cfg.train.scenes))), actions)

    @property
    def observation_space(self) -> spaces.Dict:
        """Returns the space of one scene's observations."""
        spec = self.env.observation_spec
        parts: dict[str, spaces.Space[Any]] = {
            "colour": spaces.Box(0, 255, spec.colour.shape, np.uint8),
            "height": spaces.Box(0.0, spec.height.maximum, spec.height.shape, np.float32),
        }
        if self.env.cfg.task.has_target:
            parts["target"] = spaces.Box(0, 1, spec.target.shape, np.uint8)
        if spec.fingers is not None:
            parts["fingers"] = spaces.Box(0.0, 1.0, spec.fingers.shape, np.float32)
        return spaces.Dict(parts)

    @property
    def action_space(self) -> spaces.Space[Any]:
        """Returns the space of one scene's actions, see ActionKind."""
        if self.actions == "continuous":
            return spaces.Box(-1.0, 1.0, (4,), np.float32)
        return spaces.Discrete(int(np.prod(self._cells)))

    @property
    def _cells(self) -> tuple[int, ...]:
        cfg = self.env.cfg
        return len(Primitive), cfg.net.rotations, cfg.heightmap.size, cfg.heightmap.size

    def action(self, action: jax.Array) -> Action:
        """Converts an action of the action space to the environment's."""
        if self.actions == "continuous":
            half = 0.5 * self.env.cfg.heightmap.extent
            kind = jnp.where(action[0] < 0.0, Primitive.GRASP, Primitive.PUSH)
            return Action(kind.astype(jnp.int32), action[1:] * jnp.array([half, half, np.pi]))
        kind, yaw, row, column = jnp.unravel_index(action.astype(jnp.int32), self._cells)
        xy = geometry.cell_centres(self.env.cfg.heightmap)[row, column]
        turn = 2.0 * np.pi / self._cells[1] * yaw.astype(jnp.float32)
        return Action(kind.astype(jnp.int32), jnp.append(xy, turn))

    def observation(self, obs: Observation) -> dict[str, np.ndarray]:
        """Converts an observation, leaves [...] or [E, ...], to the observation space."""
        parts = {
            "colour": np.round(255.0 * np.asarray(obs.colour)).astype(np.uint8),
            "height": np.array(obs.height),
            "target": np.asarray(obs.target).astype(np.uint8),
            "fingers": np.asarray(obs.fingers),
        }
        return {name: parts[name] for name in self.observation_space.spaces}


class ClutterEnv(gymnasium.Env[Any, Any]):
    """One scene. `info`: outcome of a grasp, cleared, blocks_lost, physics_diverged."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 2}  # noqa: RUF012  (Gymnasium's way)

    def __init__(
        self,
        config: str | Config = "quick",
        actions: ActionKind = "continuous",
        render_mode: str | None = None,
    ) -> None:
        """Settles its scenes once; see `Interface.make` for arguments and errors."""
        self.interface = Interface.make(config, actions, 1)
        self.observation_space = self.interface.observation_space
        self.action_space = self.interface.action_space
        self.render_mode = render_mode
        env = self.interface.env
        self._reset = jax.jit(env.reset)
        self._step = jax.jit(lambda state, action: env.step(state, self.interface.action(action)))
        self.state: State | None = None  # ground truth too; None before the first reset

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Starts an episode; returns its first observation and an empty info."""
        super().reset(seed=seed)
        self.state = self._reset(_key(self.np_random))
        return self.interface.observation(self.state.obs), {}

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Steps the environment, see `Env.step`. Raises ResetNeeded before the first reset."""
        after = self.state = self._step(_ready(self.state), jnp.asarray(action))
        info = {name: np.asarray(getattr(after.info, name)).item() for name in _INFO}
        info["outcome"] = OUTCOMES[int(after.info.outcome)]
        ends = bool(after.terminated), bool(after.truncated)
        return self.interface.observation(after.obs), float(after.reward), *ends, info

    def render(self) -> np.ndarray | None:
        """Renders [480, 640, 3] uint8 from the side by our rays; None without a mode."""
        if self.render_mode is None:
            return None
        return np.asarray(_picture(self.interface.env.cfg, _ready(self.state).scene))


class ClutterVectorEnv(VectorEnv[dict[str, np.ndarray], Any, np.ndarray]):
    """A batch of scenes, each replaced in the step in which it ends, see `final_obs`."""

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012  (Gymnasium's way)

    def __init__(
        self, num_envs: int = 1, config: str | Config = "quick", actions: ActionKind = "continuous"
    ) -> None:
        """Makes `num_envs` scenes, see `ClutterEnv`."""
        self.num_envs = num_envs
        self.interface = Interface.make(config, actions, num_envs)
        self.single_observation_space = self.interface.observation_space
        self.single_action_space = self.interface.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        auto = AutoResetEnv(self.interface.env)

        def step(key: jax.Array, state: State, action: jax.Array) -> tuple[State, State]:
            return auto.step(key, state, self.interface.action(action))

        self._reset, self._step = jax.jit(jax.vmap(auto.reset)), jax.jit(jax.vmap(step))
        self.state: State | None = None  # to act in next, leaves [E, ...]; None before a reset

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Starts episodes, see `ClutterEnv.reset`."""
        super().reset(seed=seed)
        self.state = self._reset(self._keys())
        return self.interface.observation(self.state.obs), {}

    def step(
        self, actions: Any
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Steps every scene, see `ClutterEnv.step`; `info` is of these actions."""
        state = _ready(self.state)
        self.state, after = self._step(self._keys(), state, jnp.asarray(actions))
        ends = np.array(after.terminated), np.array(after.truncated)
        info, done = _infos(after.info), ends[0] | ends[1]
        if done.any():
            info |= {"final_obs": self._final(after.obs, done), "_final_obs": done}
            info |= {"final_info": _infos(after.info), "_final_info": done}
        obs = self.interface.observation(self.state.obs)
        return obs, np.array(after.reward), *ends, info

    def _keys(self) -> jax.Array:
        return jax.random.split(_key(self.np_random), self.num_envs)

    def _final(self, obs: Observation, done: np.ndarray) -> np.ndarray:
        """Returns the last observations of episodes [E], None elsewhere."""
        parts = self.interface.observation(obs)
        rows = ({name: part[i] for name, part in parts.items()} for i in range(self.num_envs))
        return np.array([row if over else None for row, over in zip(rows, done, strict=True)])


def _ready(state: State | None) -> State:
    if state is None:
        raise gymnasium.error.ResetNeeded("call reset first")
    return state


def _key(rng: np.random.Generator) -> jax.Array:
    return jax.random.key(int(rng.integers(2**31)))


def _infos(info: Info) -> dict[str, Any]:
    """Converts step infos [E] to Gymnasium's vector format: `_name` is True where `name` is set."""
    infos: dict[str, Any] = {name: np.array(getattr(info, name)) for name in _INFO}
    infos["outcome"] = np.array(OUTCOMES, object)[np.asarray(info.outcome)]
    return infos | {f"_{name}": np.ones(len(part), bool) for name, part in infos.items()}


@functools.partial(jax.jit, static_argnums=0)
def _picture(cfg: Config, scene: SceneState) -> jax.Array:
    shapes = observe.scene_shapes(cfg.scene, scene)
    tables = observe.scene_tables(cfg.scene, scene, shapes)
    hits = observe.cast_pixels(cfg.change(camera=PICTURE), camera.make(PICTURE), shapes)
    lit = tables.colour.at[hits.surface].get(mode="promise_in_bounds")
    shown = jnp.where(hits.valid[..., None], lit, camera.SKY[None, None])
    return jnp.round(255.0 * shown).astype(jnp.uint8)


gymnasium.register(
    "csac_jax/Clutter-v0",
    entry_point=f"{__name__}:{ClutterEnv.__name__}",
    vector_entry_point=f"{__name__}:{ClutterVectorEnv.__name__}",
)
