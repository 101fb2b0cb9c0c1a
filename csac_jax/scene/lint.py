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

# Values of MuJoCo's enumerations are named without their prefix: mjINT_DISCRETE is `discrete`.
IGNORED_OPTIONS = (
    *("noslip_iterations", "noslip_tolerance", "ccd_iterations", "ccd_tolerance"),
    *("sdf_iterations", "sleep_tolerance", "disableactuator"),
)
INTEGRATORS = ("euler", "rk4", "implicitfast")
SOLVERS = ("newton", "cg")
ENABLE_FLAGS = ("invdiscrete",)  # sleep and ipc pass `put_model`, then nothing reads them
DISABLE_FLAGS_IGNORED = ("midphase", "autoreset", "nativeccd", "island", "multiccd")
_GEOMS = ("plane", "hfield", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh", "sdf")
COLLISIONS_LACKING = {  # by the order of mjtGeom
    *(("hfield", other) for other in ("ellipsoid", "cylinder")),
    *((one, other) for one in ("ellipsoid", "cylinder") for other in ("box", "mesh")),
    *((other, "sdf") for other in _GEOMS),
}
NO_MARGIN = {"mesh", "hfield"}
CONTACT_ENDS_LACKING = {"site", "body", "xbody"}
IGNORED_FIELDS = {  # by element: fields of the model, zero unless their attribute of MJCF is used
    "joint": ("jnt_stiffnesspoly", "dof_dampingpoly"),
    "tendon": ("tendon_stiffnesspoly", "tendon_dampingpoly"),
    "geom": ("geom_gap", "geom_fluid", "geom_adhesion", "geom_surfacevel"),
    "pair": ("pair_gap", "pair_adhesion"),
    "actuator": (
        *("actuator_actearly", "actuator_armature", "actuator_damping"),
        *("actuator_dampingpoly", "actuator_delay"),
    ),
    "sensor": ("sensor_delay", "sensor_interval"),
}
_SENSORS_LACKING = (
    *("e_kinetic", "e_potential", "geomdist", "geomfromto", "geomnormal"),
    *("insidesite", "plugin", "user"),
    *(f"{of}limit{what}" for of in ("joint", "tendon") for what in ("frc", "pos", "vel")),
)
KINDS_LACKING = {  # field of the model: (its element, enumeration, values without code in MJX)
    "actuator_biastype": ("actuator", mujoco.mjtBias, ("dcmotor", "so3", "user")),
    "actuator_dyntype": ("actuator", mujoco.mjtDyn, ("dcmotor", "pid", "user")),
    "actuator_gaintype": ("actuator", mujoco.mjtGain, ("dcmotor", "pid", "so3", "user")),
    "actuator_trntype": ("actuator", mujoco.mjtTrn, ("body", "slidercrank", "so3", "undefined")),
    "eq_type": ("equality", mujoco.mjtEq, ("distance", "flex", "flexstrain", "flexvert")),
    "sensor_type": ("sensor", mujoco.mjtSensor, _SENSORS_LACKING),
}


def faults(model: mujoco.MjModel) -> Iterator[str]:
    """What MJX lacks or would ignore, with the remedy: "ignores option noslip_iterations; ..."."""
    yield from _options(model.opt)
    yield from _fields(model)
    yield from _kinds(model)
    yield from _collisions(model)


def _options(option: mujoco.MjOption) -> Iterator[str]:
    default = mujoco.MjOption()
    for name in IGNORED_OPTIONS:
        if getattr(option, name) != getattr(default, name):
            yield f"ignores option {name}; leave it at {getattr(default, name):g}"
    integrator = _word(mujoco.mjtIntegrator, option.integrator)
    if integrator not in INTEGRATORS:
        yield f"lacks integrator {integrator}; use implicitfast"
    if (solver := _word(mujoco.mjtSolver, option.solver)) not in SOLVERS:
        yield f"lacks solver {solver}; use Newton"
    for flag in _flags(mujoco.mjtEnableBit, option.enableflags):
        if flag not in ENABLE_FLAGS:
            yield f"lacks flag {flag}; do not enable it"
    for flag in _flags(mujoco.mjtDisableBit, option.disableflags):
        if flag in DISABLE_FLAGS_IGNORED:
            yield f"ignores flag {flag}; do not disable it"
    fluid = option.density > 0.0 or option.viscosity > 0.0 or np.any(option.wind)
    if fluid and integrator == "implicitfast":
        remedy = "set density, viscosity and wind to 0, or integrator to Euler"
        yield f"lacks fluid drag with implicitfast; {remedy}"


def _flags(kind: Any, flags: int) -> list[str]:
    return [_word(kind, 1 << bit) for bit in range(flags.bit_length()) if flags >> bit & 1]


def _word(kind: Any, value: int) -> str:
    """`mjINT_DISCRETE` as `discrete`."""
    return str(kind(value).name).split("_", 1)[1].lower()


def _fields(model: mujoco.MjModel) -> Iterator[str]:
    for count, what in ((model.nflex, "flexes"), (model.nplugin, "plugins")):
        if count:
            yield f"lacks {what}; take them out of the model"
    for element, fields in IGNORED_FIELDS.items():
        for field in fields:
            if np.any(getattr(model, field)):
                what = field.split("_")[1].replace("poly", " of a higher order")
                yield f"ignores {element} {what}; leave it at 0"


def _kinds(model: mujoco.MjModel) -> Iterator[str]:
    for field, (what, kind, lacking) in KINDS_LACKING.items():
        for index, value in enumerate(getattr(model, field)):
            if (word := _word(kind, value)) in lacking:
                label = _label(model, what, index)
                yield f"lacks {field} {word} of {label}; choose another, or take it out"
    for index in np.flatnonzero(model.sensor_type == mujoco.mjtSensor.mjSENS_CONTACT).tolist():
        ends = model.sensor_objtype[index], model.sensor_reftype[index]
        netforce = model.sensor_intprm[index, 1] == 3  # its reduction
        if netforce or CONTACT_ENDS_LACKING & {_word(mujoco.mjtObj, end) for end in ends}:
            sensor = _label(model, "sensor", index)
            remedy = "name geoms and another reduction"
            yield f"lacks contact by site, body or subtree and netforce of {sensor}; {remedy}"


def _label(model: mujoco.MjModel, what: str, index: int) -> str:
    name = mujoco.mj_id2name(model, mujoco.mju_str2Type(what), index)
    return f"{what} '{name}'" if name else f"{what} {index}"


def _collisions(model: mujoco.MjModel) -> Iterator[str]:
    for one, two, margin in _meeting(model):
        pair = sorted((one, two), key=lambda geom: model.geom_type[geom])
        kinds = tuple(_word(mujoco.mjtGeom, model.geom_type[geom]) for geom in pair)
        labels = " and ".join(_label(model, "geom", geom) for geom in pair)
        what = f"collisions {' x '.join(kinds)} ({labels})"
        if kinds in COLLISIONS_LACKING:
            yield f"lacks {what}; make the round one a mesh of few corners, or let them not meet"
        elif margin and NO_MARGIN.intersection(kinds):
            yield f"lacks margins in {what}; set the margin to 0"


def _meeting(model: mujoco.MjModel) -> Iterator[tuple[int, int, float]]:
    """Pairs of geoms that may collide, and the margin of each."""
    yield from zip(model.pair_geom1, model.pair_geom2, model.pair_margin, strict=True)
    kind, affinity = model.geom_contype, model.geom_conaffinity
    weld = model.body_weldid[model.geom_bodyid]  # [geoms]
    parent = model.body_weldid[model.body_parentid[weld]]
    filtered = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    excluded = set(model.exclude_signature.tolist())
    for one, two in itertools.combinations(np.flatnonzero(kind | affinity).tolist(), 2):
        mask = kind[one] & affinity[two] | kind[two] & affinity[one]
        low, high = sorted(model.geom_bodyid[[one, two]].tolist())
        if not mask or weld[one] == weld[two] or (low << 16) + high in excluded:
            continue
        related = weld[one] == parent[two] or weld[two] == parent[one]
        if not (filtered and related and weld[one] != 0 and weld[two] != 0):
            yield one, two, model.geom_margin[one] + model.geom_margin[two]
