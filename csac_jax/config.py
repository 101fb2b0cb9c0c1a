"""Every setting of a run, as frozen dataclasses; they are hashable.

Lengths are metres, angles radians, times seconds unless a name says otherwise. A value out of range
raises `ValueError` with the setting's name. A section that holds traced values is not checked.
Numbers marked (ours) are measured choices; the others name their source.

Alternatives are unions: `ReplayConfig` and `NetConfig`. Names without a type are constants.
"""

import dataclasses
import math
import typing
from typing import Any, ClassVar, Literal

from csac_jax.grippers import Gripper

SlotKind = Literal["box", "arch", "prism", "half_cylinder", "cylinder", "object"]
RobotKind = Literal["hand", "ur5", "ur5e"]
PhysicsKind = Literal["mjx", "warp", "c", "auto"]
SensorKind = Literal["none", "d415", "d435", "azure_kinect"]
MESH_KINDS: tuple[SlotKind, ...] = ("prism", "half_cylinder", "cylinder")
MOST_ITEMS = 64  # of a setting that is a list (ours: networks and scenes end far below)


_LARGEST = 2**53  # integers up to here are floats too


def _bounded(default: Any, low: float, high: float = math.inf, above: bool = False) -> Any:
    """A field whose numbers lie in low .. high; `above`: low itself is out of range."""
    return dataclasses.field(default=default, metadata={"bounds": (low, high, above)})


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)


@typing.dataclass_transform(frozen_default=True)
class Section:
    """A group of settings, each a frozen dataclass: choices and bounds of its fields are checked
    when it is built."""

    SECTION: ClassVar[str] = ""  # its name in `Config`
    __pydantic_config__: ClassVar[Any] = {"extra": "forbid"}  # unknown keys of a file

    def __init_subclass__(cls, section: str | None = None) -> None:
        cls.SECTION = cls.SECTION if section is None else section
        dataclasses.dataclass(frozen=True)(cls)

    def __post_init__(self) -> None:
        if not _is_plain(self):
            return
        for field in dataclasses.fields(typing.cast(Any, self)):
            value = getattr(self, field.name)
            items = value if isinstance(value, tuple) else (value,)
            _require(
                len(items) <= MOST_ITEMS,
                f"{self.SECTION}.{field.name}: at most {MOST_ITEMS} items, not {len(items)}",
            )
            for item in items:
                if fault := _fault(field, item):
                    raise ValueError(f"{self.SECTION}.{field.name}: {fault}".lstrip("."))
        self.check()

    def check(self) -> None:
        """Raises ValueError for values that do not fit one another."""


def _is_plain(value: Any) -> bool:
    """Whether a value can be checked: a sweep's numbers may be traced."""
    if isinstance(value, Section | tuple):
        return all(map(_is_plain, value if isinstance(value, tuple) else vars(value).values()))
    return isinstance(value, int | float | str | Gripper)


def _fault(field: Any, value: Any) -> str | None:
    """What is wrong with a value of a field, or an item of one; None if nothing is."""
    kind = typing.get_args(field.type)[0] if typing.get_origin(field.type) is tuple else field.type
    choices = typing.get_args(kind)
    if typing.get_origin(kind) is Literal and value not in choices:
        return f"{shown(value)} is not one of: {', '.join(map(str, choices))}"
    low, high, above = field.metadata.get("bounds", (None, None, None))
    if isinstance(value, float) and not math.isfinite(value):
        return f"must be finite, not {value}"
    if low is None or ((low < value if above else low <= value) and value <= high):
        too_large = isinstance(value, int) and abs(value) > _LARGEST
        return f"must be at most {_LARGEST}, not {shown(value)}" if too_large else None
    span = f"must lie in {low:g} .. {high:.10g}"
    if above or high == math.inf:
        most = f", at most {high:.10g}" if high < math.inf else ""
        span = f"must be {'above' if above else 'at least'} {low:g}{most}"
    return f"{span}, not {shown(value)}"


def shown(value: Any) -> str:
    """A value in a message, however long it is."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


class SceneConfig(Section, section="scene"):
    """What lies on the table."""

    drop_height = 0.15  # height of the first drop, m (VPG); later blocks start above it

    slots: tuple[SlotKind, ...] = ("box", "box", "prism", "box", "cylinder")
    """Kind of each slot; a box slot draws a cube, cuboid, plank or tile in every scene, an object
    slot any object of the library."""
    objects: str = ""
    """Library that slots of kind object draw from: a folder, or our own shapes, made:SEED:COUNT, or
    mixed:SEED:COUNT with random assemblies among them."""
    split: Literal["train", "held_out", "all"] = "train"
    """Which of its objects: those for training, those kept for evaluation, or all."""
    min_blocks: int = _bounded(5, 1)  # Fewest blocks in play in a scene; the most is one per slot.
    pool: int = _bounded(1024, 1)  # Pre-settled scenes to sample episodes from, per block count.
    arranged: float = _bounded(0.0, 0.0, 1.0)
    """Share of packed scenes, arranged blocks or objects side by side; the others are dropped."""
    size_jitter: tuple[float, float] = _bounded((0.1, 0.1), 0.0, 0.25)
    """Largest relative change of block sizes between scenes: boxes and arches, and the other kinds.
    The latter are meshes: 0 where `sim.physics` is `warp`, which cannot scale them."""
    density: tuple[float, float] = _bounded((450.0, 900.0), 100.0, 3000.0)
    """Range of block densities, kg/m^3 (ours: woods; about 0.1 kg a block)."""
    friction: tuple[float, float] = _bounded((0.5, 1.0), 0.1, 2.0)
    """Range of the sliding friction between blocks and table."""
    drop_extent: tuple[float, float] = _bounded((0.248, 0.248), 0.05, 0.448)
    """Range of the side of the square that blocks are dropped in, m (VPG: 0.248)."""
    settle_time: float = _bounded(2.5, 0.5, 20.0)  # Time for blocks to come to rest, s (ours).

    def check(self) -> None:
        most = len(self.slots)
        _require(most >= 1, "scene.slots: at least one block slot is needed")
        _require(self.min_blocks <= most, f"scene.min_blocks: at most the {most} scene.slots")
        for name in ("density", "friction", "drop_extent"):
            low, high = getattr(self, name)
            _require(low <= high, f"scene.{name}: low <= high is needed")
        if self.has_objects:
            _require(self.objects != "", "scene.objects: slots of kind object need a library")
            alike = set(self.slots) == {"object"} or self.arranged == 0.0
            _require(alike, "scene.arranged: must be 0 where slots hold objects and blocks")

    @property
    def has_objects(self) -> bool:
        """Some slot holds objects of a library."""
        return "object" in self.slots


class TaskConfig(Section, section="task"):
    """What an episode asks for, and when it is cut off."""

    max_steps_without_change = 10  # actions in a row without visible change that cut it off (VPG)

    kind: Literal["clear", "target"] = "clear"
    """`clear`: take every block (CSAC sec. 4.2). `target`: get one block, marked at random, then
    the next, and another scene where none is left (sec. 4.3)."""
    max_actions: int = _bounded(15, 1)  # Actions after which an episode is cut off.


class SimConfig(Section, section="sim"):
    """Physics and the two motion primitives; both primitives take `substeps` physics steps."""

    timestep = 0.004  # length of a physics step, s
    iterations = 4  # Newton iterations of the constraint solver; fewer break grasps (ours)
    line_search = 8  # line-search steps of one Newton iteration (ours)
    approach = 0.10  # height above the place at which a primitive starts and ends, m
    grasp_depth = 0.035  # how far the finger tips go below the surface, m (VPG: 0.03 to 0.04)
    push_length = 0.10  # length of a push, m (VPG)
    push_depth = 0.02  # how far below the local top the tips push, m (ours)

    physics: PhysicsKind = "mjx"
    """`mjx`: compiled with everything else. `warp`: MJX on NVIDIA's Warp, faster on CUDA, not
    repeatable bit for bit. `c`: C MuJoCo on the host's cores, the reference. `auto`: `c` on a CPU,
    `warp` on one CUDA device where it is known to be faster, else `mjx`, or `c` for objects."""
    robot: RobotKind = "hand"
    """`hand`: the gripper alone, floating, for training. `ur5`, `ur5e`: on that arm."""
    gripper: str | Gripper = "rg2"
    """`rg2`, `2f85`, `franka_hand`, or a folder with gripper.json and gripper.xml of your own.
    `varied` has another opening and other fingers in every episode."""
    base: tuple[float, float, float, float] = _bounded((0.6, 0.0, 0.35, 0.0), -math.pi, math.pi)
    """Where the arm's base stands: x, y and z, m, and its yaw, rad (ours: scenes/README.md)."""
    adapter: float = _bounded(0.0, 0.0, 0.3)
    """Length of what is mounted between the arm's flange and the gripper, m."""
    clearance: float = _bounded(0.0, 0.0, 0.05)
    """Least height of the finger tips above the table, m; 0: the gripper's own."""
    grasp_phases: tuple[int, int, int] = _bounded((60, 50, 80), 1)
    """Substeps of a grasp: descend, close the fingers, lift."""
    geom_pairs: int = _bounded(12, 1)  # Geom pairs examined per collision function, nearest first.
    contacts: int = _bounded(48, 1)  # Contacts that MJX and Warp keep per step.

    @property
    def substeps(self) -> int:
        """Physics steps of one primitive."""
        return sum(self.grasp_phases)

    @property
    def push_phases(self) -> tuple[int, int, int]:
        """Substeps of a push: descend, push, lift; as many in all as of a grasp (ours)."""
        vertical = -(-self.substeps * 5 // 19)
        return vertical, self.substeps - 2 * vertical, vertical


class CameraConfig(Section, section="camera"):
    """A pinhole camera; pixel centres are whole numbers. The default is VPG's."""

    size: tuple[int, int] = _bounded((640, 480), 8, 4096)
    """Width and height of the image that `focal` and `centre` belong to, px."""
    focal: tuple[float, float] = (618.62, 618.62)  # Focal lengths along width and height, px.
    centre: tuple[float, float] = (319.5, 239.5)  # Optical axis in the image, from left, top, px.
    position: tuple[float, float, float] = (-0.5, 0.0, 0.5)  # Where the camera stands, m.
    look_at: tuple[float, float, float] = (0.0, 0.0, 0.0)  # What the level view is centred on, m.

    def scaled(self, share: float) -> "CameraConfig":
        """The same view with fewer pixels: half of VPG's fill a height map of 64 cells.

        Raises ValueError where the image would not have a whole number of pixels.
        """
        size = (round(self.size[0] * share), round(self.size[1] * share))
        whole = math.dist(size, (self.size[0] * share, self.size[1] * share)) < 1e-6
        _require(whole, f"camera: {share} of {self.size} px is not a whole number of pixels")
        focal = (self.focal[0] * share, self.focal[1] * share)
        centre = ((self.centre[0] + 0.5) * share - 0.5, (self.centre[1] + 0.5) * share - 0.5)
        return dataclasses.replace(self, size=size, focal=focal, centre=centre)

    def check(self) -> None:
        image = f"an image of {self.size[0]} x {self.size[1]} px"
        for side, focal, centre in zip(self.size, self.focal, self.centre, strict=True):
            _require(
                abs(centre - 0.5 * (side - 1)) <= 0.1 * side,
                f"camera.centre: {self.centre} is not near the middle of {image}; "
                "give the camera.size that the intrinsics belong to",
            )
            in_range = 0.3 <= focal / side <= 10.0
            _require(in_range, f"camera.focal: not 0.3 to 10 times the sides of {image}")
        alike = abs(self.focal[0] / self.focal[1] - 1.0) <= 0.1
        _require(alike, f"camera.focal: {self.focal} px must be alike to 10 %")
        apart = math.dist(self.position[:2], self.look_at[:2]) > 1e-3
        _require(apart, "camera.position: must not stand straight above or below camera.look_at")


class SensorConfig(Section, section="sensor"):
    """Errors of a real depth camera; `none` and all 0: none, at no cost. Those of a `kind` come
    first, the others are added.

    Depth errors: sigma = floor + square d^2. Khoshelham and Elberink (Sensors 12, 2012, 1437-1454)
    measured a square of 0.0014 for a structured-light camera.
    """

    kind: SensorKind = "none"
    """Camera whose depth images are imitated: noise, steps, holes and mixed pixels. The numbers
    and their sources are in vision/depth_camera.py. It needs an oblique view."""
    depth_noise: tuple[float, float] = _bounded((0.0, 0.0), 0.0, 0.1)
    """Standard deviation of a depth: floor, m, and factor of the squared distance, 1/m."""
    dropped: float = _bounded(0.0, 0.0, 0.9)  # Probability that a pixel has no depth.
    pose_noise: tuple[float, float] = _bounded((0.0, 0.0), 0.0, 0.2)
    """Standard deviation of the camera's place, m, and orientation, rad, drawn in every view."""
    intrinsics_noise: tuple[float, float] = _bounded((0.0, 0.0), 0.0, 0.05)
    """Standard deviation of the focal lengths and of the optical axis, drawn in every view, as
    shares of the focal length."""
    colour: float = _bounded(0.0, 0.0, 0.5)
    """Standard deviation of the gain of red, green and blue, drawn in every view."""
    light: float = _bounded(0.0, 0.0, 0.5)
    """Standard deviation of the light's direction and of the logarithm of its brightness, drawn in
    every view."""

    @property
    def active(self) -> bool:
        """Any error is ever made."""
        return self != SensorConfig()


class HeightmapConfig(Section, section="heightmap"):
    """The top view: rows along y, columns along x, row 0 and column 0 at the lowest y and x."""

    size: int = _bounded(64, 16)  # H = W, cells.
    extent: float = _bounded(0.448, 0.1, 1.0)  # Side of the square workspace, m (VPG).
    view: Literal["ortho", "oblique"] = "ortho"
    """`ortho`: cast from above, complete. `oblique`: points of `camera`'s depth image, projected;
    what blocks hide from it is empty (CSAC sec. 3.2, VPG)."""

    @property
    def cell(self) -> float:
        """Side of a cell, m."""
        return self.extent / self.size

    def check(self) -> None:
        _require(self.size % 8 == 0, "heightmap.size: must be a multiple of 8")


class SmallNet(Section, section="net"):
    """Densely connected convolutions with group norm, at 1/`stride` of the map's size (ours)."""

    dtype = "auto"  # bfloat16 on accelerators, float32 on a CPU; parameters are float32

    kind: Literal["small"] = "small"  # `densenet121` is the paper's: 100 times the work.
    rotations: int = _bounded(16, 4)  # K, yaws of the dense map over a full turn (CSAC sec. 3.2).
    colour: bool = True  # Whether the net sees colours, or heights alone.
    gripper: bool = False  # Whether it sees the gripper's opening and the size of its fingers.
    margin: float = _bounded(0.125, 0.0, 0.5)
    """Rotated maps are this fraction larger than the workspace; sqrt(2) - 1 keeps every corner."""
    head: int = _bounded(32, 4)  # Channels of the 1 x 1 convolution before each head (VPG 64).
    growth: int = _bounded(24, 4)  # Channels that each dense layer adds.
    dilations: tuple[int, ...] = _bounded((1, 2, 4, 1), 1, 64)
    """Dilation of each dense layer, 3 x 3."""
    stem: int = _bounded(16, 4)  # Channels of the first convolution.
    stride: Literal[2, 4] = 2  # Input cells per feature cell, each axis; 4: a quarter of the work.
    subcells: Literal[1, 2, 4] = 1  # Map cells per feature cell, along each axis; at most `stride`.

    def check(self) -> None:
        _require(len(self.dilations) >= 1, "net.dilations: at least one layer")
        _require(self.subcells <= self.stride, f"net.subcells: at most net.stride, {self.stride}")

    def check_canvas(self, size: int) -> None:
        """Raises ValueError if the strides do not divide the rotated maps of `size` cells."""
        side = canvas_size(size, self.margin)
        _require(side % 4 == 0, f"net.margin: rotated maps of {side} cells are not a multiple of 4")


class DenseNet121(Section, section="net"):
    """The paper's (CSAC sec. 3.4): a trunk each for colour, height and target mask, at 1/32."""

    dtype = SmallNet.dtype
    block_layers = (6, 12, 24, 16)  # dense layers of each (Huang et al., arXiv:1608.06993, table 1)
    block_growth = 32  # channels that each dense layer adds (the same)
    gripper = False  # no trunk sees the gripper
    STRIDE = 32  # pixels of the input per cell of the features, along each axis
    output_stride = (
        4  # map cells per cell of the outputs (ours; the paper 1, at 16 times the memory)
    )

    kind: Literal["densenet121"] = "densenet121"  # The paper's network; `small` is ours.
    rotations: int = _bounded(16, 4)  # K, yaws of the dense map over a full turn (CSAC sec. 3.2).
    colour: bool = True  # Whether the net sees colours, or heights alone.
    margin: float = _bounded(0.125, 0.0, 0.5)
    """Rotated maps are this fraction larger than the workspace; sqrt(2) - 1 keeps every corner."""
    head: int = _bounded(32, 4)  # Channels of the 1 x 1 convolution before each head (VPG 64).
    norm: Literal["group", "batch"] = "group"
    """`batch`, as in the paper, or `group`, which is the same while acting and while learning."""
    zoom: int = _bounded(1, 1)  # Pixels of the input per cell of the map, along each axis (VPG 2).

    def check(self) -> None:
        largest = self.STRIDE // self.output_stride
        _require(largest % self.zoom == 0, f"net.zoom: must divide {largest}")

    def check_canvas(self, size: int) -> None:
        """Raises ValueError if the strides do not divide the rotated maps of `size` cells."""
        side, step = canvas_size(size, self.margin), self.STRIDE // self.zoom
        if side % step:
            larger = -(-size // step) * step
            sides = [larger + i * step for i in range(3) if larger + i * step <= 1.5 * size]
            fitting = ", ".join(f"{s / size - 1:.4f} ({s} cells)" for s in sides)
            raise ValueError(
                f"net.margin: DenseNet-121 needs maps of a multiple of {step} cells, not {side}; "
                + (f"try {fitting}" if fitting else f"take another heightmap.size than {size}")
            )


NetConfig = SmallNet | DenseNet121


def canvas_size(size: int, margin: float) -> int:
    """Cells along a side of the rotated maps of a height map of `size` cells."""
    return round(size * (1 + margin) / 2) * 2


class CEMConfig(Section, section="cem"):
    """Cross-entropy method over (x, y, yaw), Algorithm 1 lines 8-13; QT-Opt, arXiv:1806.10293."""

    std = 0.3
    """Standard deviation of the first round, in units of half the workspace (x, y) and half a turn
    (yaw; ours)."""
    std_min = 0.01  # least standard deviation of a round, in the units of `std` (ours)

    candidates: int = _bounded(64, 1)  # J, actions sampled in a round.
    elites: int = _bounded(6, 2)  # K, best actions that the next round's distribution is fitted to.
    rounds: int = _bounded(3, 1)  # Rounds of sampling and fitting.
    start: Literal["both", "actor", "cells"] = "both"
    """W of the first round: about the actor's mean, with the map's best cells among the samples; or
    without those; or about the best cell, with no use of the actor."""

    def check(self) -> None:
        _require(self.elites <= self.candidates, "cem.elites: must not exceed cem.candidates")


class PolicyConfig(Section, section="policy"):
    """How an action is chosen from the dense maps."""

    place: Literal["cem", "argmax"] = "cem"
    """Where: by the cross-entropy method, between cells and yaws, or the best cell (VPG)."""
    primitive: Literal["argmax", "rule", "grasp"] = "argmax"
    """That of larger value; a push after no visible change, else a grasp (sec. 3.4); a grasp."""
    cells: Literal["occupied", "all"] = "occupied"
    """Where actions may begin: where there is something to act on (SPOT); or everywhere (CSAC),
    so that a grasp may meet nothing, eq. 15's lowest level."""
    retry: float = _bounded(0.0, 0.0, 10.0)
    """Temperature, in units of Q, that each failed grasp in a row adds: the next place is drawn by
    it, about by Boltzmann's law, where the policy does not explore anyway. 0: the best place."""
    height_bonus: float = _bounded(0.0, 0.0, 100.0)
    """What each metre of the surface under a cell adds to Q where the policy chooses: what lies on
    top is taken first, so that fewer objects fall from a pile. V(s) does not have it."""
    augment: bool = False
    """Where the policy does not explore, Q is the mean over mirror images of the view and over the
    critics (test-time augmentation), at four times the networks' work."""


class TargetConfig(Section, section="target"):
    """TD target, eq. 9 and Algorithm 1 lines 17-19, softmax as in SD3 (arXiv:2010.09177)."""

    inverse_temperature = 20.0  # beta of the softmax; it is divided by the range of returns (ours)
    std = 0.2  # of the noise of target actions, in CEM's units (SD3)
    clip = 0.5  # bound of that noise (SD3)
    samples = 50  # noisy target actions per primitive in the softmax (SD3)

    value: Literal["softmax", "max"] = "softmax"
    """V(s'): softmax over noisy target actions (line 17), or the dense map's maximum (eq. 9)."""
    gamma: float = _bounded(0.5, 0.0, 1.0)  # Discount (VPG).
    bootstrap: Literal["episodic", "continuing"] = "episodic"
    """Where V(s') is 0: after the end of an episode; or, as in VPG's code, where an action neither
    changed nor lifted anything, and an episode's end bootstraps from the next one's first state."""

    def check(self) -> None:
        _require(self.gamma < 1.0, "target.gamma: must be below 1")


class RewardConfig(Section, section="reward"):
    """Rewards, CSAC eqs. 10-16."""

    distance_cap = 1.0  # m; beyond it the distance's penalty is constant (ours: bounds returns)
    dead_band = 0.1  # gain in the best grasp's value that a good push must exceed (ours)
    distance_weight = 0.0  # w: penalty per metre from the place to the block (eq. 10, sign turned)
    push_level = 0.0  # s_c of eq. 13, the push's level
    grasp_level = 1.0  # s_g of eq. 13, the grasp's level, which is s_max
    eta = (0.0, 1.0)  # eta_0 and eta_1 of eq. 13, for which no numbers are given

    success_bonus: float = 1.0  # r2 of eq. 11: the hand comes back with a block.
    grasp_levels: tuple[float, float, float, float, float] = (-1.0, -0.5, -0.25, 0.0, 1.0)
    """I_g of eq. 15: nothing met, closed on air, block touched, block dropped, block lifted."""
    push_effect: Literal["value", "renewed", "change"] = "value"
    """What makes a push good: the best grasp gains value (eq. 16), judged once as it is made, or
    judged anew by the target critic at each replay; or the map has changed (VPG)."""
    push_levels: tuple[float, float] = (-1.0, 1.0)  # I_c of eq. 16: any other push, a good push.
    lost_block_penalty: float = _bounded(0.0, 0.0)
    """Cost of an action after which a block has left the workspace for good (ours)."""
    source: Literal["truth", "sensed"] = "truth"
    """What tells how a grasp ended: the simulator's contacts and poses, or the finger gap and the
    change of the height map, as on a robot (sec. 3.3). A push is judged by maps in any case."""

    @property
    def renewed(self) -> bool:
        """The label of a push is that of the critic of now."""
        return self.push_effect == "renewed"

    def check(self) -> None:
        rising = list(self.grasp_levels) == sorted(self.grasp_levels)
        _require(rising, "reward.grasp_levels: no level may be below the one before it")
        unseen = "must be 0 where reward.source is sensed, which cannot see it"
        seen = self.source == "truth" or self.lost_block_penalty == 0.0
        _require(seen, f"reward.lost_block_penalty: {unseen}")


class ExploreConfig(Section, section="explore"):
    """Exploration: action noise (Algorithm 1 line 13), random primitive, random place."""

    noise_std: float = _bounded(0.01, 0.0)
    """delta: standard deviation of the action noise, in CEM's units (ours: 0.03 spoils grasps). The
    noise is clipped at three of them (c of line 13, ours)."""
    epsilon_primitive: tuple[float, float] = _bounded((0.5, 0.1), 0.0, 1.0)
    """Probability of a random primitive, at first and in the end (VPG)."""
    epsilon_place: tuple[float, float] = _bounded((0.5, 0.0), 0.0, 1.0)
    """Probability of a random place with something to act on, at first and in the end (ours)."""
    decay: float = _bounded(0.998, 0.0, 1.0, above=True)
    """Factor of both probabilities per action, until they reach their end (ours; VPG 0.9998)."""
    push_fraction: float = _bounded(0.25, 0.0, 1.0)
    """Share of pushes among random primitives (ours)."""


class LearnConfig(Section, section="learn"):
    """Losses and optimiser."""

    gradient_clip = 10.0  # bound of the gradient's global norm (ours)
    huber = 1.0  # width of the quadratic part of the Huber loss (CSAC sec. 4)

    learning_rate: float = _bounded(1e-3, 0.0, above=True)
    """Adam's step size, critic (ours; VPG 1e-4 on a pretrained DenseNet-121, CSAC gives none)."""
    actor_learning_rate: float = _bounded(3e-4, 0.0, above=True)
    """Adam's step size, actor head (ours)."""
    lr_final_fraction: float = _bounded(0.05, 0.0, 1.0, above=True)
    """Both step sizes fall linearly to this share of themselves over the run (ours)."""
    batch: int = _bounded(32, 1)  # B, transitions per update (N of Algorithm 1).
    updates: int = _bounded(2, 1)  # Critic updates per `train.scenes` actions; the actor has one.
    actor_batch: int = _bounded(0, 0)  # Part of the last batch that the actor learns on; 0: all.
    augment: bool = True  # Show each drawn transition under a random symmetry of the square.
    augment_shift: int = _bounded(0, 0, 64)
    """Largest shift of a drawn transition along each axis, cells; none that would cut it off."""
    critics: Literal[1, 2] = 1  # Of two, each cell's lower Q counts (TD3's twin, arXiv:1802.09477).
    actor: bool = True  # Learn the policy network; without it, mu(s) is read off the critic's map.
    tau: float = _bounded(0.02, 0.0, 1.0, above=True)
    """Share of the online network in a target update (Algorithm 1 lines 24-26); 1 copies."""
    loss: Literal["huber", "squared"] = "huber"
    """Of the TD error: Huber (CSAC sec. 4) or squared (Algorithm 1 line 21)."""

    def check(self) -> None:
        _require(self.actor_batch <= self.batch, "learn.actor_batch: must not exceed learn.batch")


class UniformReplay(Section, section="replay"):
    """CSAC's replay: all transitions are equally likely."""

    sampler: Literal["uniform"] = "uniform"
    """`uniform` (CSAC), `prioritised` (CSAC-PER), `beta` (CSAC-beta) or `opposite` (VPG)."""
    capacity: int = _bounded(4096, 2, 2**30)  # C, transitions kept.


class PrioritisedReplay(Section, section="replay"):
    """CSAC-PER's replay: probability ~ (abs(TD error) + epsilon)^alpha, losses weighted against it
    (Schaul et al., arXiv:1511.05952)."""

    is_beta = (0.4, 1.0)  # exponent of the importance weights, linear from .. to (Schaul et al.)
    alpha = 0.6  # 0 is uniform, 1 proportional to the priority (Schaul et al., sec. 4)
    per_epsilon = 0.01  # added to abs(TD error), so that no transition is out of reach (ours)

    sampler: Literal["prioritised"] = "prioritised"
    """`uniform` (CSAC), `prioritised` (CSAC-PER), `beta` (CSAC-beta) or `opposite` (VPG)."""
    capacity: int = _bounded(4096, 2, 2**30)  # C, transitions kept.


class BetaReplay(Section, section="replay"):
    """CSAC-beta's replay: ranks by abs(TD error), rank / n ~ Beta(a, b), CSAC sec. 3.5.

    One law for the whole run: give start, middle and end the same. VPG's is (1, 2).
    """

    middle_at = 0.4  # share of all updates after which (a, b) is `middle` (ours)

    sampler: Literal["beta"] = "beta"
    """`uniform` (CSAC), `prioritised` (CSAC-PER), `beta` (CSAC-beta) or `opposite` (VPG)."""
    capacity: int = _bounded(4096, 2, 2**30)  # C, transitions kept.
    rank_by: Literal["error", "reward"] = "error"
    """Rank 0: the largest abs(TD error) (sec. 3.5) or reward (Algorithm 1 line 15)."""
    start: tuple[float, float] = _bounded((0.5, 0.5), 0.0, above=True)
    """(a, b) at first (CSAC sec. 4.3)."""
    middle: tuple[float, float] = _bounded((1.0, 1.0), 0.0, above=True)
    """(a, b) on the way (sec. 3.5: uniform)."""
    end: tuple[float, float] = _bounded((1.0, 12.0), 0.0, above=True)
    """(a, b) in the end (CSAC sec. 4.3)."""


class OppositeReplay(Section, section="replay"):
    """VPG's replay: with each of the newest transitions one of the same primitive whose outcome was
    the opposite; its rank by abs(TD error) follows Beta(1, 2) (Zeng et al., code, `trainer.py`)."""

    law = (1.0, 2.0)  # (a, b) of the ranks: a power law of exponent 2 (Zeng et al., code)

    sampler: Literal["opposite"] = "opposite"
    """`uniform` (CSAC), `prioritised` (CSAC-PER), `beta` (CSAC-beta) or `opposite` (VPG)."""
    capacity: int = _bounded(4096, 2, 2**30)  # C, transitions kept.


ReplayConfig = UniformReplay | PrioritisedReplay | BetaReplay | OppositeReplay


class TrainConfig(Section, section="train"):
    """Length and shape of a run."""

    scenes: int = _bounded(8, 1)  # E, parallel scenes; each takes one action per training step.
    actions: int = _bounded(2000, 1)  # Actions of the whole run over all scenes.
    learning_starts: int = _bounded(64, 1)  # Actions before the first update.
    chunk: int = _bounded(10, 1)  # Training steps per compiled call; the host logs between calls.
    save_every: int = _bounded(50, 1)  # Chunks per checkpoint; the last and a stop always save.

    @property
    def steps(self) -> int:
        """Training steps of the whole run."""
        return math.ceil(self.actions / self.scenes)


ALTERNATIVES: dict[str, tuple[str, tuple[type[Section], ...]]] = {
    "net": ("kind", (SmallNet, DenseNet121)),
    "replay": ("sampler", (UniformReplay, PrioritisedReplay, BetaReplay, OppositeReplay)),
}
"""Sections that are unions: the field that names the alternative, and the alternatives."""


class Config(Section):
    """A run: everything that decides its result."""

    preset: str = "quick"  # Name of the preset that this config was made from.
    algo: str = "csac_beta"  # Algorithm that was asked for; the sections say what it is made of.
    seed: int = _bounded(0, 0, 2**31 - 1)  # Number that all randomness of the run follows from.
    scene: SceneConfig = SceneConfig()
    task: TaskConfig = TaskConfig()
    sim: SimConfig = SimConfig()
    heightmap: HeightmapConfig = HeightmapConfig()
    camera: CameraConfig = CameraConfig()
    sensor: SensorConfig = SensorConfig()
    net: NetConfig = SmallNet()
    cem: CEMConfig = CEMConfig()
    policy: PolicyConfig = PolicyConfig()
    target: TargetConfig = TargetConfig()
    reward: RewardConfig = RewardConfig()
    explore: ExploreConfig = ExploreConfig()
    learn: LearnConfig = LearnConfig()
    replay: ReplayConfig = BetaReplay()
    train: TrainConfig = TrainConfig()

    def change(self, **sections: Any) -> "Config":
        """A config with other values: `cfg.change(seed=1, learn={"batch": 64})`.

        A dict changes fields of a section, `{"sampler": "uniform"}` its alternative; settings that
        both alternatives have are kept. Raises ValueError for an unknown name or a bad value.
        """
        values = {name: _changed(getattr(self, name, None), new) for name, new in sections.items()}
        return _replaced(self, values)

    def check(self) -> None:
        """Raises ValueError for sections that do not fit one another."""
        may_push = self.policy.primitive != "grasp" or self.explore.push_fraction == 0.0
        _require(may_push, "explore.push_fraction: must be 0 where policy.primitive is grasp")
        _require(
            not self.reward.renewed or self.target.bootstrap == "episodic",
            "reward.push_effect: renewed needs target.bootstrap episodic, by which a transition "
            "ends in the scene that the push left",
        )
        batch, starts = self.learn.batch, self.train.learning_starts
        _require(
            batch <= starts,
            f"learn.batch: {batch} transitions cannot be drawn after train.learning_starts = "
            f"{starts}; raise train.learning_starts or lower learn.batch",
        )
        holds = max(self.train.scenes, batch) <= self.replay.capacity
        _require(holds, "replay.capacity: must hold train.scenes and learn.batch transitions")
        for name, off in (("pose_noise", 0), ("intrinsics_noise", 0), ("kind", "none")):
            is_off = getattr(self.sensor, name) == getattr(SensorConfig, name)
            fits = is_off or self.heightmap.view == "oblique"
            _require(fits, f"sensor.{name}: must be {off} where heightmap.view is ortho")
        size, rotations = self.heightmap.size, self.net.rotations
        most = 2 * math.floor(0.5 * math.pi * size)
        _require(rotations % 2 == 0, "net.rotations: must be even")
        _require(rotations <= most, f"net.rotations: at most {most} for heightmap.size {size}")
        self.net.check_canvas(size)
        fits = not self.scene.has_objects or self.sim.physics != "mjx"
        _require(fits, "sim.physics: objects that differ between scenes need c, warp or auto")
        if self.sim.physics == "warp":
            alike = self.scene.size_jitter[1] == 0.0 or not set(MESH_KINDS) & set(self.scene.slots)
            _require(alike, "scene.size_jitter: the second must be 0 where sim.physics is warp")


def _changed(section: Any, value: Any) -> Any:
    """A section with the fields of a dict, maybe of another alternative; else `value` itself."""
    if not isinstance(value, dict) or not isinstance(section, Section):
        return value
    tag, _ = ALTERNATIVES.get(section.SECTION, ("", ()))
    return _replaced(alternative(section, value[tag]) if tag in value else section, value)


def _replaced(section: Any, values: dict[str, Any]) -> Any:
    for name in values:
        known = name in names(section)
        _require(known, f"{section.SECTION}.{name}: unknown setting".lstrip("."))
    return dataclasses.replace(section, **values)


def alternative(section: Any, choice: str) -> Any:
    """The alternative of that name, with what it shares with `section`."""
    kind = alternative_kind(section.SECTION, choice)
    shared = names(kind) & names(section) - {ALTERNATIVES[section.SECTION][0]}
    return kind(**{name: getattr(section, name) for name in shared})


def alternative_kind(section: str, choice: Any) -> Any:
    """Class of the alternative of that name. Raises ValueError for an unknown one."""
    tag, kinds = ALTERNATIVES[section]
    choices = [getattr(kind, tag) for kind in kinds]
    fault = f"{section}.{tag}: {shown(choice)} is not one of: {', '.join(choices)}"
    _require(choice in choices, fault)
    return kinds[choices.index(choice)]


def names(section: Any) -> set[str]:
    """Names of the settings of a section or of its class."""
    return {field.name for field in dataclasses.fields(section)}
