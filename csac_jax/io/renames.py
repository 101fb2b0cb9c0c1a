"""Names of older files: tables map an old name to the one of today.

Format 1 is everything written before configs had a `format`; format 2 is today's.
"""

FORMAT = 2

METRICS = {
    "left": "blocks_lost",
    "ill": "physics_diverged",
    "saturated": "contact_overflow",
    "block_left": "block_lost",
    "episode_ill": "episode_physics_diverged",
    "own": "in_distribution",
}
"""Keys of metrics.jsonl and of results of `eval --json`, and the suite of that name."""

STATE = {
    "scenes.idle": "scenes.steps_without_change",
    "scenes.noise": "scenes.noise_key",
    "scenes.info.left": "scenes.info.blocks_lost",
    "scenes.info.saturated": "scenes.info.contact_overflow",
    "scenes.info.ill": "scenes.info.physics_diverged",
}
"""Leaves of a checkpoint."""

ADDED = ("scenes.failed_grasps",)
"""Leaves that older checkpoints lack: they are 0 there."""

SETTINGS = {
    "learn.rate_end": "learn.lr_final_fraction",
    "replay.beta_end": "replay.end",
    "replay.beta_middle": "replay.middle",
    "replay.beta_middle_at": "replay.middle_at",
    "replay.beta_start": "replay.start",
    "replay.beta_uniform_at": "replay.middle_at",
    "replay.floor": "replay.per_epsilon",
    "reward.distance": "reward.distance_weight",
    "reward.farthest": "reward.distance_cap",
    "reward.left": "reward.lost_block_penalty",
    "reward.reach": "reward.success_bonus",
    "task.max_idle": "task.max_steps_without_change",
    "train.max_actions": "task.max_actions",
    "train.max_idle": "task.max_steps_without_change",
    "train.warmup": "train.learning_starts",
}
"""Settings of format 1; a number at the end is a place in a tuple."""

_TUPLES = {
    "explore.epsilon_primitive": ("primitive_start", "primitive_end"),
    "explore.epsilon_place": ("place_start", "place_end"),
    "replay.is_beta": ("weight_start", "weight_end"),
    "reward.eta": ("eta0", "eta1"),
    "reward.grasp_levels": ("nothing", "empty", "touched", "dropped", "lifted"),
    "reward.push_levels": ("push_worse", "push_better"),
    "scene.size_jitter": ("size_spread", "mesh_spread"),
    "sensor.depth_noise": ("depth_floor", "depth_square"),
    "sensor.pose_noise": ("position", "rotation"),
}
for name, items in _TUPLES.items():
    section = name.split(".")[0]
    SETTINGS |= {f"{section}.{item}": f"{name}.{place}" for place, item in enumerate(items)}

GONE = {
    "learn.augment_turn": 0.0,
    "net.border": False,
    "policy.mask": True,
    "sim.clearance": 0.012,  # the gripper's now, as is the next
    "sim.window": 0.02,
}
"""Settings of format 1 whose part is gone: a file must hold this value."""

CONSTANTS = ("reward.eta", "reward.distance_weight", "net.block_layers")
"""Settings of format 2 that are constants now: a file must hold their value."""

DROPPED = (
    "cem.spread",
    "cem.std_estimator",
    "target.samples",
    "learn.copy_every",
    "learn.target_update_period",
)
"""Settings that are no more, of which files may hold any values: a policy acts alike without."""

ALGORITHMS = {"vpg": ("vpg_episodic", "bootstrap")}
"""Algorithm that has changed -> its former name now, and the setting of `target` that files which
mean the former one lack."""
