"""A linter of models for MJX: refuses what its JAX implementation lacks, or stores and never reads.

Derived from mujoco-mjx 3.17: `put_model`, `step`, and the fields of a model that no other code of
MJX mentions. MJX raises for some of it, without a remedy. The rest it ignores silently, and blocks
would move otherwise than in C MuJoCo.
"""

import itertools
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
from mujoco import mjtDisableBit, mjtEnableBit, mjtGeom, mjtIntegrator, mjtObj, mjtSolver

from csac_jax.errors import SceneError

IGNORED_OPTIONS = (
    "noslip_iterations",
    "noslip_tolerance",
    "ccd_iterations",
    "ccd_tolerance",
    "sdf_iterations",
    "sleep_tolerance",
    "disableactuator",
)
INTEGRATORS = {mjtIntegrator.mjINT_EULER, mjtIntegrator.mjINT_RK4, mjtIntegrator.mjINT_IMPLICITFAST}
SOLVERS = {mjtSolver.mjSOL_NEWTON, mjtSolver.mjSOL_CG}
# Sleep and ipc pass `put_model`, then nothing reads them.
ENABLE_FLAGS = {mjtEnableBit.mjENBL_INVDISCRETE}
DISABLE_FLAGS_IGNORED = {
    mjtDisableBit.mjDSBL_MIDPHASE,
    mjtDisableBit.mjDSBL_AUTORESET,
    mjtDisableBit.mjDSBL_NATIVECCD,
    mjtDisableBit.mjDSBL_ISLAND,
    mjtDisableBit.mjDSBL_MULTICCD,
}
COLLISIONS_LACKING = {  # by the order of mjtGeom
    (mjtGeom.mjGEOM_HFIELD, mjtGeom.mjGEOM_ELLIPSOID),
    (mjtGeom.mjGEOM_HFIELD, mjtGeom.mjGEOM_CYLINDER),
    (mjtGeom.mjGEOM_ELLIPSOID, mjtGeom.mjGEOM_BOX),
    (mjtGeom.mjGEOM_ELLIPSOID, mjtGeom.mjGEOM_MESH),
    (mjtGeom.mjGEOM_CYLINDER, mjtGeom.mjGEOM_BOX),
    (mjtGeom.mjGEOM_CYLINDER, mjtGeom.mjGEOM_MESH),
    *((other, mjtGeom.mjGEOM_SDF) for other in map(mjtGeom, range(mjtGeom.mjGEOM_SDF + 1))),
}
NO_MARGIN = {mjtGeom.mjGEOM_MESH, mjtGeom.mjGEOM_HFIELD}
CONTACT_ENDS_LACKING = {mjtObj.mjOBJ_SITE, mjtObj.mjOBJ_BODY, mjtObj.mjOBJ_XBODY}
IGNORED_FIELDS = {  # field of the model, zero unless its attribute of MJCF is used
    "jnt_stiffnesspoly": "joint stiffness of a higher order",
    "dof_dampingpoly": "joint damping of a higher order",
    "tendon_stiffnesspoly": "tendon stiffness of a higher order",
    "tendon_dampingpoly": "tendon damping of a higher order",
    "geom_gap": "geom gap",
    "pair_gap": "pair gap",
    "geom_fluid": "geom fluidshape",
    "geom_adhesion": "geom adhesion",
    "pair_adhesion": "pair adhesion",
    "geom_surfacevel": "geom surfacevel",
    "actuator_actearly": "actuator actearly",
    "actuator_armature": "actuator armature",
    "actuator_damping": "actuator damping",
    "actuator_dampingpoly": "actuator damping of a higher order",
    "actuator_delay": "actuator delay",
    "sensor_delay": "sensor delay",
    "sensor_interval": "sensor interval",
}
_SENSORS_LACKING = (
    *("E_KINETIC", "E_POTENTIAL", "GEOMDIST", "GEOMFROMTO", "GEOMNORMAL"),
    *("INSIDESITE", "PLUGIN", "USER"),
    *(f"{of}LIMIT{what}" for of in ("JOINT", "TENDON") for what in ("FRC", "POS", "VEL")),
)
KINDS_LACKING = {  # field of the model: (its element, enumeration, values without code in MJX)
    "actuator_biastype": ("actuator", mujoco.mjtBias, ("DCMOTOR", "SO3", "USER")),
    "actuator_dyntype": ("actuator", mujoco.mjtDyn, ("DCMOTOR", "PID", "USER")),
    "actuator_gaintype": ("actuator", mujoco.mjtGain, ("DCMOTOR", "PID", "SO3", "USER")),
    "actuator_trntype": ("actuator", mujoco.mjtTrn, ("BODY", "SLIDERCRANK", "SO3", "UNDEFINED")),
    "eq_type": ("equality", mujoco.mjtEq, ("DISTANCE", "FLEX", "FLEXSTRAIN", "FLEXVERT")),
    "sensor_type": ("sensor", mujoco.mjtSensor, _SENSORS_LACKING),
}


def check(model: mujoco.MjModel) -> None:
    """Raises SceneError, one line, for the first fault of the model."""
    for fault in faults(model):
        raise SceneError(f"MJX {fault}")


def faults(model: mujoco.MjModel) -> Iterator[str]:
    """Everything that MJX lacks or would ignore, each with its remedy: "ignores option
    noslip_iterations; ..."."""
    yield from _options(model.opt)
    yield from _fields(model)
    yield from _kinds(model)
    yield from _collisions(model)


def _options(option: mujoco.MjOption) -> Iterator[str]:
    default = mujoco.MjOption()
    for name in IGNORED_OPTIONS:
        if getattr(option, name) != getattr(default, name):
            yield f"ignores option {name}; leave it at {getattr(default, name):g}"
    if option.integrator not in INTEGRATORS:
        yield f"lacks integrator {_name(mjtIntegrator, option.integrator)}; use implicitfast"
    if option.solver not in SOLVERS:
        yield f"lacks solver {_name(mjtSolver, option.solver)}; use Newton"
    for flag in _bits(mjtEnableBit, option.enableflags):
        if flag not in ENABLE_FLAGS:
            yield f"lacks flag {_name(mjtEnableBit, flag)}; do not enable it"
    for flag in _bits(mjtDisableBit, option.disableflags):
        if flag in DISABLE_FLAGS_IGNORED:
            yield f"ignores flag {_name(mjtDisableBit, flag)}; do not disable it"
    fluid = option.density > 0.0 or option.viscosity > 0.0 or np.any(option.wind)
    if fluid and option.integrator == mjtIntegrator.mjINT_IMPLICITFAST:
        yield (
            "lacks fluid drag with implicitfast; "
            "set density, viscosity and wind to 0, or integrator to Euler"
        )


def _bits(kind: Any, flags: int) -> list[Any]:
    return [kind(1 << bit) for bit in range(flags.bit_length()) if flags >> bit & 1]


def _name(kind: Any, value: int) -> str:
    """`mjINT_DISCRETE` as `discrete`."""
    return str(kind(value).name).split("_", 1)[1].lower()


def _fields(model: mujoco.MjModel) -> Iterator[str]:
    for count, what in ((model.nflex, "flexes"), (model.nplugin, "plugins")):
        if count:
            yield f"lacks {what}; take them out of the model"
    for name, what in IGNORED_FIELDS.items():
        if np.any(getattr(model, name)):
            yield f"ignores {what}; leave it at 0"


def _kinds(model: mujoco.MjModel) -> Iterator[str]:
    for field, (what, kind, lacking) in KINDS_LACKING.items():
        for index, value in enumerate(getattr(model, field)):
            word = kind(value).name.split("_", 1)[1]
            if word in lacking:
                named = f"{field} {word.lower()} of {_label(model, what, index)}"
                yield f"lacks {named}; choose another, or take it out"
    reduction, netforce = 1, 3  # column of sensor_intprm, its value
    for index in np.flatnonzero(model.sensor_type == mujoco.mjtSensor.mjSENS_CONTACT).tolist():
        ends = {mjtObj(int(end[index])) for end in (model.sensor_objtype, model.sensor_reftype)}
        if ends & CONTACT_ENDS_LACKING or model.sensor_intprm[index, reduction] == netforce:
            sensor = _label(model, "sensor", index)
            yield (
                f"lacks contact by site, body or subtree and netforce of {sensor}; "
                "name geoms and another reduction"
            )


def _label(model: mujoco.MjModel, what: str, index: int) -> str:
    """How an element is called: its name, else its number."""
    name = mujoco.mj_id2name(model, mujoco.mju_str2Type(what), index)
    return f"{what} '{name}'" if name else f"{what} {index}"


def _collisions(model: mujoco.MjModel) -> Iterator[str]:
    for one, two, margin in _meeting(model):
        kinds = tuple(mjtGeom(kind) for kind in model.geom_type[[one, two]])
        pair = " and ".join(_label(model, "geom", geom) for geom in (one, two))
        words = " x ".join(_name(mjtGeom, kind) for kind in kinds)
        if kinds in COLLISIONS_LACKING:
            yield (
                f"lacks collisions {words} ({pair}); "
                "make the round one a mesh of few corners, or let them not meet"
            )
        elif margin and set(kinds) & NO_MARGIN:
            yield f"lacks margins in collisions {words} ({pair}); set the margin to 0"


def _meeting(model: mujoco.MjModel) -> Iterator[tuple[int, int, float]]:
    """Pairs of geoms that may collide, by rising type, and the margin of each."""
    for index in range(model.npair):
        one, two = model.pair_geom1[index], model.pair_geom2[index]
        yield *_by_type(model, one, two), model.pair_margin[index]
    kind, affinity = model.geom_contype, model.geom_conaffinity
    weld = model.body_weldid[model.geom_bodyid]  # [geoms]
    parent = model.body_weldid[model.body_parentid[weld]]
    filtered = not model.opt.disableflags & mjtDisableBit.mjDSBL_FILTERPARENT
    excluded = set(model.exclude_signature.tolist())
    for one, two in itertools.combinations(np.flatnonzero(kind | affinity).tolist(), 2):
        mask = kind[one] & affinity[two] | kind[two] & affinity[one]
        low, high = sorted(model.geom_bodyid[[one, two]].tolist())
        if not mask or weld[one] == weld[two] or (low << 16) + high in excluded:
            continue
        related = weld[one] == parent[two] or weld[two] == parent[one]
        if not (filtered and related and weld[one] != 0 and weld[two] != 0):
            yield *_by_type(model, one, two), model.geom_margin[one] + model.geom_margin[two]


def _by_type(model: mujoco.MjModel, one: int, two: int) -> tuple[int, int]:
    return (one, two) if model.geom_type[one] <= model.geom_type[two] else (two, one)
