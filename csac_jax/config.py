"""Every setting of a run, as frozen and hashable dataclasses.

Metres, radians and seconds unless a name says otherwise. Numbers marked (ours) are measured, the
others name their source. A `ClassVar` is a constant, no setting. A setting that no preset and no
algorithm turns ends with whom it is for: (for own cameras), (for the study).
"""

import math
from typing import Any, ClassVar, Literal, get_args

from csac_jax.grippers import Gripper
from csac_jax.section import ALTERNATIVES, Section, changed, number, require

SlotKind = Literal["box", "arch", "prism", "half_cylinder", "cylinder", "object"]
RobotKind = Literal["hand", "ur5", "ur5e"]
TaskKind = Literal["clear", "target", "both"]
PhysicsKind = Literal["mjx", "warp", "c", "auto"]
SensorKind = Literal["none", "d415", "d435", "azure_kinect"]
MESH_KINDS: tuple[SlotKind, ...] = ("prism", "half_cylinder", "cylinder")
Pair = tuple[float, float]
MOST_CELLS = 2**24  # of all rotated maps (ours: 20 times the paper's)
TRAY_WALL: Pair = (0.01, 0.05)  # m, thickness and height of a tray's walls (ours)


class SceneConfig(Section, section="scene"):
    """Blocks or objects on the table."""

    drop_height: ClassVar[float] = 0.15  # m, of the first drop (VPG); later ones start above it
    slots: tuple[SlotKind, ...] = ("box", "box", "prism", "box", "cylinder")
    """Kind of each slot. A box slot draws a cube, cuboid, plank or tile in every scene."""
    objects: str = ""
    """Library for slots of kind object: a folder, or procedural[+assemblies]:SEED:COUNT."""
    split: Literal["train", "held_out", "all"] = "train"
    """Objects of the library: those for training, those kept for evaluation, or all (for eval)."""
    min_blocks: int = number(5, 1)  # Fewest blocks in play in a scene; the most is one per slot.
    pool: int = number(1024, 1, 2**20)  # Settled scenes to sample episodes from, per block count.
    packed_fraction: float = number(0.0, 0.0, 1.0)  # Share of packed scenes, not dropped ones.
    certified: tuple[Literal["blocked", "enclosed", "tray", "hidden"], ...] = ()
    """Suites whose scenes for training are the pool, in place of dropped and packed ones."""
    certified_fraction: float = number(1.0, 0.0, 1.0, above=True)
    """Share of these in the pool, each as often as any other; the rest is dropped and packed."""
    size_jitter: Pair = number((0.1, 0.1), 0.0, 0.25)
    """Largest relative change of sizes: boxes and arches; meshes, 0 where `sim.physics` is warp."""
    density: Pair = number((450.0, 900.0), 100.0, 3000.0)  # Densities, kg/m^3 (ours: woods).
    friction: Pair = number((0.5, 1.0), 0.1, 2.0)  # Range of sliding friction, blocks and table.
    drop_extent: Pair = number((0.248, 0.248), 0.05, 0.448)  # Side of a dropped pile, m (VPG).
    settle_time: float = number(2.5, 0.5, 20.0)  # Time for blocks to come to rest, s (ours).
    tray: float = number(0.0, 0.0, 1.0)  # Inner side of a walled tray, m; 0: none (for eval).

    def check(self) -> None:
        most = len(self.slots)
        require(most >= 1, "scene.slots: at least one block slot is needed")
        require(self.min_blocks <= most, f"scene.min_blocks: at most the {most} scene.slots")
        for name in ("density", "friction", "drop_extent"):
            low, high = getattr(self, name)
            require(low <= high, f"scene.{name}: low <= high is needed")
        if self.has_objects:
            require(self.objects != "", "scene.objects: slots of kind object need a library")
        if self.tray:
            widest = self.drop_extent[1]
            require(self.tray >= widest, f"scene.tray: at least scene.drop_extent, {widest:g} m")
            alike = self.packed_fraction == 0.0 or set(self.slots) == {"object"}
            require(alike, "scene.packed_fraction: must be 0 for blocks in a scene.tray")

    @property
    def mixes_certified(self) -> bool:
        """Returns whether certified scenes are a part of the pool."""
        return bool(self.certified) and self.certified_fraction < 1.0

    @property
    def has_objects(self) -> bool:
        """Returns whether some slot holds objects of a library."""
        return "object" in self.slots


class TaskConfig(Section, section="task"):
    """Goal and length of an episode."""

    max_steps_without_change: ClassVar[int] = 10  # actions without visible change that end it (VPG)
    kind: TaskKind = "clear"
    """`clear`: take every block (CSAC sec. 4.2). `target`: get the marked one, again and again.
    `both`: an episode in a fresh scene asks for either, half and half."""
    max_actions: int = number(15, 1)  # Actions after which an episode is cut off.

    @property
    def has_target(self) -> bool:
        """Returns whether an episode may ask for one marked block."""
        return self.kind != "clear"


class SimConfig(Section, section="sim"):
    """Physics and the two motion primitives; both primitives take `substeps` physics steps."""

    timestep: ClassVar[float] = 0.004  # s, of a physics step
    iterations: ClassVar[int] = 12  # Newton iterations; with 5, pads that slip throw blocks (ours)
    line_search: ClassVar[int] = 12  # line-search steps of one Newton iteration (ours)
    approach_height: ClassVar[float] = 0.10  # m above the place, where a primitive starts and ends
    grasp_depth: ClassVar[float] = 0.035  # m, of the finger tips below the surface (VPG: 0.03-0.04)
    push_length: ClassVar[float] = 0.10  # m (VPG)
    push_depth: ClassVar[float] = 0.02  # m, of the tips below the local top (ours)
    physics: PhysicsKind = "mjx"
    """`mjx`: compiled with everything else. `warp`: MJX on NVIDIA's Warp, faster on CUDA, not
    repeatable bit for bit. `c`: C MuJoCo on the host's cores, the reference. `auto`: `c` on a CPU,
    `warp` on one CUDA device where it is known to be faster, else `mjx`, or `c` for objects."""
    robot: RobotKind = "hand"  # The gripper alone, floating; or on that arm (for own arms).
    gripper: str | Gripper = "rg2"
    """`rg2`, `2f85`, `franka_hand`, `wsg32`, or a folder with your own gripper.json and
    gripper.xml. `varied` has another opening and other fingers in every episode."""
    base: tuple[float, float, float, float] = number((0.6, 0.0, 0.35, 0.0), -math.pi, math.pi)
    """Pose of the arm's base: x, y, z, m, and yaw, rad (ours: scenes/README.md; for own arms)."""
    adapter: float = number(0.0, 0.0, 0.3)  # Arm's flange to gripper, m (for own arms).
    clearance: float = number(0.0, 0.0, 0.05)  # Least height of the tips, m; 0: the gripper's.
    opening: Literal["full", "fit"] = "full"
    """Fingers on the way down to a grasp: `full`, open at the place that was decided; `fit`, 10 mm
    beside what the map shows between them, centred on it (ours: robot/fit.py; for eval)."""
    down_force: float = number(20.0, 0.0, 200.0, above=True)
    """Most force of the hand downwards, N; what resists more stops it (ours; for own arms)."""
    approach: Literal["free", "guarded"] = "free"
    """`guarded`: a hand that meets more than `down_force` on its way down goes back, and nothing
    else happens (for own arms)."""
    pad_friction: Pair = number((0.0, 0.0), 0.0, 2.0)
    """Friction of the pads, drawn by episode; 0: the gripper's (for own grippers)."""
    grip_force: Pair = number((0.0, 0.0), 0.0, 200.0)
    """Force of the grip, N, drawn by episode; 0: the gripper's (for own grippers)."""
    grasp_phases: tuple[int, int, int] = number((60, 50, 80), 1, 10**5)  # Steps: down, close, lift.
    geom_pairs: int = number(12, 1, 4096)  # Geom pairs examined per collision function, nearest.
    contacts: int = number(48, 1, 2**16)  # Contacts that MJX and Warp keep per step.

    def check(self) -> None:
        for name in ("pad_friction", "grip_force"):
            low, high = getattr(self, name)
            require(low <= high, f"sim.{name}: low <= high is needed")
            require(low > 0.0 or high == 0.0, f"sim.{name}: both must be above 0, or both 0")

    @property
    def grip_varies(self) -> bool:
        """Returns whether an episode draws the grip's friction or force."""
        return max(self.pad_friction[1], self.grip_force[1]) > 0.0

    @property
    def substeps(self) -> int:
        """Returns the physics steps of one primitive."""
        return sum(self.grasp_phases)

    @property
    def push_phases(self) -> tuple[int, int, int]:
        """Returns the substeps of a push: descend, push, lift; their sum is that of a grasp."""
        vertical = -(-self.substeps * 5 // 19)
        return vertical, self.substeps - 2 * vertical, vertical


class CameraConfig(Section, section="camera"):
    """A pinhole camera, VPG's (for own cameras); pixel centres are whole numbers."""

    size: tuple[int, int] = number((640, 480), 8, 4096)  # Width and height of the image, px.
    focal: Pair = (618.62, 618.62)  # Focal lengths along width and height, px.
    centre: Pair = (319.5, 239.5)  # Optical axis in the image, from left, top, px.
    position: tuple[float, float, float] = (-0.5, 0.0, 0.5)  # Position of the camera, m.
    look_at: tuple[float, float, float] = (0.0, 0.0, 0.0)  # Centre of the level view, m.

    def check(self) -> None:
        image = f"an image of {self.size[0]} x {self.size[1]} px"
        for side, focal, centre in zip(self.size, self.focal, self.centre, strict=True):
            near = abs(centre - 0.5 * (side - 1)) <= 0.1 * side
            off = f"camera.centre: {self.centre} is not near the middle of {image}"
            require(near, f"{off}; give the camera.size that the intrinsics belong to")
            in_range = 0.3 <= focal / side <= 10.0
            require(in_range, f"camera.focal: not 0.3 to 10 times the sides of {image}")
        alike = abs(self.focal[0] / self.focal[1] - 1.0) <= 0.1
        require(alike, f"camera.focal: {self.focal} px must be alike to 10 %")
        apart = math.dist(self.position[:2], self.look_at[:2]) > 1e-3
        require(apart, "camera.position: must not stand straight above or below camera.look_at")


class SensorConfig(Section, section="sensor"):
    """Errors of a real depth camera: those of its `kind`, and the others added to them.

    Depth errors: sigma = floor + square d^2; a structured-light camera has a square of 0.0014
    (Khoshelham and Elberink, Sensors 12, 2012). All but errors of pixels are drawn once a view.
    (for own cameras, the study and the policy `camera`)
    """

    kind: SensorKind = "none"  # Camera to imitate, oblique view; see vision/depth_camera.py.
    depth_noise: Pair = number((0.0, 0.0), 0.0, 0.1)  # Floor, m, and square, 1/m, of depths.
    dropped: float = number(0.0, 0.0, 0.9)  # Probability that a pixel has no depth.
    pose_noise: Pair = number((0.0, 0.0), 0.0, 0.2)  # Sigma of position, m, and orientation, rad.
    intrinsics_noise: Pair = number((0.0, 0.0), 0.0, 0.05)
    """Sigma of the focal lengths and of the optical axis, as shares of the focal length."""
    colour: float = number(0.0, 0.0, 0.5)  # Sigma of the gain of red, green and blue.
    light: float = number(0.0, 0.0, 0.5)  # Sigma of the light's direction and log brightness.
    grey: float = number(0.0, 0.0, 1.0)  # Share of episodes in which every colour is one grey.

    @property
    def active(self) -> bool:
        """Returns whether any error is made."""
        return self != SensorConfig()


class HeightmapConfig(Section, section="heightmap"):
    """The top view: rows along y, columns along x, row 0 and column 0 at the lowest y and x."""

    size: int = number(64, 16, 1024)  # H = W, cells.
    extent: float = number(0.448, 0.1, 1.0)  # Side of the workspace, m (VPG; for own tables).
    view: Literal["ortho", "oblique"] = "ortho"
    """`ortho`: cast from above, complete. `oblique`: points of `camera` (VPG; for own cameras)."""

    @property
    def cell(self) -> float:
        """Returns the side of a cell, m."""
        return self.extent / self.size

    def check(self) -> None:
        require(self.size % 8 == 0, "heightmap.size: must be a multiple of 8")


class _AnyNet(Section, section="net"):
    """Settings of every network."""

    dtype: ClassVar[str] = "auto"  # bfloat16 on accelerators, else float32, as are parameters
    pad_fraction: ClassVar[float]  # rotated maps are about this fraction larger than the workspace
    canvas_step: ClassVar[int]  # their sides are multiples of it: whole cells of the features
    rotations: int = number(16, 4, 360)  # K, yaws of the dense map over a turn (CSAC sec. 3.2).
    colour: bool = True  # See colours, not heights alone (for an ablation).
    head: int = number(32, 4, 4096)  # Channels of the 1 x 1 convolution before each head (VPG 64).

    def canvas(self, size: int) -> int:
        """Returns the cells along a side of the rotated maps of a height map of `size` cells."""
        return round(size * (1.0 + self.pad_fraction) / self.canvas_step) * self.canvas_step


class SmallNet(_AnyNet):
    """Densely connected convolutions with group norm, at 1/`stride` of the map's size (ours)."""

    pad_fraction: ClassVar[float] = 0.125  # cuts corners of turned maps off (ours)
    canvas_step: ClassVar[int] = 4  # whole cells at either stride
    kind: Literal["small"] = "small"  # `densenet121` is the paper's: 100 times the work.
    gripper: bool = False  # See the gripper's opening and the size of its fingers.
    fit: bool = False  # See how the hand would fit at each cell, see `robot.fit.everywhere`.
    mask: bool = False  # See the mask of what is wanted also where all is, as in the task clear.
    growth: int = number(24, 4, 1024)  # Channels that each dense layer adds.
    dilations: tuple[int, ...] = number((1, 2, 4, 1), 1, 64)  # Dilation of each dense layer, 3 x 3.
    stem: int = number(16, 4, 4096)  # Channels of the first convolution.
    stride: Literal[2, 4] = 2  # Input cells per feature cell, each axis; 4: a quarter of the work.
    subpixel: Literal[1, 2, 4] = 1  # Map cells per feature cell, along each axis; at most `stride`.

    def check(self) -> None:
        require(len(self.dilations) >= 1, "net.dilations: at least one layer")
        require(self.subpixel <= self.stride, f"net.subpixel: at most net.stride, {self.stride}")


class DenseNet121(_AnyNet):
    """The paper's (CSAC sec. 3.4): a trunk each for colour, height and target mask, at 1/16."""

    block_layers: ClassVar[tuple[int, int, int, int]] = (6, 12, 24, 16)  # arXiv:1608.06993, table 1
    block_growth: ClassVar[int] = 32  # channels that each dense layer adds (the same)
    gripper: ClassVar[bool] = False  # no trunk sees the gripper
    fit: ClassVar[bool] = False
    mask: ClassVar[bool] = False  # a trunk sees the target's where the task has one
    STRIDE: ClassVar[int] = 32  # pixels of the input per cell of the features, along each axis
    upsample: ClassVar[int] = 2  # pixels of the input per cell of the map, along each axis (VPG)
    canvas_step: ClassVar[int] = STRIDE // upsample  # map cells per cell of the features
    pad_fraction: ClassVar[float] = 0.4286  # keeps every corner: 640 px for 448 (VPG)
    output_stride: ClassVar[int] = 4  # map cells per output cell (ours; paper: 1, 16 x the memory)
    kind: Literal["densenet121"] = "densenet121"  # The paper's network; `small` is ours.
    norm: Literal["group", "batch"] = "group"
    """`batch`, as in the paper, or `group`, which is the same while acting and while learning."""


NetConfig = SmallNet | DenseNet121
ALTERNATIVES["net"] = ("kind", get_args(NetConfig))


class CEMConfig(Section, section="cem"):
    """Cross-entropy method over (x, y, yaw), Algorithm 1 lines 8-13; QT-Opt, arXiv:1806.10293."""

    std: ClassVar[float] = 0.3  # of the first round, in half workspaces (x, y), half turns (ours)
    std_min: ClassVar[float] = 0.01  # least standard deviation of a round, in these units (ours)
    start: ClassVar[str] = "both"  # of the first round: the actor's mean and the best cells
    candidates: int = number(64, 4, 2**16)  # J, actions sampled in a round.
    rounds: int = number(3, 1, 1000)  # Rounds of sampling and fitting.

    @property
    def elites(self) -> int:
        """Returns K, the number of best actions that the next round's distribution is fitted to."""
        return max(4, self.candidates // 10)


class PolicyConfig(Section, section="policy"):
    """Choice of an action from the dense maps."""

    place: Literal["cem", "argmax"] = "cem"  # By the cross-entropy method; or the best cell (VPG).
    primitive: Literal["argmax", "rule", "grasp"] = "argmax"
    """That of larger value; a push after no visible change, else a grasp (sec. 3.4); a grasp."""
    action_mask: Literal["occupied", "none"] = "occupied"
    """Cells where actions may begin: those with something (SPOT); all (CSAC; for the study)."""
    retry_temperature: float = number(0.0, 0.0, 10.0)
    """Temperature, in Q, that each failed grasp in a row adds to the draw of a place (for eval)."""
    height_bonus: float = number(0.0, 0.0, 100.0)
    """Q that each metre of the surface under a cell adds: what lies on top first (for eval)."""
    augment: bool = False
    """Q is the mean over mirror images and critics, at four times the work, unless exploring."""


class TargetConfig(Section, section="target"):
    """TD target, eq. 9 and Algorithm 1 lines 17-19, softmax as in SD3 (arXiv:2010.09177)."""

    inverse_temperature: ClassVar[float] = 20.0  # softmax's beta times the range of returns (ours)
    std: ClassVar[float] = 0.2  # of the noise of target actions, in CEM's units (SD3)
    clip: ClassVar[float] = 0.5  # bound of that noise (SD3)
    samples: ClassVar[int] = 50  # noisy target actions per primitive in the softmax (SD3)
    value: Literal["softmax", "max"] = "softmax"  # V(s'): softmax (line 17) or maximum (eq. 9).
    gamma: float = number(0.5, 0.0, 1.0)  # Discount (VPG).
    bootstrap: Literal["episodic", "continuing"] = "episodic"
    """V(s') is 0 after the end of an episode; or, as in VPG's code, after an action that neither
    changed nor lifted anything, and an episode's end bootstraps from the next one's first state."""

    def check(self) -> None:
        require(self.gamma < 1.0, "target.gamma: must be below 1")


class RewardConfig(Section, section="reward"):
    """Rewards, CSAC eqs. 10-16."""

    distance_cap: ClassVar[float] = 1.0  # m; penalty is constant beyond (ours: bounds returns)
    dead_band: ClassVar[float] = 0.1  # gain of the best grasp that a good push must exceed (ours)
    distance_weight: ClassVar[float] = 0.0  # w: penalty per m from the place to the block (eq. 10)
    push_level: ClassVar[float] = 0.0  # s_c of eq. 13
    grasp_level: ClassVar[float] = 1.0  # s_g of eq. 13, which is s_max
    eta: ClassVar[Pair] = (0.0, 1.0)  # eta_0, eta_1 of eq. 13, without numbers there
    success_bonus: float = 1.0  # r2 of eq. 11: the hand comes back with a block.
    grasp_levels: tuple[float, float, float, float, float] = (-1.0, -0.5, -0.25, 0.0, 1.0)
    """I_g of eq. 15: nothing met, closed on air, block touched, block dropped, block lifted."""
    push_label: Literal["stored", "current_critic", "map_changed"] = "stored"
    """A push is good if the best grasp gains value (eq. 16), judged once as it is made; or judged
    again by the target critic at each replay; or if the map has changed (VPG)."""
    push_levels: Pair = (-1.0, 1.0)  # I_c of eq. 16: any other push, a good push.
    lost_block_penalty: float = number(0.0, 0.0)  # For a block that leaves the workspace (ours).
    outcome_source: Literal["simulator", "sensors"] = "simulator"
    """Judge of grasps: the simulator; or finger gap and maps (sec. 3.3; for the study)."""

    @property
    def relabels(self) -> bool:
        """Returns whether a push is labelled again by the current critic."""
        return self.push_label == "current_critic"

    def check(self) -> None:
        rising = list(self.grasp_levels) == sorted(self.grasp_levels)
        require(rising, "reward.grasp_levels: no level may be below the one before it")
        fits = self.outcome_source == "simulator" or self.lost_block_penalty == 0.0
        fault = "must be 0 where reward.outcome_source is sensors, which cannot see it"
        require(fits, f"reward.lost_block_penalty: {fault}")


class ExploreConfig(Section, section="explore"):
    """Exploration: action noise (Algorithm 1 line 13), random primitive, random place."""

    noise_std: float = number(0.01, 0.0)
    """delta: sigma of the noise in CEM's units, clipped at 3 sigma (ours: 0.03 spoils grasps)."""
    epsilon_primitive: Pair = number((0.5, 0.1), 0.0, 1.0)  # Of a random primitive: from, to (VPG).
    epsilon_place: Pair = number((0.5, 0.0), 0.0, 1.0)  # The same of a random place (ours).
    epsilon_decay: float = number(0.998, 0.0, 1.0, above=True)
    """Factor of both probabilities per action, until they reach their end (ours; VPG 0.9998)."""
    push_fraction: float = number(0.25, 0.0, 1.0)  # Share of pushes among random primitives (ours).


class LearnConfig(Section, section="learn"):
    """Losses and optimiser."""

    gradient_clip: ClassVar[float] = 10.0  # bound of the gradient's global norm (ours)
    huber: ClassVar[float] = 1.0  # width of the quadratic part of the Huber loss (CSAC sec. 4)
    learning_rate: float = number(1e-3, 0.0, above=True)  # Adam's step size, critic (VPG 1e-4).
    actor_learning_rate: float = number(3e-4, 0.0, above=True)  # Adam's step size, actor (ours).
    lr_final_fraction: float = number(0.05, 0.0, 1.0, above=True)
    """Both step sizes fall linearly to this share of themselves over the run (ours)."""
    batch: int = number(32, 1, 2**16)  # B, transitions per update (N of Algorithm 1).
    updates_per_step: int = number(2, 1, 2**16)  # Critic updates per step of all scenes.
    actor_batch: int = number(0, 0)  # Part of the last batch that the actor learns on; 0: all.
    augment: bool = True  # Show each drawn transition under a random symmetry of the square.
    augment_shift: int = number(0, 0, 64)  # Largest shift of a drawn transition, cells.
    critics: Literal[1, 2] = 1  # Of two, each cell's lower Q counts (TD3's twin, arXiv:1802.09477).
    actor: bool = True  # Learn the policy network; without it, mu(s) is read off the critic's map.
    tau: float = number(0.02, 0.0, 1.0, above=True)
    """Share of the online network in a target update (Algorithm 1 lines 24-26); 1 copies."""
    loss: Literal["huber", "squared"] = "huber"  # Huber: CSAC sec. 4; squared: Algorithm 1 line 21.

    def check(self) -> None:
        require(self.actor_batch <= self.batch, "learn.actor_batch: must not exceed learn.batch")


class _AnyReplay(Section, section="replay"):
    """Settings of every replay."""

    capacity: int = number(4096, 2, 2**30)  # C, transitions kept.


class UniformReplay(_AnyReplay):
    """CSAC's replay: all transitions are equally likely."""

    sampler: Literal["uniform"] = "uniform"  # Others: prioritised, beta, opposite.


class PrioritisedReplay(_AnyReplay):
    """CSAC-PER's: probability ~ (abs(TD error) + epsilon)^alpha, weighted (arXiv:1511.05952)."""

    is_beta: ClassVar[Pair] = (0.4, 1.0)  # exponent of the weights, linear from, to
    alpha: ClassVar[float] = 0.6  # 0 is uniform, 1 proportional to the priority (their sec. 4)
    per_epsilon: ClassVar[float] = 0.01  # so that no transition is out of reach (ours)
    sampler: Literal["prioritised"] = "prioritised"  # Others: uniform, beta, opposite.


class BetaReplay(_AnyReplay):
    """CSAC-beta's replay: ranks by abs(TD error), rank / n ~ Beta(a, b), CSAC sec. 3.5."""

    rank_by: ClassVar[str] = "error"  # what is largest at rank 0 (sec. 3.5)
    start: ClassVar[Pair] = (0.5, 0.5)  # (a, b) at first (sec. 4.3)
    middle: ClassVar[Pair] = (1.0, 1.0)  # on the way (sec. 3.5)
    middle_at: ClassVar[float] = 0.4  # share of all updates after which (a, b) is `middle` (ours)
    sampler: Literal["beta"] = "beta"  # Others: uniform, prioritised, opposite.
    end: Pair = number((1.0, 12.0), 0.0, above=True)  # (a, b) in the end (CSAC sec. 4.3).


class OppositeReplay(_AnyReplay):
    """VPG's replay: with each new transition one of its primitive with the opposite outcome."""

    law: ClassVar[Pair] = (1.0, 2.0)  # (a, b) of the ranks (Zeng et al., code)
    sampler: Literal["opposite"] = "opposite"  # Others: uniform, prioritised, beta.


ReplayConfig = UniformReplay | PrioritisedReplay | BetaReplay | OppositeReplay
ALTERNATIVES["replay"] = ("sampler", get_args(ReplayConfig))


class TrainConfig(Section, section="train"):
    """Length and shape of a run."""

    scenes: int = number(8, 1, 2**16)  # E, parallel scenes; each takes an action per training step.
    actions: int = number(2000, 1)  # Actions of the whole run over all scenes.
    learning_starts: int = number(64, 1)  # Actions before the first update.
    chunk: int = number(10, 1, 2**20)  # Training steps per compiled call; logs come between calls.
    save_every: int = number(50, 1)  # Chunks per checkpoint; the last and a stop always save.
    overlap: bool = False  # Learn while Warp moves, from transitions before (for one GPU).

    @property
    def steps(self) -> int:
        """Returns the training steps of the whole run."""
        return math.ceil(self.actions / self.scenes)


class Config(Section):
    """A run: everything that decides its result."""

    preset: str = "quick"  # Name of the preset that this config was made from.
    algo: str = "csac_beta"  # Algorithm that was asked for; the sections say what it is made of.
    seed: int = number(0, 0, 2**31 - 1)  # Number that all randomness follows from (for every run).
    parts: str = ""  # Parts of one's own, see `training.own_parts`; a record, which `train` writes.
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

    @property
    def sees_mask(self) -> bool:
        """Returns whether the networks see the mask of what is wanted."""
        return self.task.has_target or self.net.mask

    def change(self, **sections: Any) -> "Config":
        """Returns a config with other values: `cfg.change(seed=1, learn={"batch": 64})`.

        A dict with another `kind` or `sampler` takes that alternative, which keeps what both have.
        Raises SettingsError for an unknown name or a bad value.
        """
        return changed(self, sections)

    def check(self) -> None:
        may_push = self.policy.primitive != "grasp" or self.explore.push_fraction == 0.0
        require(may_push, "explore.push_fraction: must be 0 where policy.primitive is grasp")
        episodic = not self.reward.relabels or self.target.bootstrap == "episodic"
        require(episodic, "reward.push_label: current_critic needs target.bootstrap episodic")
        batch, starts = self.learn.batch, self.train.learning_starts
        early = f"{batch} transitions cannot be drawn after train.learning_starts = {starts}"
        require(batch <= starts, f"learn.batch: {early}; raise that or lower learn.batch")
        holds = max(self.train.scenes, batch) <= self.replay.capacity
        require(holds, "replay.capacity: must hold train.scenes and learn.batch transitions")
        for name, off in (("pose_noise", 0), ("intrinsics_noise", 0), ("kind", "none")):
            is_off = getattr(self.sensor, name) == getattr(SensorConfig, name)
            fault = f"sensor.{name}: must be {off} where heightmap.view is ortho"
            require(is_off or self.heightmap.view != "ortho", fault)
        size, rotations = self.heightmap.size, self.net.rotations
        most = 2 * math.floor(0.5 * math.pi * size)
        fits = rotations % 2 == 0 and rotations <= most
        require(fits, f"net.rotations: must be even, at most {most} for heightmap.size {size}")
        fits = size**2 * rotations <= MOST_CELLS
        require(fits, f"heightmap.size: its square times net.rotations is above {MOST_CELLS}")
        self._check_tray()
        fits = not self.scene.has_objects or self.sim.physics != "mjx"
        require(fits, "sim.physics: objects that differ between scenes need c, warp or auto")
        scaled = self.scene.size_jitter[1] != 0.0 and set(MESH_KINDS) & set(self.scene.slots)
        fits = self.sim.physics != "warp" or not scaled
        require(fits, "scene.size_jitter: the second must be 0 where sim.physics is warp")

    def _check_tray(self) -> None:
        outside, extent = self.scene.tray + 2.0 * TRAY_WALL[0], self.heightmap.extent
        fits = not self.scene.tray or outside <= extent
        walls = f"with its walls {outside:g} m, does not fit into heightmap.extent, {extent:g} m"
        require(fits, f"scene.tray: {walls}")
