"""Writes the world, the scenes and the policy of the page "In the browser".

`python -m docs.browser.export build/browser` writes them into that folder.
"""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np

from csac_jax import deploy, grippers
from csac_jax.agent import actor_critic
from csac_jax.config import Config
from csac_jax.constants import CHANGE_AREA
from csac_jax.deploy import decision, onnx
from csac_jax.env import Env, make_env
from csac_jax.evaluation import suites
from csac_jax.robot import primitives
from csac_jax.sim import c_physics, outcome
from csac_jax.vision import camera, heightmap
from csac_jax.world import blocks, model, scene_state
from csac_jax.world.scene_state import SceneState

POLICY = "shipped_clutter"  # its map of 64 cells is fast enough for a browser
STREAM = 606  # of the scenes; no suite and no training has it
DROP = (0.1, 0.25)  # m, sides of dropped piles, as in the preset `fast`
SCENES = 21  # as many of each number of blocks, 4 to 10
_DEFAULT_INPUT = ' input="pos"'  # of a position actuator; MuJoCo 3.14 refuses to read it


def config(cfg: Config) -> Config:
    """Returns the config of the page: dropped blocks, C MuJoCo, one look, the best cell."""
    scene = {"slots": suites.TEN, "min_blocks": 4, "packed_fraction": 0.0, "drop_extent": DROP}
    choice = {"place": "argmax", "augment": False}
    return cfg.change(sim={"physics": "c"}, scene=scene, policy=choice)


def environment() -> tuple[Env, deploy.CameraPolicy]:
    """Makes the page's scenes, at rest, and the policy that it runs."""
    policy = deploy.CameraPolicy.load(POLICY)
    policy = dataclasses.replace(policy, cfg=config(policy.cfg))
    return make_env(policy.cfg, STREAM, SCENES), policy


def scene_at(env: Env, number: int) -> SceneState:
    """Returns one scene of the pool."""
    return jax.tree.map(lambda leaf: leaf[number], env.scenes)


def world(env: Env) -> dict[str, Any]:
    """Returns all that the page's physics and eyes need, as JSON values."""
    scenes = [scene_at(env, number) for number in range(len(env.scenes.target))]
    return {
        "mjcf": model.to_mjcf(env.cfg.scene, env.cfg.sim).replace(_DEFAULT_INPUT, ""),
        "addresses": _addresses(env),
        "robot": _robot(env.cfg),
        "view": _view(env.cfg),
        "judge": _judge(),
        "scenes": [_scene(env, scene) for scene in scenes],
    }


def _addresses(env: Env) -> dict[str, Any]:
    """Returns places in MuJoCo's arrays, of slots [N] and geoms [G]."""
    built = _physics(env).world
    return {
        "slots": built.slots,
        "bodies": built.block_bodies.tolist(),
        "geoms": built.block_geoms.tolist(),
        "slotOfGeom": built.slot_of_geom.tolist(),
        "slotOfPart": built.parts.slot.tolist(),
        "qpos": built.block_qpos[:, 0].tolist(),
        "dofs": built.block_dofs[:, 0].tolist(),
        "robot": built.robot_qpos.tolist(),
        "finger": built.finger_qpos,
        "inertiaFrames": built.model.body_iquat[built.block_bodies].tolist(),
        "parking": _numbers(scene_state.parking(len(built.slots))),
        "parkedHand": model.HAND_PARK_HEIGHT,
    }


def _physics(env: Env) -> c_physics.CPhysics:
    assert isinstance(env.physics, c_physics.CPhysics)
    return env.physics


def _robot(cfg: Config) -> dict[str, Any]:
    """Returns the numbers of the gripper and of both primitives, m and steps."""
    sim, gripper = cfg.sim, grippers.load(cfg.sim.gripper)
    return {
        "timestep": sim.timestep,
        "phases": [sim.push_phases, sim.grasp_phases],
        "approachHeight": sim.approach_height,
        "startGap": primitives.START_GAP,
        "depths": [sim.push_depth, primitives.grasp_depth(sim, gripper)],
        "pushLength": sim.push_length,
        "lowest": primitives.lowest(sim, gripper),
        "radius": gripper.radius,
        "fingerWidth": gripper.fingers.width,
        "half": gripper.half,
        "setPoints": gripper.set_points,
        "positions": gripper.positions,
    }


def _view(cfg: Config) -> dict[str, Any]:
    """Returns the numbers of the view from above and of the dense maps' cells."""
    frames = actor_critic.make(cfg).frames
    return {
        "size": cfg.heightmap.size,
        "extent": cfg.heightmap.extent,
        "from": heightmap.VIEW_HEIGHT,
        "light": camera.LIGHT,
        "ambient": camera.AMBIENT,
        "table": _numbers(blocks.TABLE_COLOUR),
        "colours": _numbers(blocks.COLOURS),
        "yaws": len(frames.yaws),
        "side": frames.side,
        "cell": frames.cell,
        "apart": decision.APART,
    }


def _judge() -> dict[str, Any]:
    return {
        "liftShare": outcome.LIFT_SHARE,
        "gripRise": outcome.GRIP_RISE,
        "bare": outcome.BARE,
        "change": CHANGE_AREA,
        "speed": _numbers(scene_state.SPEED_LIMIT),
    }


def _scene(env: Env, scene: SceneState) -> dict[str, Any]:
    """Returns a scene: poses, colours, and its blocks as fields of MuJoCo's model and as faces."""
    built = _physics(env).world
    fields = jax.device_get(model.scene_fields(built, scene))
    with_blocks = model.with_blocks(built, fields)
    normals, offsets = blocks.half_spaces(built.slots, scene.half_size)
    return {
        "inPlay": scene.in_play.tolist(),
        "colour": scene.colour.tolist(),
        "pose": _numbers(np.concatenate([scene.position, scene.quaternion], axis=1)),
        "fields": {
            "geom_size": _numbers(fields.size),
            "geom_pos": _numbers(fields.centre),
            "geom_rbound": _numbers(fields.rbound),
            "friction": _numbers(fields.friction),
            "body_mass": _numbers(fields.mass),
            "body_inertia": _numbers(fields.inertia),
            "body_ipos": _numbers(fields.com),
            "mesh_vert": _numbers(with_blocks.mesh_vert),
        },
        "faces": [_faces(*part) for part in zip(normals, offsets, strict=True)],
    }


def _faces(normals: Any, offsets: Any) -> list[list[float]]:
    """Returns a part's faces [F, 4]: normal, and offset m."""
    is_face = offsets < blocks.PADDING_OFFSET
    return _numbers(np.column_stack([normals, offsets])[is_face])


def _numbers(values: Any) -> Any:
    """Returns float32 numbers as nested lists, each with the fewest digits that restore it."""
    array = np.asarray(values, np.float32)
    if array.ndim:
        return [_numbers(row) for row in array]
    return float(str(array))


def main(folder: str) -> None:
    """Writes world.json and policy.onnx into a folder."""
    env, policy = environment()
    Path(folder).mkdir(parents=True, exist_ok=True)
    Path(folder, "world.json").write_text(json.dumps(world(env)))
    params = jax.device_get(policy.params)
    Path(folder, "policy.onnx").write_bytes(onnx.serialize(policy.cfg, params))


if __name__ == "__main__":
    main(*sys.argv[1:])
