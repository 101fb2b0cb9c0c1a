"""Names of older files: each table maps an old name to the one of today.

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

SETTINGS = {
    "cem.spread": "cem.std_estimator",
    "explore.primitive_end": "explore.epsilon_primitive.1",
    "explore.primitive_start": "explore.epsilon_primitive.0",
    "explore.place_end": "explore.epsilon_place.1",
    "explore.place_start": "explore.epsilon_place.0",
    "learn.copy_every": "learn.target_update_period",
    "learn.rate_end": "learn.lr_final_fraction",
    "replay.beta_end": "replay.end",
    "replay.beta_middle": "replay.middle",
    "replay.beta_middle_at": "replay.middle_at",
    "replay.beta_start": "replay.start",
    "replay.beta_uniform_at": "replay.middle_at",
    "replay.floor": "replay.per_epsilon",
    "replay.weight_end": "replay.is_beta.1",
    "replay.weight_start": "replay.is_beta.0",
    "reward.distance": "reward.distance_weight",
    "reward.dropped": "reward.grasp_levels.3",
    "reward.empty": "reward.grasp_levels.1",
    "reward.eta0": "reward.eta.0",
    "reward.eta1": "reward.eta.1",
    "reward.farthest": "reward.distance_cap",
    "reward.left": "reward.lost_block_penalty",
    "reward.lifted": "reward.grasp_levels.4",
    "reward.nothing": "reward.grasp_levels.0",
    "reward.push_better": "reward.push_levels.1",
    "reward.push_worse": "reward.push_levels.0",
    "reward.reach": "reward.success_bonus",
    "reward.touched": "reward.grasp_levels.2",
    "scene.mesh_spread": "scene.size_jitter.1",
    "scene.size_spread": "scene.size_jitter.0",
    "sensor.depth_floor": "sensor.depth_noise.0",
    "sensor.depth_square": "sensor.depth_noise.1",
    "sensor.position": "sensor.pose_noise.0",
    "sensor.rotation": "sensor.pose_noise.1",
    "task.max_idle": "task.max_steps_without_change",
    "train.max_actions": "task.max_actions",
    "train.max_idle": "task.max_steps_without_change",
    "train.warmup": "train.learning_starts",
}
"""Settings of format 1; a number at the end is a place in a tuple."""

GONE = {"learn.augment_turn": 0.0, "net.border": False, "policy.mask": True}
"""Settings of format 1 whose part is gone: a file must hold this value."""
