"""A policy as an ONNX graph, written by jax2onnx; onnxruntime runs it without JAX.

Arguments and results are those of `stablehlo.from_maps`, and two more results: `q` [P, K, h, w] and
`cells`, alike, True where an action may begin. The pose is the best cell's, as with
`policy.place argmax`: the search between cells draws random numbers, which ONNX leaves to each
runtime.
"""

import logging
from collections.abc import Callable

import jax
import jax.numpy as jnp
import jax2onnx
from onnx_ir import serde
from onnx_ir.passes import common

from csac_jax.agent import actor_critic, maps, policy
from csac_jax.agent.actor_critic import Params
from csac_jax.config import Config, SmallNet
from csac_jax.deploy import decision_program, stablehlo
from csac_jax.errors import SettingsError
from csac_jax.sim.primitives import Action
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
    model = jax2onnx.to_onnx(
        _decide(cfg, params),
        shapes,
        opset=OPSET,
        return_mode="ir",
        input_names=INPUTS[: len(shapes)],
        output_names=OUTPUTS,
    )
    common.RemoveUnusedNodesPass()(model)
    content: bytes = serde.serialize_model(model).SerializeToString()
    return content


def _decide(cfg: Config, params: Params) -> Callable[..., tuple[jax.Array, ...]]:
    """Returns the policy as a function of maps, in operations that jax2onnx knows: without vmap."""
    frames, has_target = actor_critic.make(cfg).frames, cfg.task.kind == "target"

    def decide(colour: jax.Array, height: jax.Array, *target: jax.Array) -> tuple[jax.Array, ...]:
        marked = target[0] if target else jnp.ones(height.shape, bool)
        obs = Observation(colour, height, marked, decision_program.fingers(cfg))
        state = decision_program.dense_maps(cfg, params, obs, has_target)
        q, valid = state.q, state.valid
        cells = jnp.stack([maps.best_cells(*one, 1)[0] for one in zip(q, valid, strict=True)])
        values = jnp.stack([one.reshape(-1)[cell] for one, cell in zip(q, cells, strict=True)])
        rule = policy.PRIMITIVE_RULES[cfg.policy.primitive]
        primitive = rule(values, jnp.int32(0))
        pose = maps.cell_pose(frames, cells[primitive])
        can_act = jnp.stack([one.any() for one in valid])[primitive]
        stations = decision_program.stations(cfg, height, Action(primitive, pose))
        return primitive, pose, values[primitive], can_act, stations, q, valid

    return decide
