"""A policy of the small net as an ONNX graph, which onnxruntime runs without JAX.

Arguments and results as `export.from_maps`; besides `q` [P, K, h, w] and `cells`, alike: where
there is something to act on. The pose is the best cell's, as with `policy.place argmax`: the search
between cells draws random numbers, which ONNX leaves to each runtime.
Images are NCHW inside. M = critics, K = yaws, C = canvas, h = cells of a map.
"""

from typing import Any

import jax
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from csac_jax import geometry, grippers
from csac_jax.agent import actor_critic
from csac_jax.agent.actor_critic import Params
from csac_jax.agent.maps import Frames
from csac_jax.config import Config, SmallNet
from csac_jax.constants import Primitive
from csac_jax.deploy import program
from csac_jax.errors import SettingsError
from csac_jax.nets import dense, networks
from csac_jax.sim import primitives
from csac_jax.sim.outcome import BARE

OPSET = 18
OUTPUTS = ("primitive", "pose", "score", "valid", "stations", "q", "cells")
_BACKWARDS = np.iinfo(np.int64).min


class Graph:
    """Nodes in the order of their making; values are their names."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: dict[Any, Any] = {}  # by type, shape and content

    def const(self, value: Any, dtype: Any = np.float32) -> str:
        """A constant array."""
        array = np.asarray(value, dtype)
        key = (array.dtype, array.shape, array.tobytes())
        if key not in self.constants:
            self.constants[key] = numpy_helper.from_array(array, f"c{len(self.constants)}")
        name: str = self.constants[key].name
        return name

    def op(self, kind: str, *inputs: str, **attributes: Any) -> str:
        """The first output of an operation."""
        name = f"v{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, inputs, [name], **attributes))
        return name

    def reshape(self, value: str, *shape: int) -> str:
        """The array in another shape; -1 is what is left, 0 as it was."""
        return self.op("Reshape", value, self.const(shape, np.int64))

    def clip(self, value: str, low: float, high: float) -> str:
        """The array within bounds."""
        return self.op("Clip", value, self.const(low), self.const(high))

    def to_float(self, value: str) -> str:
        """The array as float32."""
        return self.op("Cast", value, to=TensorProto.FLOAT)


def make(cfg: Config, params: Params) -> bytes:
    """The model of a policy. Raises SettingsError for another net."""
    if not isinstance(cfg.net, SmallNet):
        raise SettingsError("--format onnx: knows --net.kind small only; take stablehlo")
    graph, frames = Graph(), actor_critic.make(cfg).frames
    has_target = frames.shows_target
    variables = jax.device_get(params.critic)["params"]
    q = _q_maps(graph, cfg.net, frames, variables, cfg)
    valid = _valid(graph, frames, has_target)
    primitive, cell, score, is_valid = _best(graph, cfg, q, valid)
    poses = np.concatenate(
        [frames.xy, np.broadcast_to(frames.yaws[:, None, None, None], (*frames.inside.shape, 1))],
        axis=-1,
    )
    pose = graph.op("Gather", graph.const(poses.reshape(-1, 3)), cell)
    results = (primitive, pose, score, is_valid, _stations(graph, cfg, primitive, pose), q, valid)
    for name, value in zip(OUTPUTS, results, strict=True):
        graph.nodes.append(helper.make_node("Identity", [value], [name]))
    return _model(graph, cfg, frames, has_target)


def _model(graph: Graph, cfg: Config, frames: Frames, has_target: bool) -> bytes:
    size, side = cfg.heightmap.size, frames.side
    yaws = len(frames.yaws)
    inputs = {"colour": (TensorProto.FLOAT, [size, size, 3])}
    inputs["height"] = (TensorProto.FLOAT, [size, size])
    if has_target:
        inputs["target"] = (TensorProto.BOOL, [size, size])
    number, q_shape = TensorProto.FLOAT, [len(Primitive), yaws, side, side]
    outputs: dict[str, tuple[int, list[int]]] = {
        "primitive": (TensorProto.INT32, []),
        "pose": (number, [3]),
        "score": (number, []),
        "valid": (TensorProto.BOOL, []),
        "stations": (number, [4, 5]),
        "q": (number, q_shape),
        "cells": (TensorProto.BOOL, q_shape),
    }
    given, made = (
        [helper.make_tensor_value_info(name, *kind) for name, kind in ports.items()]
        for ports in (inputs, outputs)
    )
    constants = list(graph.constants.values())
    whole = helper.make_graph(graph.nodes, "policy", given, made, constants)
    model = helper.make_model(
        whole, producer_name="csac_jax", opset_imports=[helper.make_opsetid("", OPSET)]
    )
    model.ir_version = 10
    onnx.checker.check_model(model, full_check=True)
    content: bytes = model.SerializeToString()
    return content


def _rotated(graph: Graph, frames: Frames, maps: str, channels: int) -> str:
    """Maps [H, W, ch] in the first K / 2 frames, [K / 2, C, C, ch]; see `rotate.rotate`."""
    table, canvas = frames.tables, frames.tables.canvas
    flat = graph.reshape(maps, -1, channels)
    picked = graph.op("Gather", flat, graph.const(table.index, np.int32))
    kept = graph.op("Mul", picked, graph.const(table.valid[..., None]))
    return graph.reshape(kept, -1, canvas, canvas, channels)


def _inputs(graph: Graph, frames: Frames, fingers: Any) -> tuple[str, int]:
    """The net's input maps [H, W, I] and I; see `Networks.inputs`."""
    nets = frames.networks
    side = round(frames.extent / frames.tables.cell)
    column = graph.reshape("height", side, side, 1)
    above = graph.op("Relu", column)
    maps = [graph.op("Div", above, graph.const(nets.height_scale))]
    if nets.colour:
        mean, std = (np.broadcast_to(scale, 3) for scale in nets.colour_scale)
        scaled = graph.op("Div", graph.op("Sub", "colour", graph.const(mean)), graph.const(std))
        covered = graph.op("Greater", column, graph.const(networks.BARE))
        maps.insert(0, graph.op("Where", covered, scaled, graph.const(0.0)))
    if fingers is not None:
        own = (np.asarray(fingers) - networks.FINGERS_MEAN) / networks.FINGERS_STD
        maps.append(graph.const(np.broadcast_to(own, (side, side, 3))))
    if frames.shows_target:
        maps.append(graph.to_float(graph.reshape("target", side, side, 1)))
    channels = 1 + 3 * (nets.colour + (fingers is not None)) + frames.shows_target
    return graph.op("Concat", *maps, axis=-1), channels


def _q_maps(graph: Graph, net: SmallNet, frames: Frames, variables: Any, cfg: Config) -> str:
    """Q [P, K, h, w] to decide by, see `values.decision_maps`."""
    maps, channels = _inputs(graph, frames, program.fingers(cfg))
    rotated = _rotated(graph, frames, maps, channels)
    image = graph.op("Transpose", rotated, perm=[0, 3, 1, 2])
    num = len(jax.tree.leaves(variables)[0])
    of_each = [jax.tree.map(lambda leaf, m=m: np.asarray(leaf[m]), variables) for m in range(num)]
    if cfg.policy.augment:
        q = _mirrored(graph, net, image, of_each)
    else:
        q = graph.op("Min", *(_critic(graph, net, image, each) for each in of_each))
    ahead, back, grasp = (  # of [K / 2, OUTPUTS, h, w]
        graph.op("Gather", q, graph.const(output, np.int64), axis=1)
        for output in range(dense.OUTPUTS)
    )
    every = [_all_frames(graph, ahead, back), _all_frames(graph, grasp, grasp)]
    if cfg.policy.height_bonus:
        top = graph.op("Squeeze", _cell_heights(graph, frames, "height"), _axes(graph, 1))
        bonus = graph.op("Mul", top, graph.const(cfg.policy.height_bonus))
        every = [graph.op("Add", q, bonus) for q in every]
    return graph.op("Concat", *(graph.op("Unsqueeze", q, _axes(graph, 0)) for q in every), axis=0)


def _mirrored(graph: Graph, net: SmallNet, image: str, of_each: list[Any]) -> str:
    """Q [K / 2, OUTPUTS, h, w], see `networks.apply_mirrored`; the mean of the critics."""
    parts = []
    for axes in networks.MIRRORS:
        shown = _flipped(graph, image, axes)
        for variables in of_each:
            q = _flipped(graph, _critic(graph, net, shown, variables), axes)
            order = graph.const(networks.AHEAD_AND_BACK, np.int64)
            parts.append(graph.op("Gather", q, order, axis=1) if 3 in axes else q)
    return graph.op("Mean", *parts)


def _flipped(graph: Graph, value: str, axes: tuple[int, ...]) -> str:
    """The array turned round along axes."""
    if not axes:
        return value
    last, end, step = ([number] * len(axes) for number in (-1, _BACKWARDS, -1))
    bounds = _axes(graph, *last), _axes(graph, *end), _axes(graph, *axes), _axes(graph, *step)
    return graph.op("Slice", value, *bounds)


def _axes(graph: Graph, *axes: int) -> str:
    return graph.const(axes, np.int64)


def _all_frames(graph: Graph, ahead: str, back: str) -> str:
    """See `maps._all_frames`: [K / 2, h, w] twice -> [K, h, w]."""
    return graph.op("Concat", ahead, _flipped(graph, back, (1, 2)), axis=0)


def _critic(graph: Graph, net: SmallNet, image: str, variables: Any) -> str:
    """Q [N, OUTPUTS, h, w] of `dense.Critic`."""
    trunk, head = variables["trunk"], variables["head"]
    strides, dilations = (net.stride, *[1] * len(net.dilations)), (1, *net.dilations)
    features = ""
    for layer, (stride, dilation) in enumerate(zip(strides, dilations, strict=True)):
        kernel = trunk[f"Convolution_{layer}"]["kernel"]
        pad = dilation * (kernel.shape[0] - stride) // 2
        new = graph.op(
            "Conv",
            features or image,
            graph.const(kernel.transpose(3, 2, 0, 1)),
            strides=[stride] * 2,
            dilations=[dilation] * 2,
            pads=[pad] * 4,
        )
        new = graph.op("Relu", _group_norm(graph, new, trunk[f"GroupNorm_{layer}"]))
        features = graph.op("Concat", features, new, axis=1) if features else new
    hidden = graph.op("Relu", _dense(graph, features, head["Dense_0"]))
    cells = _dense(graph, hidden, head["Dense_1"])
    return graph.op("DepthToSpace", cells, blocksize=net.subcells, mode="DCR")


def _dense(graph: Graph, features: str, layer: Any) -> str:
    """A dense layer in every cell, as a convolution of 1 x 1."""
    kernel = graph.const(layer["kernel"].T[:, :, None, None])
    return graph.op("Conv", features, kernel, graph.const(layer["bias"]))


def _group_norm(graph: Graph, maps: str, layer: Any) -> str:
    """`dense.GroupNorm`, as an instance norm of groups as rows."""
    groups = dense.num_groups(len(layer["scale"]))
    rows = graph.op("Reshape", maps, graph.const((0, groups, -1), np.int64))
    one, zero = graph.const(np.ones(groups)), graph.const(np.zeros(groups))
    normal = graph.op("InstanceNormalization", rows, one, zero, epsilon=dense.EPSILON)
    back = graph.op("Reshape", normal, graph.op("Shape", maps))
    scale, bias = (graph.const(layer[name][:, None, None]) for name in ("scale", "bias"))
    return graph.op("Add", graph.op("Mul", back, scale), bias)


def _valid(graph: Graph, frames: Frames, has_target: bool) -> str:
    """Cells where an action may begin, [P, K, h, w] bool; see `maps.actionable_cells`."""
    if frames.all_cells:
        return graph.const(frames.inside[None] & frames.reachable, bool)
    under = _above_bare(graph, frames, "height")
    graspable = under
    if has_target:
        marked = graph.op("Mul", "height", graph.to_float("target"))
        graspable = _above_bare(graph, frames, marked)
    reach = int(np.ceil(frames.push_length / frames.cell))
    near = graph.op("MaxPool", under, kernel_shape=[3, reach + 1], pads=[1, 0, 1, reach])
    both = graph.op("Concat", near, graspable, axis=1)  # [K, P, h, w], 0 or 1
    allowed = np.swapaxes(frames.inside[None] & frames.reachable, 0, 1)  # [K, P, h, w]
    inside = graph.op("Mul", both, graph.const(allowed))
    first = graph.op("Transpose", inside, perm=[1, 0, 2, 3])
    return graph.op("Cast", first, to=TensorProto.BOOL)


def _above_bare(graph: Graph, frames: Frames, height: str) -> str:
    """1 where the map [H, W] m is higher than BARE, else 0: [K, 1, h, w] float32."""
    top = _cell_heights(graph, frames, height)
    return graph.to_float(graph.op("Greater", top, graph.const(BARE)))


def _cell_heights(graph: Graph, frames: Frames, height: str) -> str:
    """See `maps.cell_heights`: [K, 1, h, w] m."""
    rotated = graph.op("Transpose", _rotated(graph, frames, height, 1), perm=[0, 3, 1, 2])
    stride = frames.networks.stride
    top = graph.op("MaxPool", rotated, kernel_shape=[stride] * 2, strides=[stride] * 2)
    halves = graph.op("Squeeze", top, _axes(graph, 1))
    return graph.op("Unsqueeze", _all_frames(graph, halves, halves), _axes(graph, 1))


def _best(graph: Graph, cfg: Config, q: str, valid: str) -> tuple[str, str, str, str]:
    """Primitive [] int32, flat index [] of the best cell, its Q [] and whether it is valid []."""
    num = len(Primitive)
    flat, mask = graph.reshape(q, num, -1), graph.reshape(valid, num, -1)
    any_valid = graph.op("ReduceMax", graph.to_float(mask), _axes(graph, 1), keepdims=1)
    nowhere = graph.op("Equal", any_valid, graph.const(0.0))
    allowed = graph.op("Or", mask, nowhere)
    masked = graph.op("Where", allowed, flat, graph.const(-np.inf))
    cells = graph.op("ArgMax", masked, axis=1, keepdims=0)
    values = graph.op("ReduceMax", masked, _axes(graph, 1), keepdims=0)
    if cfg.policy.primitive == "argmax":
        chosen = graph.op("ArgMax", values, axis=0, keepdims=0)
    else:  # `rule` too grasps where nothing is known of the last action
        chosen = graph.const(int(Primitive.GRASP), np.int64)
    found = graph.op("Cast", graph.reshape(any_valid, num), to=TensorProto.BOOL)
    cell, score, is_valid = (graph.op("Gather", each, chosen) for each in (cells, values, found))
    return graph.op("Cast", chosen, to=TensorProto.INT32), cell, score, is_valid


def _stations(graph: Graph, cfg: Config, primitive: str, pose: str) -> str:
    """Set-points [4, 5]; see `program.stations` and `primitives.plan`."""
    sim, limit, gripper = cfg.sim, 0.5 * cfg.heightmap.extent, grippers.load(cfg.sim.gripper)
    grasp = graph.op("Equal", primitive, graph.const(int(Primitive.GRASP), np.int32))

    def choose(of_grasp: str, of_push: str) -> str:
        return graph.op("Where", grasp, of_grasp, of_push)

    def value(number: float) -> str:
        return graph.const([number])

    xy = graph.op("Slice", pose, _axes(graph, 0), _axes(graph, 2))
    yaw = graph.op("Slice", pose, _axes(graph, 2), _axes(graph, 3))
    depth = choose(value(primitives.grasp_depth(sim, gripper)), value(sim.push_depth))
    surface = _local_top(graph, cfg, xy, gripper.finger[1])
    low = graph.op("Max", graph.op("Sub", surface, depth), value(primitives.lowest(sim, gripper)))
    around = _local_top(graph, cfg, xy, 2.0 * gripper.radius)
    clear = graph.op("Add", around, value(primitives.START_GAP))
    high = graph.op("Max", graph.op("Add", low, value(sim.approach)), clear)
    along = graph.op("Concat", graph.op("Cos", yaw), graph.op("Sin", yaw), axis=0)
    way = graph.op("Mul", along, value(sim.push_length))
    end = choose(xy, graph.clip(graph.op("Add", xy, way), -limit, limit))
    closed, opened = map(value, gripper.half)
    opening = choose(opened, closed)
    rows = [(xy, high, yaw, opening), (xy, low, yaw, opening)]
    rows += [(end, low, yaw, closed), (end, high, yaw, closed)]
    return graph.reshape(graph.op("Concat", *(part for row in rows for part in row), axis=0), 4, 5)


def _local_top(graph: Graph, cfg: Config, xy: str, side: float) -> str:
    """Highest surface [1] m in a window about `xy` [2]; see `primitives.local_top`."""
    centres = np.asarray(geometry.cell_centres(cfg.heightmap))
    off = graph.op("Abs", graph.op("Sub", graph.const(centres), xy))
    far = graph.op("ReduceMax", off, _axes(graph, 2), keepdims=0)
    reach = graph.const(0.5 * max(side, cfg.heightmap.cell))
    near = graph.op("LessOrEqual", far, reach)
    inside = graph.op("Where", near, "height", graph.const(0.0))
    return graph.reshape(graph.op("ReduceMax", inside, _axes(graph, 0, 1), keepdims=0), 1)
