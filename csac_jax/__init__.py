"""A robot learns to push and grasp in clutter: physics, vision, networks and learner in one JAX
program.

Map, in the direction of data; imports point only backwards along it:

    config      every setting, as frozen dataclasses
    presets     named configs
    geometry    poses, pixels <-> metres
    scene       MJCF -> model and index of ids; block layouts; the pool of settled scenes
    sim         physics, push and grasp primitives, their outcomes
    vision      raycaster, height and colour maps, rotations of maps
    nets        dense Q maps and action proposals
    agent       cross-entropy method, targets, losses, rewards, exploration, update
    replay      ring of transitions and its samplers
    env         reset and step of one scene
    train       the training step, host loop, checkpoints, evaluation
    show        progress and pictures
    cli         the command `csac-jax`, a file per subcommand

Axis letters: E scenes in the batch, B learner batch, N block slots, G geoms, R rays, K rotations, H
W heightmap rows and columns, J CEM candidates, A action dimensions, C replay capacity, S seeds, T
scan time.

Units are SI, angles rad; a name carries its unit only where it is not SI (`_mm`, `_deg`, `_px`).
The frame is the robot base's, moved so that the centre of the workspace on the table is (0, 0, 0),
z up. `T_a_b` maps b to a. Masks say what is true: `valid`, never `mask`.

Importing this package sets environment variables that JAX reads as it starts, see `_guard`: import
it first.
"""

from csac_jax import _guard

__version__ = "0.1.0"

_guard.refuse_broken_jax()
_guard.switch_off_broken_fusion()
_guard.switch_off_broken_partitioner()
_guard.widen_thread_pool()
