"""A policy as an ONNX graph, written by jax2onnx; onnxruntime runs it without JAX.

Arguments and results are those of `stablehlo.from_maps`, and two more results: `q` [P, K, h, w] and
`cells`, alike, True where an action may begin. The pose is the best cell's, as with
`policy.place argmax`: the search between cells draws random numbers, which ONNX leaves to each
runtime.
"""

import functools
import logging
import operator
from collections.abc import Callable

import jax
import jax.numpy as jnp
import jax2onnx
import numpy as np
from onnx_ir import serde
from onnx_ir.passes import common

from csac_jax.agent import actor_critic, maps, policy
from csac_jax.agent.actor_critic import Params
from csac_jax.agent.maps import Frames
from csac_jax.config import Config, SmallNet
from csac_jax.deploy import decision, stablehlo
from csac_jax.errors import SettingsError
from csac_jax.robot.primitives import Action
from csac_jax.sim.outcome import BARE
from csac_jax.vision.heightmap import Observation

OPSET = 18
INPUTS = ("colour", "height", "target")
OUTPUTS = ("primitive", "pose", "score", "valid", "stations", "q", "cells")


def serialize(cfg: Config, params: Params) -> bytes:
    """Writes the model of a policy. Raises SettingsError for another net than the small one."""
    if not isinstance(cfg.net, SmallNet):
        raise SettingsError("format onnx: knows net.kind small only; take stablehlo")
    shapes = stablehlo.map_shapes(cfg)
    logging.getLogger("onnx_ir").setLevel(logging.ERROR)  # it warns of shapes that nobody reads
    names = {"input_names": INPUTS[: len(shapes)], "output_names": OUTPUTS}
    program = _decide(cfg, params)
    model = jax2onnx.to_onnx(program, shapes, opset=OPSET, return_mode="ir", **names)
    common.RemoveUnusedNodesPass()(model)
    proto = serde.serialize_model(model)
    del proto.graph.value_info[:]  # onnxruntime-web folds constants to other shapes, and refuses
    content: bytes = proto.SerializeToString()
    return content


def _decide(cfg: Config, params: Params) -> Callable[..., tuple[jax.Array, ...]]:
    """Returns the policy as a function of maps, in operations that jax2onnx knows: no vmap of a
    gather, no window of bools."""
    frames, has_target = actor_critic.make(cfg).frames, cfg.task.has_target
    unmasked = cfg.change(policy={"action_mask": "none"})
    rule = policy.PRIMITIVE_RULES[cfg.policy.primitive]

    def decide(colour: jax.Array, height: jax.Array, *target: jax.Array) -> tuple[jax.Array, ...]:
        marked = target[0] if target else jnp.ones(height.shape, bool)
        obs = Observation(colour, height, marked, decision.fingers(cfg))
        q = decision.dense_maps(unmasked, params, obs, has_target).q
        valid = _actionable_cells(frames, obs)
        cells = jnp.stack([maps.best_cells(*one, 1)[0] for one in zip(q, valid, strict=True)])
        values = jnp.stack([one.reshape(-1)[cell] for one, cell in zip(q, cells, strict=True)])
        primitive = rule(values, jnp.int32(0))
        pose = maps.cell_pose(frames, cells[primitive])
        can_act = jnp.stack([one.any() for one in valid])[primitive]
        stations = decision.stations(cfg, height, Action(primitive, pose))
        return primitive, pose, values[primitive], can_act, stations, q, valid

    return decide


def _actionable_cells(frames: Frames, obs: Observation) -> jax.Array:
    """Computes `maps.actionable_cells` by shifts."""
    allowed = jnp.asarray(frames.inside[None] & frames.reachable)
    if frames.all_cells:
        return allowed
    tops = maps.surfaces(frames, obs)
    under, graspable = (maps.cell_heights(frames, top) > BARE for top in tops)
    reach = int(np.ceil(frames.push_length / frames.cell))
    padded = jnp.pad(under, ((0, 0), (1, 1), (0, reach)))
    rows = padded[:, :-2] | padded[:, 1:-1] | padded[:, 2:]
    ahead = functools.reduce(
        operator.or_, [rows[..., shift : shift + frames.side] for shift in range(reach + 1)]
    )
    return jnp.stack([ahead, graspable]) & allowed
