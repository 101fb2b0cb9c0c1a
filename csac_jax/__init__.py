"""A robot learns to push and grasp in clutter: physics, vision, networks, learner in one program.

    import csac_jax as csac

    env = csac.make_env(csac.presets.quick())          # reset(key), step(state, action): pure JAX
    run = csac.train(csac.presets.quick(), "runs/a")
    policy = csac.load_policy("shipped")               # action = policy(obs, key)
    table = csac.evaluate(policy, suite="random10", episodes=50)

The names in `__all__` are the public API; everything else may move without notice.

Map, in the direction of data; imports point only backwards along it:

    constants   numbers that several stages share
    grippers    the hand and its numbers, as a value
    section     frozen groups of settings; config: every setting
    runtime     compile cache, devices, signals, provenance; all of JAX that is private
    algorithms  the CSAC family and its baselines, from config to config; presets: named configs
    geometry    poses, pixels <-> metres
    objects     convex parts: libraries, procedural families, import of meshes
    robot       models of hand and arm, kinematics, push and grasp primitives
    world       the state of a scene and its MuJoCo model
    scenes      settled pools, packings, case files
    sim         physics engines, outcomes of actions
    vision      raycaster, height and colour maps, cameras
    nets        dense Q maps and action proposals
    agent       learner: cross-entropy method, targets, losses, rewards, exploration, update
    replay      ring of transitions and its samplers
    baselines   an oracle, antipodal grasps, a planner that simulates
    env         reset and step of one scene
    io          checkpoints, policy files, configs
    training    the training step and its host loop
    evaluation  policies, suites, metrics, statistics
    deploy      a policy at a real camera: images in, actions out; runs without MuJoCo
    sweeps      many runs in one program, over devices and hosts
    gym         Gymnasium's interface to the environment
    render      pictures and videos; report: tables, charts, pages
    api         the functions of the public API; cli: the command `csac-jax`

Axis letters: E scenes in the batch, B learner batch, N block slots, G geoms, R rays, K rotations,
H W heightmap rows and columns, J CEM candidates, A action dimensions, C replay capacity, S seeds,
T scan time.

Units are SI, angles rad; a name carries its unit only where it is not SI (`_mm`, `_deg`, `_px`).
The frame is the robot base's, moved so that the centre of the workspace on the table is (0, 0, 0),
z up. `T_a_b` maps b to a. Masks say what is true: `valid`, never `mask`.

Importing this package sets environment variables that JAX reads as it starts, see `_guard`: import
it first. JAX itself is loaded with the first name that needs it.
"""

import importlib
from typing import TYPE_CHECKING, Any

from csac_jax import _guard
from csac_jax._version import __version__ as __version__

if TYPE_CHECKING:
    from csac_jax import algorithms, deploy, presets
    from csac_jax.agent.learner import Learner, Transition, UpdateInfo
    from csac_jax.api import Run, evaluate, load_policy, sweep, train, train_fn
    from csac_jax.config import Config
    from csac_jax.env import AutoResetEnv, Env, State, make_env
    from csac_jax.evaluation.policies import Policy
    from csac_jax.io.configs import load_config
    from csac_jax.replay.samplers import Sample, Sampler
    from csac_jax.robot.primitives import Action
    from csac_jax.training.callbacks import Callback, Record
    from csac_jax.vision.heightmap import Observation, unpack

_HOMES = {
    "csac_jax": ("algorithms", "deploy", "presets"),
    "csac_jax.agent.learner": ("Learner", "Transition", "UpdateInfo"),
    "csac_jax.api": ("Run", "evaluate", "load_policy", "sweep", "train", "train_fn"),
    "csac_jax.config": ("Config",),
    "csac_jax.env": ("AutoResetEnv", "Env", "State", "make_env"),
    "csac_jax.evaluation.policies": ("Policy",),
    "csac_jax.io.configs": ("load_config",),
    "csac_jax.replay.samplers": ("Sample", "Sampler"),
    "csac_jax.robot.primitives": ("Action",),
    "csac_jax.training.callbacks": ("Callback", "Record"),
    "csac_jax.vision.heightmap": ("Observation", "unpack"),
}

__all__ = ["Action", "AutoResetEnv", "Callback", "Config", "Env", "Learner", "Observation"]
__all__ += ["Policy", "Record", "Run", "Sample", "Sampler", "State", "Transition", "UpdateInfo"]
__all__ += ["algorithms", "deploy", "evaluate", "load_config", "load_policy", "make_env"]
__all__ += ["presets", "sweep", "train", "train_fn", "unpack"]

_guard.refuse_broken_jax()
_guard.switch_off_broken_fusion()
_guard.switch_off_broken_partitioner()
_guard.widen_thread_pool()


def __getattr__(name: str) -> Any:
    """Imports a public name when it is first asked for."""
    for home, names in _HOMES.items():
        if name in names:
            if home == "csac_jax":
                return importlib.import_module(f"csac_jax.{name}")
            return getattr(importlib.import_module(home), name)
    raise AttributeError(f"module 'csac_jax' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
