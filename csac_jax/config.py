"""Every setting of a run, as frozen dataclasses: hashable, so that they are closed over by compiled
programs.

Lengths are metres, angles radians, times seconds unless a name says otherwise. A value out of range
raises `ValueError` with the field's name when the config is built. Numbers marked (ours) are
measured choices; the others name their source.
"""

import dataclasses
import math
import typing
from typing import Any, Literal

SlotKind = Literal["box", "arch", "prism", "half_cylinder", "cylinder"]
RobotKind = Literal["hand", "ur5"]
PhysicsKind = Literal["mjx", "warp", "c", "auto"]
MESH_KINDS: tuple[SlotKind, ...] = ("prism", "half_cylinder", "cylinder")
WARP_WORLDS = 4096  # scenes that Warp's contacts, which all of them share, are laid out for
Algo = Literal["csac", "csac_per", "csac_beta", "vpg", "grasp_only", "reactive"]

DENSENET_STRIDE = 32  # pixels of DenseNet-121's input per cell of its features, along each axis


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)


def _is_plain(value: Any) -> bool:
    """Whether a setting, or every one of a section, is a plain value. A sweep traces some numbers:
    their ranges were checked before."""
    if dataclasses.is_dataclass(value):
        return all(_is_plain(getattr(value, field.name)) for field in dataclasses.fields(value))
    return isinstance(value, bool | int | float | str | tuple)


def _require_choices(cfg: Any, section: str) -> None:
    """Every field of a Literal type, or of a tuple of them, has its values: a typing mistake must
    not pass for the other branch."""
    for field in dataclasses.fields(cfg):
        value, kind = getattr(cfg, field.name), field.type
        items, kind = (
            (value, typing.get_args(kind)[0])
            if typing.get_origin(kind) is tuple
            else ((value,), kind)
        )
        if typing.get_origin(kind) is Literal:
            choices = typing.get_args(kind)
            names = ", ".join(map(str, choices))
            for item in items:
                _require(item in choices, f"{section}{field.name}: {item!r} is not one of: {names}")


@dataclasses.dataclass(frozen=True)
class SceneConfig:
    """What lies on the table."""

    slots: tuple[SlotKind, ...] = ("box", "box", "prism", "box", "cylinder")
    """Kind of each block slot; a box slot draws cube, cuboid, plank or tile anew in every scene."""
    min_blocks: int = 5
    """Fewest blocks in play in a scene; the most is the number of slots."""
    pool: int = 1024
    """Distinct scenes at rest per number of blocks that resets draw from; each is turned by a
    random yaw then."""
    arranged: float = 0.0
    """Share of those scenes that are packed arrangements of all levels (`scene.arrange`); the
    others are dropped."""
    size_jitter: float = 0.1
    """Sizes of boxes and arches differ from nominal by up to this share, from scene to scene."""
    mesh_size_jitter: float = 0.1
    """The same of the other kinds, which are meshes: 0 where `sim.physics` is `warp`, which cannot
    scale them."""
    density: tuple[float, float] = (450.0, 900.0)
    """Range of block densities, kg/m^3 (ours: woods; about 0.1 kg a block)."""
    friction: tuple[float, float] = (0.5, 1.0)
    """Range of the sliding friction between blocks and table."""
    drop_extent: tuple[float, float] = (0.248, 0.248)
    """Range of the side of the square in which the blocks of a scene are dropped, m (VPG:
    0.248)."""
    drop_height: float = 0.15
    """Height of the first drop, m (VPG); later blocks of a scene start higher, so that none
    overlap."""
    settle_time: float = 2.5
    """Time the blocks are given to come to rest, s (ours)."""

    def __post_init__(self) -> None:
        _require_choices(self, "scene.")
        _require(len(self.slots) >= 1, "scene.slots: at least one block slot is needed")
        _require(
            1 <= self.min_blocks <= len(self.slots),
            "scene.min_blocks: must lie in 1 .. number of scene.slots",
        )
        _require(self.pool >= 1, "scene.pool: at least one settled scene is needed")
        _require(0.0 <= self.arranged <= 1.0, "scene.arranged: must lie in 0 .. 1")
        for name in ("size_jitter", "mesh_size_jitter"):
            _require(0.0 <= getattr(self, name) <= 0.25, f"scene.{name}: must lie in 0 .. 0.25")
        _require(
            100.0 <= self.density[0] <= self.density[1] <= 3000.0,
            "scene.density: 100 <= low <= high <= 3000 kg/m^3",
        )
        _require(
            0.1 <= self.friction[0] <= self.friction[1] <= 2.0,
            "scene.friction: 0.1 <= low <= high <= 2",
        )
        least, most = self.drop_extent
        _require(
            0.05 <= least <= most <= 0.448,
            "scene.drop_extent: 0.05 <= least <= most <= 0.448 m is needed",
        )
        _require(0.05 <= self.drop_height <= 1.0, "scene.drop_height: must lie in 0.05 .. 1 m")
        _require(0.5 <= self.settle_time <= 20.0, "scene.settle_time: must lie in 0.5 .. 20 s")


@dataclasses.dataclass(frozen=True)
class TaskConfig:
    """What an episode asks for, and when it is cut off."""

    kind: Literal["clear", "target"] = "clear"
    """`clear`: take every block. `target`: get one marked block, then the next one (CSAC sec.
    4.4)."""
    max_actions: int = 15
    """Actions after which an episode is cut off."""
    max_steps_without_change: int = 10
    """Actions in a row without visible change after which an episode is cut off (VPG)."""

    def __post_init__(self) -> None:
        _require_choices(self, "task.")
        _require(self.max_actions >= 1, "task.max_actions: at least 1")
        _require(self.max_steps_without_change >= 1, "task.max_steps_without_change: at least 1")


@dataclasses.dataclass(frozen=True)
class SimConfig:
    """Physics and the two motion primitives; one primitive is `substeps` physics steps, whatever it
    does."""

    physics: PhysicsKind = "mjx"
    """`mjx`: compiled with everything else. `warp`: MJX on NVIDIA's Warp, faster on CUDA, not
    repeatable bit for bit. `c`: C MuJoCo on the host's cores, the reference; the compiled step
    calls it back. `auto`: `c` on a CPU, `warp` on one CUDA device where it is known to be the
    faster one and can do the scene, else `mjx`; a run's config names it."""
    robot: RobotKind = "hand"
    """`hand`: the RG2 by itself, floating, for training. `ur5`: the same hand on the arm."""
    timestep: float = 0.004
    """Length of a physics step, s."""
    grasp_phases: tuple[int, int, int] = (60, 50, 80)
    """Substeps of a grasp: descend, close the fingers, lift."""
    push_phases: tuple[int, int, int] = (50, 90, 50)
    """Substeps of a push: descend, push, lift; their sum is that of `grasp_phases`."""
    iterations: int = 4
    """Newton iterations of the constraint solver; fewer break grasps."""
    line_search: int = 8
    """Line-search steps of one Newton iteration."""
    geom_pairs: int = 12
    """Pairs of geoms examined per collision function, nearest first."""
    contacts: int = 48
    """Contacts kept per step, deepest first."""
    approach: float = 0.10
    """Height above the place at which a primitive starts and ends, m."""
    grasp_depth: float = 0.035
    """How far below the surface seen at the place the finger tips go, m."""
    clearance: float = 0.012
    """Lowest height of the finger tips above the table, m."""
    push_length: float = 0.10
    """Length of a push, m (VPG)."""
    push_depth: float = 0.02
    """How far below the local top the tips push, m."""
    window: float = 0.02
    """Side of the window whose highest surface counts as the local top, m (a finger's width)."""

    @property
    def substeps(self) -> int:
        """Physics steps of one primitive."""
        return sum(self.grasp_phases)

    def __post_init__(self) -> None:
        _require_choices(self, "sim.")
        _require(0.0005 <= self.timestep <= 0.01, "sim.timestep: must lie in 0.0005 .. 0.01 s")
        _require(
            min(*self.grasp_phases, *self.push_phases) >= 1,
            "sim.grasp_phases, push_phases: at least 1 substep each",
        )
        _require(
            sum(self.grasp_phases) == sum(self.push_phases),
            "sim.push_phases: must add up to as many substeps as sim.grasp_phases",
        )
        _require(self.iterations >= 1, "sim.iterations: at least 1")
        _require(self.line_search >= 1, "sim.line_search: at least 1")
        _require(
            self.geom_pairs >= 1 and self.contacts >= 1, "sim.geom_pairs, sim.contacts: at least 1"
        )
        _require(0.02 <= self.approach <= 0.3, "sim.approach: must lie in 0.02 .. 0.3 m")
        _require(0.0 < self.grasp_depth <= 0.05, "sim.grasp_depth: must lie in 0 .. 0.05 m")
        _require(0.0 < self.clearance <= 0.05, "sim.clearance: must lie in 0 .. 0.05 m")
        _require(0.0 < self.push_length <= 0.3, "sim.push_length: must lie in 0 .. 0.3 m")
        _require(0.0 < self.push_depth <= 0.05, "sim.push_depth: must lie in 0 .. 0.05 m")
        _require(0.0 < self.window <= 0.1, "sim.window: must lie in 0 .. 0.1 m")


@dataclasses.dataclass(frozen=True)
class CameraConfig:
    """A pinhole camera; pixel centres are whole numbers. The default is VPG's
    (arXiv:1803.09956)."""

    size: tuple[int, int] = (640, 480)
    """Width and height of the image that `focal` and `centre` belong to, px."""
    focal: tuple[float, float] = (618.62, 618.62)
    """Focal lengths along the image's width and height, px."""
    centre: tuple[float, float] = (319.5, 239.5)
    """Where the optical axis meets the image, from the left and from the top, px."""
    scale: float = 1.0
    """The image is taken at this share of `size`; focal lengths and centre follow. Half fills a map
    of 64 cells, the whole one of 128; with fewer pixels cells far from the camera stay empty."""
    position: tuple[float, float, float] = (-0.5, 0.0, 0.5)
    """Where it stands, m."""
    look_at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Point in the middle of the view, m; the image is level."""

    @property
    def pixels(self) -> tuple[int, int]:
        """Width and height of the image taken, px."""
        return round(self.size[0] * self.scale), round(self.size[1] * self.scale)

    def __post_init__(self) -> None:
        width, height = self.size
        _require(
            min(width, height) >= 16 and max(width, height) <= 4096,
            "camera.size: must lie in 16 .. 4096 px",
        )
        _require(
            0.0 < self.scale <= 1.0 and min(self.pixels) >= 8,
            "camera.scale: 0 < scale <= 1, at least 8 px left",
        )
        _require(
            all(abs(share * self.scale - round(share * self.scale)) < 1e-6 for share in self.size),
            f"camera.scale: {self.scale} of {width} x {height} px is not a whole number of pixels",
        )
        off = max(
            abs(c - 0.5 * (side - 1)) / side for c, side in zip(self.centre, self.size, strict=True)
        )
        _require(
            off <= 0.1,
            f"camera.centre: {self.centre} is not near the middle of an image of {width} x {height} px: these are the "
            "intrinsics of another image size; give camera.size as calibrated and camera.scale for fewer pixels",
        )
        _require(
            all(
                0.3 <= focal / side <= 10.0
                for focal, side in zip(self.focal, self.size, strict=True)
            )
            and abs(self.focal[0] / self.focal[1] - 1.0) <= 0.1,
            f"camera.focal: {self.focal} px does not belong to an image of {width} x {height} px: 0.3 to 10 times its "
            "sides, alike to 10 %",
        )
        _require(
            math.hypot(*(p - q for p, q in zip(self.position[:2], self.look_at[:2], strict=True)))
            > 1e-3,
            "camera.position: must not stand straight above or below camera.look_at",
        )


@dataclasses.dataclass(frozen=True)
class SensorConfig:
    """What a real depth camera gets wrong; all 0: nothing, and then it costs nothing.

    Depth errors: sigma = depth_floor + depth_square d^2. Khoshelham and Elberink (Sensors 12, 2012,
    1437-1454) measured depth_square 0.0014 for a structured-light camera, from disparities half a
    unit off.
    """

    depth_floor: float = 0.0
    """Spread of a depth whatever its distance, m."""
    depth_square: float = 0.0
    """Spread that grows with the squared distance d, 1/m."""
    dropped: float = 0.0
    """Probability that a pixel has no depth."""
    position: float = 0.0
    """Spread of the camera's place about where it is believed to stand, m along each axis, anew in
    every view."""
    rotation: float = 0.0
    """Spread of its orientation, rad about each axis, likewise."""
    colour: float = 0.0
    """Spread of the gain of red, green and blue, likewise."""

    @property
    def active(self) -> bool:
        """Anything is ever wrong."""
        return any(getattr(self, field.name) > 0.0 for field in dataclasses.fields(self))

    def __post_init__(self) -> None:
        bounds = {
            "depth_floor": 0.1,
            "depth_square": 0.1,
            "dropped": 0.9,
            "position": 0.1,
            "rotation": 0.2,
            "colour": 0.5,
        }
        for name, most in bounds.items():
            _require(0.0 <= getattr(self, name) <= most, f"sensor.{name}: must lie in 0 .. {most}")


@dataclasses.dataclass(frozen=True)
class HeightmapConfig:
    """The top view: rows along y, columns along x, row 0 and column 0 at the lowest y and x."""

    size: int = 64
    """H = W, cells."""
    extent: float = 0.448
    """Side of the square workspace, m (VPG)."""
    view: Literal["ortho", "oblique"] = "ortho"
    """`ortho`: cast from above, complete. `oblique`: points of `camera`'s depth image, projected;
    what blocks hide from it is empty (CSAC sec. 3.1, VPG)."""

    @property
    def cell(self) -> float:
        """Side of a cell, m."""
        return self.extent / self.size

    def __post_init__(self) -> None:
        _require_choices(self, "heightmap.")
        _require(
            self.size >= 16 and self.size % 8 == 0,
            "heightmap.size: must be a multiple of 8, at least 16",
        )
        _require(0.1 <= self.extent <= 1.0, "heightmap.extent: must lie in 0.1 .. 1 m")


@dataclasses.dataclass(frozen=True)
class NetConfig:
    """The network over turned maps: a small dense net, or DenseNet-121 (CSAC sec. 3.4), both fully
    convolutional."""

    kind: Literal["small", "densenet121"] = "small"
    """`small`: densely connected, group norm, at 1/`stride` of the map's resolution. `densenet121`:
    a trunk each for colour, height and target mask, at 1/32 of the resolution of its input."""
    rotations: int = 16
    """K, yaws of the dense map over a full turn (CSAC sec. 3.2)."""
    colour: bool = True
    """Whether the net sees colours, or heights alone."""
    margin: float = 0.125
    """Rotated maps are this fraction larger than the workspace; sqrt(2) - 1 keeps every corner."""
    head: int = 32
    """Channels of the 1 x 1 convolution before each head (VPG 64)."""
    growth: int = 24
    """small: channels that each dense layer adds."""
    dilations: tuple[int, ...] = (1, 2, 4, 1)
    """small: dilation of each dense layer's 3 x 3 convolution; their number is the depth."""
    stem: int = 16
    """small: channels of the first convolution."""
    border: bool = False
    """small: one more map, of what is workspace, so that the net sees how near to the border a
    block lies; shifts and turns of drawn transitions (`learn.augment_shift`) then leave out those
    that would show another border than there is."""
    stride: int = 2
    """small: cells of its input per cell of its features, along each axis: 2, or 4 with a quarter
    of the work."""
    subcells: int = 1
    """small: cells of the maps per cell of its features, along each axis: 1, 2 or 4, up to
    `stride`, which gives the height map's resolution."""
    norm: Literal["group", "batch"] = "group"
    """densenet121: `batch`, as in the paper, or `group`, which is the same while acting and while
    learning."""
    block_layers: tuple[int, int, int, int] = (6, 12, 24, 16)
    """densenet121: dense layers of each block (Huang et al., arXiv:1608.06993, table 1)."""
    block_growth: int = 32
    """densenet121: channels that each dense layer adds (same table)."""
    zoom: int = 1
    """densenet121: pixels of its input per cell of the map, along each axis (VPG 2: features lie 16
    cells apart)."""
    output_stride: int = 4
    """densenet121: cells of the map per cell that its outputs are upsampled to (ours; the paper 1,
    at 16 times the memory: what is upsampled is bilinear, and so is reading it)."""
    dtype: Literal["auto", "float32", "bfloat16"] = "auto"
    """What the net computes in, parameters being float32; auto: bfloat16 on accelerators, float32
    on a CPU."""
    weights: str = ""
    """densenet121: .safetensors file with ImageNet weights in torchvision's names that its trunks
    begin with; none if empty."""

    def __post_init__(self) -> None:
        _require_choices(self, "net.")
        _require(
            self.rotations >= 4 and self.rotations % 2 == 0,
            "net.rotations: must be even, at least 4",
        )
        _require(
            min(self.growth, self.stem, self.head) >= 4,
            "net.growth, stem, head: at least 4 channels",
        )
        _require(
            len(self.dilations) >= 1 and min(self.dilations) >= 1,
            "net.dilations: at least one layer, each >= 1",
        )
        _require(0.0 <= self.margin <= 0.5, "net.margin: must lie in 0 .. 0.5")
        _require(self.stride in (2, 4), "net.stride: must be 2 or 4")
        _require(
            self.subcells in (1, 2, self.stride),
            f"net.subcells: must divide net.stride, {self.stride}",
        )
        _require(min(self.block_layers) >= 1, "net.block_layers: at least one layer in each block")
        _require(
            self.block_growth >= 4 and self.block_growth % 4 == 0,
            "net.block_growth: must be a multiple of 4 channels",
        )
        _require(
            self.zoom >= 1
            and self.output_stride >= 1
            and DENSENET_STRIDE % (self.zoom * self.output_stride) == 0,
            f"net.zoom, net.output_stride: their product must divide {DENSENET_STRIDE}, the stride of DenseNet-121",
        )
        _require(
            self.kind == "densenet121" or (self.norm == "group" and not self.weights),
            "net.norm batch, net.weights: only of --net.kind densenet121; the small net has group norm",
        )
        _require(self.kind == "small" or not self.border, "net.border: only of --net.kind small")
        _require(
            not self.weights or self.norm == "batch",
            "net.weights: need --net.norm batch, whose statistics they bring",
        )

    def check_canvas(self, size: int) -> None:
        """Raises ValueError if the strides do not divide the rotated maps of a height map of `size`
        cells."""
        side = round(size * (1 + self.margin) / 2) * 2
        if self.kind == "small":
            _require(
                side % 4 == 0,
                f"net.margin: rotated maps of {side} cells are not a multiple of 4; change it a little",
            )
            return
        step = DENSENET_STRIDE // self.zoom
        if side % step:
            larger = -(-size // step) * step
            sides = [larger + i * step for i in range(3) if larger + i * step <= 1.5 * size]
            fitting = ", ".join(f"{s / size - 1:.4f} ({s} cells)" for s in sides)
            remedy = (
                f"try {fitting}"
                if fitting
                else f"no margin makes it fit; take another heightmap.size than {size}"
            )
            raise ValueError(
                f"net.margin: DenseNet-121 needs maps of a multiple of {step} cells, not {side}; {remedy}"
            )


@dataclasses.dataclass(frozen=True)
class CEMConfig:
    """Cross-entropy method over (x, y, yaw), Algorithm 1 lines 8-13; numbers from QT-Opt,
    arXiv:1806.10293."""

    candidates: int = 64
    """J, actions sampled in a round."""
    elites: int = 6
    """K, best actions that the next round's distribution is fitted to."""
    rounds: int = 3
    """Rounds of sampling and fitting."""
    std: float = 0.3
    """Spread of the first round, in units of half the workspace (x, y) and half a turn (yaw)."""
    std_min: float = 0.01
    """Least spread, same units."""
    std_estimator: Literal["std", "mad"] = "std"
    """How elites' spread is measured: standard deviation, or line 12's mean absolute deviation with
    1 / (K - 1)."""
    start: Literal["both", "actor", "cells"] = "both"
    """W of the first round: about the actor's mean, with the map's best cells among the samples; or
    without those; or about the best cell, with no use of the actor."""

    def __post_init__(self) -> None:
        if not _is_plain(self):
            return
        _require_choices(self, "cem.")
        _require(2 <= self.elites <= self.candidates, "cem.elites: must lie in 2 .. cem.candidates")
        _require(self.rounds >= 1, "cem.rounds: at least 1")
        _require(0.0 < self.std_min <= self.std <= 2.0, "cem.std: 0 < cem.std_min <= cem.std <= 2")


@dataclasses.dataclass(frozen=True)
class PolicyConfig:
    """How an action is chosen from the dense maps."""

    place: Literal["cem", "argmax"] = "cem"
    """Pose of each primitive: the cross-entropy method, between cells and yaws, or the best cell as
    it is (VPG)."""
    primitive: Literal["argmax", "rule", "grasp"] = "argmax"
    """Which primitive: that of larger value; a push after an action without visible change, else a
    grasp (CSAC sec. 3.4); or always a grasp."""
    mask: bool = True
    """Leave out cells with nothing to act on (SPOT, arXiv:1909.04730); else every cell above the
    workspace counts, but for grasps beside the target in the target task."""

    def __post_init__(self) -> None:
        _require_choices(self, "policy.")


@dataclasses.dataclass(frozen=True)
class TargetConfig:
    """TD target, eq. 9 and Algorithm 1 lines 17-19, softmax as in SD3 (arXiv:2010.09177)."""

    value: Literal["softmax", "max"] = "softmax"
    """V(s'): softmax over noisy target actions (line 17), or its limit, the largest value of the
    dense map (eq. 9)."""
    gamma: float = 0.5
    """Discount (VPG)."""
    samples: int = 50
    """Noisy target actions per primitive in the softmax."""
    std: float = 0.2
    """Spread of their noise, in CEM's units."""
    clip: float = 0.5
    """Bound of their noise, same units."""
    inverse_temperature: float = 20.0
    """beta of the softmax for a Q range of 1; divided by the range of possible returns."""

    def __post_init__(self) -> None:
        if not _is_plain(self):
            return
        _require_choices(self, "target.")
        _require(0.0 <= self.gamma < 1.0, "target.gamma: must lie in 0 <= gamma < 1")
        _require(self.samples >= 1, "target.samples: at least 1")
        _require(self.std > 0.0 and self.clip > 0.0, "target.std, target.clip: must be positive")
        _require(
            self.inverse_temperature >= 0.0, "target.inverse_temperature: must not be negative"
        )


@dataclasses.dataclass(frozen=True)
class RewardConfig:
    """Rewards, CSAC eqs. 10-16."""

    success_bonus: float = 1.0
    """r2 of eq. 11: the hand comes back with a block."""
    distance_weight: float = 0.0
    """w: penalty per metre between the place and where the finger tips acted (eq. 10, sign
    turned)."""
    distance_cap: float = 1.0
    """Distance beyond which that penalty grows no more, m (ours: so that returns are bounded)."""
    eta0: float = 0.0
    """eta_0 of eq. 13."""
    eta1: float = 1.0
    """eta_1 of eq. 13."""
    push_level: float = 0.0
    """s_c of eq. 13, the push's level."""
    grasp_level: float = 1.0
    """s_g of eq. 13, the grasp's level, which is s_max."""
    nothing: float = -1.0
    """Grasp that does nothing (eq. 15)."""
    empty: float = -0.5
    """Grasp that closes on air (eq. 15)."""
    touched: float = -0.25
    """Grasp that touches a block but holds none (eq. 15)."""
    dropped: float = 0.0
    """Grasp that holds a block and loses it (eq. 15)."""
    lifted: float = 1.0
    """Grasp that lifts a block (eq. 15)."""
    push_effect: Literal["value", "change"] = "value"
    """What makes a push a good one: that the best grasp is worth more (eq. 16), or that the map has
    changed (VPG)."""
    push_better: float = 1.0
    """Good push (eq. 16)."""
    push_worse: float = -1.0
    """Any other push (eq. 16)."""
    dead_band: float = 0.1
    """Gain in the best grasp's value that a push must exceed (ours)."""
    lost_block_penalty: float = 0.0
    """Loss by an action after which a block has left the workspace, out of reach for good
    (ours)."""

    def __post_init__(self) -> None:
        if not _is_plain(self):
            return
        _require_choices(self, "reward.")
        _require(
            self.distance_weight >= 0.0,
            "reward.distance_weight: a distance must not be a gain, so it must not be negative",
        )
        _require(self.distance_cap > 0.0, "reward.distance_cap: must be positive")
        _require(
            self.push_level <= self.grasp_level,
            "reward.push_level: must not exceed reward.grasp_level, s_max",
        )
        _require(self.dead_band >= 0.0, "reward.dead_band: must not be negative")
        _require(
            self.lost_block_penalty >= 0.0,
            "reward.lost_block_penalty: a block out of reach must not be a gain, so it must not be negative",
        )
        levels = (self.nothing, self.empty, self.touched, self.dropped, self.lifted)
        _require(
            list(levels) == sorted(levels),
            "reward: nothing <= empty <= touched <= dropped <= lifted is needed",
        )


@dataclasses.dataclass(frozen=True)
class ExploreConfig:
    """Exploration: action noise (Algorithm 1 line 13), random primitive, random place."""

    noise_std: float = 0.01
    """delta: spread of the action noise, in CEM's units (ours: 0.03, 7 mm and 5 degrees, already
    spoils grasps)."""
    noise_clip: float = 0.03
    """c: bound of the action noise, same units."""
    epsilon_primitive_start: float = 0.5
    """Probability of a random primitive at first (VPG)."""
    epsilon_primitive_end: float = 0.1
    """Probability of a random primitive in the end (VPG)."""
    epsilon_place_start: float = 0.5
    """Probability of a random place among those with something to act on, at first (ours)."""
    epsilon_place_end: float = 0.0
    """The same, in the end (ours)."""
    decay: float = 0.998
    """Factor of both probabilities per action taken, until they reach their end (ours; VPG
    0.9998)."""
    push_fraction: float = 0.25
    """Share of pushes among random primitives (ours)."""

    def __post_init__(self) -> None:
        if not _is_plain(self):
            return
        for name in (
            "epsilon_primitive_start",
            "epsilon_primitive_end",
            "epsilon_place_start",
            "epsilon_place_end",
            "push_fraction",
        ):
            _require(0.0 <= getattr(self, name) <= 1.0, f"explore.{name}: must be a probability")
        _require(0.0 < self.decay <= 1.0, "explore.decay: must lie in 0 < decay <= 1")
        _require(
            self.noise_std >= 0.0 and self.noise_clip > 0.0,
            "explore.noise_std >= 0 and noise_clip > 0 are needed",
        )


@dataclasses.dataclass(frozen=True)
class LearnConfig:
    """Losses and optimiser."""

    learning_rate: float = 1e-3
    """Adam's step size, critic (ours; CSAC and VPG 1e-4 on a pretrained DenseNet-121)."""
    actor_learning_rate: float = 3e-4
    """Adam's step size, actor head (ours)."""
    lr_final_fraction: float = 0.05
    """Both step sizes fall linearly to this share of themselves over the run (ours)."""
    batch: int = 32
    """B, transitions per update (N of Algorithm 1)."""
    updates: int = 2
    """Updates of the critic per training step, that is, per `train.scenes` actions; the actor has
    one per step."""
    actor_batch: int = 0
    """Transitions of the last of them that the actor's update is made on; 0: all."""
    augment: bool = True
    """Show each drawn transition under a random symmetry of the square."""
    augment_shift: int = 0
    """Largest shift of a drawn transition along each axis, cells; not shifted where that would cut
    something off."""
    augment_turn: float = 0.0
    """Largest turn of a drawn transition about the workspace centre, rad; likewise."""
    critics: int = 1
    """Critics, 1 or 2; of two, the lower Q counts in each cell (TD3's twin, arXiv:1802.09477)."""
    actor: bool = True
    """Learn the policy network; without it, mu(s) is read off the critic's own map."""
    target_update: Literal["soft", "hard"] = "soft"
    """How targets follow: by the share `tau` after each update (lines 24-26), or as a copy now and
    then (sec. 3.4)."""
    tau: float = 0.02
    """Share of the online network in each soft update of the target (Algorithm 1 lines 24-26)."""
    target_update_period: int = 100
    """C, updates between two copies if `target_update` is hard (ours; sec. 3.4 gives no number)."""
    gradient_clip: float = 10.0
    """Bound of the gradient's global norm."""
    loss: Literal["huber", "squared"] = "huber"
    """Of the TD error: Huber (CSAC sec. 4) or squared (Algorithm 1 line 21)."""
    huber: float = 1.0
    """Width of the quadratic part of the Huber loss (CSAC sec. 4)."""

    def __post_init__(self) -> None:
        if not _is_plain(self):
            return
        _require_choices(self, "learn.")
        _require(self.learning_rate > 0.0, "learn.learning_rate: must be positive")
        _require(0 <= self.augment_shift <= 64, "learn.augment_shift: must lie in 0 .. 64 cells")
        _require(0.0 <= self.augment_turn <= math.pi, "learn.augment_turn: must lie in 0 .. pi")
        _require(self.actor_learning_rate > 0.0, "learn.actor_learning_rate: must be positive")
        _require(
            0.0 < self.lr_final_fraction <= 1.0,
            "learn.lr_final_fraction: must lie in 0 < lr_final_fraction <= 1",
        )
        _require(self.batch >= 1 and self.updates >= 1, "learn.batch and learn.updates: at least 1")
        _require(self.actor_batch >= 0, "learn.actor_batch: must not be negative")
        _require(self.critics in (1, 2), "learn.critics: must be 1 or 2")
        _require(0.0 < self.tau <= 1.0, "learn.tau: must lie in 0 < tau <= 1")
        _require(self.target_update_period >= 1, "learn.target_update_period: at least 1 update")
        _require(
            self.gradient_clip > 0.0 and self.huber > 0.0,
            "learn.gradient_clip, learn.huber: must be positive",
        )


@dataclasses.dataclass(frozen=True)
class ReplayConfig:
    """Ring of transitions and how it is sampled."""

    capacity: int = 4096
    """C, transitions kept."""
    sampler: Literal["uniform", "prioritised", "beta"] = "beta"
    """`uniform` is CSAC; `prioritised` CSAC-PER: probability ~ (abs(TD error) + floor)^alpha,
    losses weighted against it; `beta` CSAC-beta (sec. 3.5): ranks by abs(TD error), rank / n ~
    Beta(a, b)."""
    alpha: float = 0.6
    """Prioritised: 0 is uniform, 1 proportional to the priority (Schaul et al., arXiv:1511.05952,
    sec. 4)."""
    per_epsilon: float = 0.01
    """Prioritised: added to abs(TD error), so that no transition is out of reach (ours)."""
    is_beta_start: float = 0.4
    """Prioritised: exponent of the importance weights at first (Schaul et al.), 0 for none."""
    is_beta_end: float = 1.0
    """Prioritised: the same in the end, reached in a straight line (Schaul et al.); 1 takes the
    whole bias away."""
    rank_by: Literal["error", "reward"] = "error"
    """Beta: rank 0 is the largest abs(TD error) (CSAC sec. 3.5) or the largest reward (Algorithm 1
    line 15)."""
    beta_start: tuple[float, float] = (0.5, 0.5)
    """Beta: (a, b) at first (CSAC sec. 4.3). One law for the whole run: give start, middle and end
    the same."""
    beta_middle: tuple[float, float] = (1.0, 1.0)
    """Beta: (a, b) on the way (CSAC sec. 3.5: uniform)."""
    beta_middle_at: float = 0.4
    """Beta: share of all updates after which (a, b) is `beta_middle` (ours)."""
    beta_end: tuple[float, float] = (1.0, 12.0)
    """Beta: (a, b) in the end (CSAC sec. 4.3)."""

    def __post_init__(self) -> None:
        if not _is_plain(self):
            return
        _require_choices(self, "replay.")
        _require(2 <= self.capacity <= 2**30, "replay.capacity: must lie in 2 .. 2^30 transitions")
        _require(0.0 <= self.alpha <= 1.0, "replay.alpha: must lie in 0 .. 1")
        _require(1e-9 <= self.per_epsilon <= 1.0, "replay.per_epsilon: must lie in 1e-9 .. 1")
        for name in ("is_beta_start", "is_beta_end"):
            _require(0.0 <= getattr(self, name) <= 1.0, f"replay.{name}: must lie in 0 .. 1")
        for name in ("beta_start", "beta_middle", "beta_end"):
            _require(min(getattr(self, name)) > 0.0, f"replay.{name}: a and b must be positive")
        _require(0.0 < self.beta_middle_at < 1.0, "replay.beta_middle_at: must lie between 0 and 1")


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """Length and shape of a run."""

    scenes: int = 8
    """E, scenes simulated side by side; each takes one action per training step."""
    actions: int = 2000
    """Actions of the whole run over all scenes."""
    learning_starts: int = 64
    """Actions before the first update."""
    chunk: int = 10
    """Training steps in one call of the compiled program; between calls the host logs, saves and
    stops."""
    save_every: int = 50
    """Chunks between checkpoints; the last chunk and a stop are always saved."""

    @property
    def steps(self) -> int:
        """Training steps of the whole run."""
        return math.ceil(self.actions / self.scenes)

    def __post_init__(self) -> None:
        for name in ("scenes", "actions", "learning_starts", "chunk", "save_every"):
            _require(getattr(self, name) >= 1, f"train.{name}: at least 1")


@dataclasses.dataclass(frozen=True)
class Config:
    """A run: everything that decides its result, together with `seed`."""

    preset: str = "quick"
    """Name of the preset that this config was made from."""
    algo: Algo = "csac_beta"
    """Name of the algorithm that was asked for; what it is made of stands in the sections."""
    seed: int = 0
    """Number that all randomness of the run follows from."""
    scene: SceneConfig = SceneConfig()
    task: TaskConfig = TaskConfig()
    sim: SimConfig = SimConfig()
    heightmap: HeightmapConfig = HeightmapConfig()
    camera: CameraConfig = CameraConfig()
    sensor: SensorConfig = SensorConfig()
    net: NetConfig = NetConfig()
    cem: CEMConfig = CEMConfig()
    policy: PolicyConfig = PolicyConfig()
    target: TargetConfig = TargetConfig()
    reward: RewardConfig = RewardConfig()
    explore: ExploreConfig = ExploreConfig()
    learn: LearnConfig = LearnConfig()
    replay: ReplayConfig = ReplayConfig()
    train: TrainConfig = TrainConfig()

    def __post_init__(self) -> None:
        if not _is_plain(self):
            return
        _require_choices(self, "")
        _require(0 <= self.seed < 2**31, "seed: must lie in 0 .. 2147483647")
        _require(
            self.policy.primitive != "grasp" or self.explore.push_fraction == 0.0,
            "explore.push_fraction: must be 0 where policy.primitive is grasp, which never pushes",
        )
        _require(
            self.learn.actor_batch <= self.learn.batch,
            "learn.actor_batch: must not exceed learn.batch",
        )
        _require(
            self.learn.batch <= self.train.learning_starts,
            f"learn.batch: {self.learn.batch} transitions cannot be drawn after train.learning_starts = {self.train.learning_starts}; "
            "raise train.learning_starts or lower learn.batch",
        )
        _require(
            self.train.scenes <= self.replay.capacity and self.learn.batch <= self.replay.capacity,
            "replay.capacity: must hold train.scenes and learn.batch transitions",
        )
        _require(
            self.sim.physics != "warp"
            or self.scene.mesh_size_jitter == 0.0
            or not set(MESH_KINDS) & set(self.scene.slots),
            "scene.mesh_size_jitter: must be 0 where sim.physics is warp, whose meshes have one size in all scenes",
        )
        _require(
            self.sim.physics != "warp" or self.train.scenes <= WARP_WORLDS,
            f"train.scenes: at most {WARP_WORLDS} where sim.physics is warp",
        )
        _require(
            self.heightmap.view == "oblique" or self.sensor.position == self.sensor.rotation == 0.0,
            "sensor.position, sensor.rotation: must be 0 where heightmap.view is ortho, which has no camera",
        )
        most = 2 * math.floor(0.5 * math.pi * self.heightmap.size)
        _require(
            self.net.rotations <= most,
            f"net.rotations: at most {most} for heightmap.size {self.heightmap.size}: more turn no cell at the rim to "
            "another one",
        )
        self.net.check_canvas(self.heightmap.size)
