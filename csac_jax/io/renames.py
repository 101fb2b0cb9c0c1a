"""Names that recorded files carry, and what they are called today."""

METRICS = {
    "ill": "physics_diverged",
    "left": "blocks_lost",
    "saturated": "contact_overflow",
    "block_left": "block_lost",
    "episode_ill": "episode_physics_diverged",
    "own": "in_distribution",
}
"""Old key -> key of a line of metrics.jsonl or of an evaluation; and the suite of that name."""

SETTINGS = {
    "scene.size_spread": "scene.size_jitter",
    "scene.mesh_spread": "scene.mesh_size_jitter",
    "task.max_idle": "task.max_steps_without_change",
    "cem.spread": "cem.std_estimator",
    "reward.reach": "reward.success_bonus",
    "reward.farthest": "reward.distance_cap",
    "reward.distance": "reward.distance_weight",
    "reward.left": "reward.lost_block_penalty",
    "explore.primitive_start": "explore.epsilon_primitive_start",
    "explore.primitive_end": "explore.epsilon_primitive_end",
    "explore.place_start": "explore.epsilon_place_start",
    "explore.place_end": "explore.epsilon_place_end",
    "learn.rate_end": "learn.lr_final_fraction",
    "learn.copy_every": "learn.target_update_period",
    "replay.floor": "replay.per_epsilon",
    "replay.weight_start": "replay.is_beta_start",
    "replay.weight_end": "replay.is_beta_end",
    "train.warmup": "train.learning_starts",
}
"""Old dotted name -> dotted name of a setting."""
