"""All substeps of a primitive in many scenes, as one call on MuJoCo Warp's own arrays.

Model and data of E scenes stay on the device; a call copies in fields of the blocks, state and
set-points. On CUDA several substeps are one recorded graph.
"""

import copy
import inspect
import math
import threading
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import mujoco
import numpy as np
import warp as wp
from mujoco.mjx.third_party import mujoco_warp as mjw

from csac_jax.config import SimConfig
from csac_jax.sim import outcome, warp_graph
from csac_jax.world import scene_state
from csac_jax.world.model import World

STEP = 0.0051  # s, longest physics step; compared with C's in docs/benchmarks/physics-parity.md
CONE_EFFORT = 8  # iterations of the solver and of a line search by elliptic cones: enough (ours)
SPARE_SCENES = 32  # all scenes share their contacts: room for those of this many scenes more

FIELDS = {  # of MuJoCo's model, that differ per scene, [E, ...]
    "geom_size": wp.array2d[wp.vec3],
    "geom_pos": wp.array2d[wp.vec3],
    "geom_aabb": wp.array3d[wp.vec3],
    "geom_rbound": wp.array2d[float],
    "geom_friction": wp.array2d[wp.vec3],
    "body_mass": wp.array2d[float],
    "body_subtreemass": wp.array2d[float],
    "body_inertia": wp.array2d[wp.vec3],
    "body_ipos": wp.array2d[wp.vec3],
    "body_invweight0": wp.array2d[wp.vec2],
    "dof_invweight0": wp.array2d[float],
}
GRIP_FIELDS = {"actuator_forcerange": wp.array2d[wp.vec2]}  # where the grip varies
OBJECT_FIELDS = {  # further ones, of objects
    "geom_dataid": wp.array2d[int],
    "geom_quat": wp.array2d[wp.quat],
    "body_iquat": wp.array2d[wp.quat],
}
_STATE = {"qpos": wp.array2d[float], "qvel": wp.array2d[float]}
_COMMAND = {"control": wp.array3d[float], "in_play": wp.array2d[wp.bool]}  # [E, T, nu] and [E, N]
_TRACE = {  # leaves of `outcome.Trace`; gaps are positions of the finger's joint
    "touched": wp.array[wp.bool],
    "held_rise": wp.array2d[float],
    "held": wp.array2d[wp.bool],
    "rise": wp.array2d[float],
    "lag": wp.array2d[float],
    "gap_closed": wp.array[float],
    "gap_end": wp.array[float],
    "contact_overflow": wp.array[float],  # of whole numbers, see `warp_physics`
}
_TOKEN, _AFTER = {"token": wp.array[float]}, {"after": wp.array[float]}

_STOPPED_EARLY = mjw.OverflowType.ITERATIONS | mjw.OverflowType.LS_ITERATIONS  # by design
_ONE_AT_A_TIME = threading.Lock()  # threads that prepare scenes: `warp_graph` patches Warp
_LOST_CONTACTS = int(mjw.OverflowType.ALL & ~_STOPPED_EARLY)

wp.config.log_level = wp.LOG_WARNING  # not a line for each kernel
wp.set_module_options({"enable_backward": False})


@wp.kernel
def _command(done: wp.array[int], control: wp.array3d[float], ctrl: wp.array2d[float]):
    scene = wp.tid()
    for actuator in range(ctrl.shape[1]):
        ctrl[scene, actuator] = control[scene, done[scene], actuator]
    done[scene] = done[scene] + 1


@wp.kernel
def _mark_touch(
    room: int,
    contacts: wp.array[int],  # [1], all scenes together; more than `room` if some were lost
    scenes: wp.array[int],
    geoms: wp.array[wp.vec2i],
    distance: wp.array[float],
    margin: wp.array[float],
    slot_of_geom: wp.array[int],  # [G], -1: no block
    part_of_geom: wp.array[int],  # [G] 0 palm, 1 and 2 fingers, -1: not of the hand
    done: wp.array[int],
    touching: wp.array3d[int],  # [E, 3, N] last substep in which they did
):
    """Marks which part of the hand touches which block, from the contacts of the last step."""
    contact = wp.tid()
    if contact >= wp.min(contacts[0], room) or distance[contact] >= margin[contact]:
        return
    pair = geoms[contact]
    for side in range(2):
        part = part_of_geom[pair[side]]
        slot = slot_of_geom[pair[1 - side]]
        if part >= 0 and slot >= 0:
            scene = scenes[contact]
            touching[scene, part, slot] = done[scene]  # other threads write the same


@wp.func
def _limited(value: float, limit: float):
    """Clips a value; NaN stays NaN, which `wp.clamp` would hide."""
    if value > limit:
        return limit
    if value < -limit:
        return -limit
    return value


@wp.kernel
def _observe(
    low_after: wp.vec2i,  # substeps of a push's descent, of a grasp's
    closed_after: int,
    lost_contacts: int,
    finger: int,
    press_qpos: int,
    press: int,
    position: wp.array[int],  # [N] first address of a block in qpos
    velocity: wp.array[int],  # [N] and in qvel
    limit: wp.array[float],  # [6]
    start: wp.array2d[float],  # [E, nq] qpos when the primitive began
    in_play: wp.array2d[wp.bool],  # [E, N]
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    ctrl: wp.array2d[float],
    touching: wp.array3d[int],
    overflow: wp.array[int],
    done: wp.array[int],
    touched: wp.array[wp.bool],
    held_rise: wp.array2d[float],
    held: wp.array2d[wp.bool],
    rise: wp.array2d[float],
    lag: wp.array2d[float],
    gap_closed: wp.array[float],
    gap_end: wp.array[float],
    contact_overflow: wp.array[float],
):
    """Holds parked blocks, limits speeds, extends the trace, see _TRACE."""
    scene, slot = wp.tid()
    first = position[slot]
    dof = velocity[slot]
    for i in range(6):
        if in_play[scene, slot]:
            qvel[scene, dof + i] = _limited(qvel[scene, dof + i], limit[i])
        else:
            qvel[scene, dof + i] = 0.0
    if not in_play[scene, slot]:
        for i in range(7):
            qpos[scene, first + i] = start[scene, first + i]

    gained = qpos[scene, first + 2] - start[scene, first + 2]
    now = done[scene]
    low = touching[scene, 1, slot] == now
    high = touching[scene, 2, slot] == now
    if low or high or touching[scene, 0, slot] == now:
        touched[scene] = True  # other threads write the same
    on_low = wp.int32(0)
    on_high = wp.int32(0)
    for other in range(touching.shape[2]):
        if touching[scene, 1, other] == now:
            on_low += 1
        if touching[scene, 2, other] == now:
            on_high += 1
    between = (low or high) and on_low > 0 and on_high > 0
    held[scene, slot] = between
    rise[scene, slot] = gained
    if between and gained > held_rise[scene, slot]:
        held_rise[scene, slot] = gained

    if slot == 0:
        for kind in range(2):
            if now == low_after[kind]:
                lag[scene, kind] = qpos[scene, press_qpos] - ctrl[scene, press]
        if now == closed_after:
            gap_closed[scene] = qpos[scene, finger]
        gap_end[scene] = qpos[scene, finger]
        if (overflow[scene] & lost_contacts) != 0:
            contact_overflow[scene] = contact_overflow[scene] + 1.0
        overflow[scene] = 0


class Batch:
    """Model, data and trace of E scenes on the current device, and the recorded substeps."""

    def __init__(self, world: World, cfg: SimConfig, scenes: int) -> None:
        self.substeps = substeps = steps(cfg)
        names = fields(world, cfg)
        self.model, self.data = _put(world.model, cfg, scenes, names)
        slots, parts = len(world.slots), outcome.PARTS
        part_of_geom = np.full(world.model.ngeom, -1)
        part_of_geom[world.hand_geoms] = world.hand_parts
        self._hand_and_blocks = [
            wp.array(index, dtype=int) for index in (world.slot_of_geom, part_of_geom)
        ]

        def after(phases: tuple[int, ...]) -> int:
            return round(sum(phases) * substeps / cfg.substeps)

        self._constants = [
            wp.vec2i(after(cfg.push_phases[:1]), after(cfg.grasp_phases[:1])),
            after(cfg.grasp_phases[:2]),
            _LOST_CONTACTS,
            world.finger_qpos,
            world.press_qpos,
            world.press,
            wp.array(world.block_qpos[:, 0], dtype=int),
            wp.array(world.block_dofs[:, 0], dtype=int),
            wp.array(scene_state.SPEED_LIMIT, dtype=float),
        ]
        self._qpos = wp.zeros((scenes, world.model.nq), dtype=float)
        self._qvel = wp.zeros((scenes, world.model.nv), dtype=float)
        self._control = wp.zeros((scenes, substeps, world.model.nu), dtype=float)
        self._in_play = wp.zeros((scenes, slots), dtype=wp.bool)
        state = [self._qpos, self._qvel, self._control, self._in_play]
        self.given = [*(getattr(self.model, name) for name in names), *state]
        """Arrays that a simulator's arguments are copied to, in their order."""
        self._touching = wp.zeros((scenes, parts, slots), dtype=int)
        self._done = wp.zeros(scenes, dtype=int)
        self._trace = [
            wp.zeros(_shape(name, scenes, slots), dtype=kind.dtype) for name, kind in _TRACE.items()
        ]
        self._advance = self.recorded(self.substep)
        if wp.get_device().is_cuda:
            self._stream = wp.Stream(priority=-1)  # before others: few blocks of threads each
            self._taken, self._ended = wp.Event(), wp.Event()

    def run(self, inputs: Sequence[wp.array], outputs: Sequence[wp.array]) -> None:
        """Runs one primitive; arrays in the order of a simulator's arguments and results."""
        self._take(inputs)
        self._advance()
        self._give(outputs)

    def start(self, inputs: Sequence[wp.array]) -> None:
        """Starts one primitive on a stream of its own."""
        self._take(inputs)
        wp.record_event(self._taken)
        with wp.ScopedStream(self._stream, sync_enter=False):
            wp.wait_event(self._taken)
            self._advance()
            wp.record_event(self._ended)

    def finish(self, outputs: Sequence[wp.array]) -> None:
        """Makes the current stream wait for the primitive that was started last."""
        wp.wait_event(self._ended)
        self._give(outputs)

    def _take(self, inputs: Sequence[wp.array]) -> None:
        for target, source in zip(self.given, inputs, strict=True):
            wp.copy(target, source)
        self.restart()

    def _give(self, outputs: Sequence[wp.array]) -> None:
        results = [self.data.qpos, self.data.qvel, *self._trace]
        for target, result in zip(outputs, results, strict=True):
            wp.copy(target, result)

    def restart(self) -> None:
        data = self.data
        wp.copy(data.qpos, self._qpos)
        wp.copy(data.qvel, self._qvel)
        for blank in (data.time, data.qacc_warmstart, data.overflow, self._done, *self._trace):
            blank.zero_()
        self._touching.zero_()

    def recorded(self, substep: Callable[[], None]) -> Callable[[], None]:
        """Returns a function that runs `substep` as often as a primitive does."""
        self.restart()
        return warp_graph.repeated(substep, self.substeps)

    def step(self) -> None:
        """Advances physics by one step with the set-points of the substep."""
        wp.launch(_command, self.data.nworld, [self._done, self._control, self.data.ctrl])
        mjw.step(self.model, self.data)

    def substep(self) -> None:
        """Advances physics by one step, limits speeds and extends the trace."""
        self.step()
        data, contact = self.data, self.data.contact
        contacts = [data.nacon, contact.worldid, contact.geom, contact.dist, contact.includemargin]
        wp.launch(
            _mark_touch,
            data.naconmax,
            [data.naconmax, *contacts, *self._hand_and_blocks, self._done, self._touching],
        )
        state = [data.qpos, data.qvel, data.ctrl, self._touching, data.overflow, self._done]
        wp.launch(
            _observe,
            self._in_play.shape,
            [*self._constants, self._qpos, self._in_play, *state, *self._trace],
        )


def fields(world: World, cfg: SimConfig) -> dict[str, Any]:
    """Returns the fields of MuJoCo's model that differ per scene, and their types."""
    of_objects = {} if world.objects is None else OBJECT_FIELDS
    return FIELDS | of_objects | (GRIP_FIELDS if cfg.grip_varies else {})


def _shape(name: str, scenes: int, slots: int) -> tuple[int, ...]:
    """Returns the shape of a leaf of the trace."""
    return (scenes, 2) if name == "lag" else (scenes, slots)[: _TRACE[name].ndim]


def steps(cfg: SimConfig) -> int:
    """Counts a primitive's steps: at most STEP long, whole graphs, no more than the config's."""
    least = math.ceil(cfg.substeps * cfg.timestep / STEP - 1e-6)
    return min(cfg.substeps, -(-least // warp_graph.LONGEST) * warp_graph.LONGEST)


def _put(
    model: mujoco.MjModel, cfg: SimConfig, scenes: int, names: Iterable[str]
) -> tuple[Any, Any]:
    """Makes Warp's model, whose fields `names` differ per scene, and its data."""
    model = copy.copy(model)
    model.opt.timestep = cfg.substeps * cfg.timestep / steps(cfg)
    # Off: Warp takes C's function for two boxes, not the general one for convex shapes.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_NATIVECCD
    # Warp refuses both, which C has with objects: the flag, and dense Jacobians of many blocks.
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_AUTO
    if model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC:
        model.opt.iterations = model.opt.ls_iterations = CONE_EFFORT
    put = mjw.put_model(model, batch_sizes=dict.fromkeys(names, scenes))
    put.opt.warn_overflow = 0  # the trace counts
    put.opt.graph_conditional = False  # some scene needs all iterations: a loop saves none
    data = mjw.make_data(
        model,
        nworld=scenes,
        nconmax=cfg.contacts,
        naconmax=(scenes + SPARE_SCENES) * cfg.contacts,
        njmax=4 * cfg.contacts + 32,  # a pyramid's edges, more than of a cone; joints and limits
    )
    return put, data


class WarpSimulator:
    """A function of the arrays of E scenes by name, `arguments`, for JAX to call. It returns qpos
    [E, nq], qvel [E, nv] and the leaves of `outcome.Trace`."""

    def __init__(self, world: World, cfg: SimConfig) -> None:
        self.substeps = steps(cfg)
        self.batches: dict[tuple[Any, int], Batch] = {}
        """By device and scenes; made by the first action of so many scenes, or by `prepared`."""
        self._world, self._cfg = world, cfg
        self.arguments = {**fields(world, cfg), **_STATE, **_COMMAND}
        self._results = {**_STATE, **_TRACE}
        self._run_call = _callable(self._run, self.arguments, self._results)
        self._start_call = _callable(self._start, self.arguments, _TOKEN)
        self._finish_call = _callable(self._finish, _TOKEN | _AFTER, self._results)

    def __call__(self, **arrays: jax.Array) -> dict[str, jax.Array]:
        given = [arrays[name] for name in self.arguments]
        return self._named(self._run_call(*given, output_dims=self._dims(len(given[-1]))))

    def start(self, **arrays: jax.Array) -> jax.Array:
        """Starts the primitive on a stream of its own; returns its token [E], zeros."""
        given = [arrays[name] for name in self.arguments]
        (token,) = self._start_call(*given, output_dims={"token_out": (len(given[-1]),)})
        return token

    def finish(self, token: jax.Array, after: jax.Array) -> dict[str, jax.Array]:
        """Waits for the primitive of a token [E] once `after` [E] was computed; its results."""
        return self._named(self._finish_call(token, after, output_dims=self._dims(len(token))))

    def _named(self, results: Sequence[jax.Array]) -> dict[str, jax.Array]:
        return dict(zip(self._results, results, strict=True))

    def _dims(self, scenes: int) -> dict[str, tuple[int, ...]]:
        """Returns the results' shapes."""
        model, slots = self._world.model, len(self._world.slots)
        shapes = {name: _shape(name, scenes, slots) for name in _TRACE}
        shapes |= {"qpos": (scenes, model.nq), "qvel": (scenes, model.nv)}
        return {f"{name}_out": shape for name, shape in shapes.items()}

    def prepared(self, scenes: int) -> Batch:
        """Returns the batch of so many scenes on the current device; builds its kernels once."""
        key = (wp.get_device().alias, scenes)
        with _ONE_AT_A_TIME:
            if key not in self.batches:
                self.batches[key] = Batch(self._world, self._cfg, scenes)
                wp.synchronize_device()  # others may use it on another stream
            return self.batches[key]

    def _run(self, *arrays: wp.array) -> None:
        count = len(self.arguments)
        with wp.ScopedDevice(arrays[0].device):
            self.prepared(arrays[0].shape[0]).run(arrays[:count], arrays[count:])

    def _start(self, *arrays: wp.array) -> None:
        *inputs, token = arrays
        with wp.ScopedDevice(token.device):
            self.prepared(token.shape[0]).start(inputs)
            token.zero_()

    def _finish(self, *arrays: wp.array) -> None:
        token, _, *outputs = arrays
        with wp.ScopedDevice(token.device):
            self.prepared(token.shape[0]).finish(outputs)


def _callable(run: Callable[..., None], arguments: dict[str, Any], results: dict[str, Any]) -> Any:
    """Makes a function of JAX's arrays. `Batch` records graphs, without buffers of XLA."""
    return wp.jax_callable(
        _annotated(run, list(arguments.items()), list(results.items())),
        num_outputs=len(results),
        graph_mode=wp.JaxCallableGraphMode.NONE,
    )


def _annotated(
    run: Callable[..., None], arguments: list[tuple[str, Any]], results: list[tuple[str, Any]]
) -> Callable[..., None]:
    """Gives `run` the signature from which Warp reads the types of arguments and results."""
    kinds = dict(arguments) | {f"{name}_out": kind for name, kind in results}

    def function(*arrays: wp.array) -> None:
        run(*arrays)

    function.__annotations__ = kinds
    some = inspect.Parameter.POSITIONAL_OR_KEYWORD
    function.__signature__ = inspect.Signature(
        [inspect.Parameter(name, some, annotation=kind) for name, kind in kinds.items()]
    )
    return function
