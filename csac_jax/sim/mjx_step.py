"""A step of MJX's JAX implementation; it departs from `mjx.step` twice, to be nearer to C."""

import jax
import jax.numpy as jnp

from csac_jax.sim.quiet_mjx import mjx

SAME_PLACE = 1e-5  # m; copies lie within 1e-7 m, other points of a pair seldom within 1e-4 m


def step(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Advances one scene by a timestep, by `implicitfast`, without sensors and tendons."""
    data = mjx.fwd_position(model, data)
    contact = data._impl.contact
    # A contact beyond its margin is inactive. The distance stays, since others read it.
    margin = jnp.where(repeated(contact), contact.dist - 1.0, contact.includemargin)
    data = data.tree_replace({"_impl.contact": contact.replace(includemargin=margin)})
    data = mjx.make_constraint(model, data)  # XLA drops the one of `fwd_position`
    data = mjx.fwd_velocity(model, data)
    data = mjx.fwd_actuation(model, data)
    data = mjx.fwd_acceleration(model, data)
    data = mjx.solve(model, data)
    return mjx.implicit(_undamped_at_limits(model, data), data)


def repeated(contact: mjx.Contact) -> jax.Array:
    """Returns [C] bool, a contact repeats the place of an earlier one of the same two geoms.

    MJX fills up to four points for two boxes or meshes with copies, each one more soft constraint:
    a touch at one point would be four times as stiff.
    """
    offset = contact.pos[:, None] - contact.pos[None]  # [C, C, 3]
    same = jnp.all(jnp.abs(offset) < SAME_PLACE, axis=-1)
    same &= jnp.all(contact.geom[:, None] == contact.geom[None], axis=-1)
    return jnp.any(jnp.tril(same, -1), axis=1)


def _undamped_at_limits(model: mjx.Model, data: mjx.Data) -> mjx.Model:
    """Removes the damping of actuators at their force limit, where speed changes no force."""
    force, (low, high) = data.actuator_force, model.actuator_forcerange.T
    limited = model.actuator_forcelimited & ((force <= low) | (force >= high))
    damping = jnp.where(limited, 0.0, model.actuator_biasprm[:, 2])
    return model.replace(actuator_biasprm=model.actuator_biasprm.at[:, 2].set(damping))
