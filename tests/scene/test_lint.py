"""The linter against MJX itself: what it refuses, MJX refuses too, or computes as if it were not
there."""

import importlib
import inspect
import itertools
import typing
from typing import Any

import mujoco
import pytest

from csac_jax import grippers
from csac_jax.config import Config, RobotKind, SimConfig
from csac_jax.errors import SceneError
from csac_jax.scene import lint, model
from csac_jax.sim.quiet_mjx import mjx

from mujoco.mjx._src import collision_driver, types  # isort: skip

COMPUTING = "constraint derivative forward inverse passive scan sensor smooth solver support"

SCENE = """
<mujoco>
  <option timestep="0.004" integrator="{integrator}" {option}><flag {flag}/></option>
  <worldbody>
    <geom name="table" type="plane" size="1 1 0.1"/>
    <body name="box" pos="0 0 0.1">
      <freejoint/><geom name="box" type="box" size="0.02 0.02 0.02" {geom}/>
    </body>
    <body name="arm" pos="1 0 0.5">
      <joint name="hinge" axis="0 1 0" {joint}/><geom name="arm" size="0.05"/>
    </body>
    {body}
  </worldbody>
  <tendon><fixed name="string" {tendon}><joint joint="hinge" coef="1"/></fixed></tendon>
  <actuator>{actuator}</actuator>
  {more}
</mujoco>
"""
BLANK = dict.fromkeys(("option", "geom", "joint", "body", "tendon", "actuator", "more"), "")


def _model(**parts: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(
        SCENE.format(**BLANK | {"integrator": "implicitfast", "flag": ""} | parts)
    )


ROUND = (
    '<body pos="0 0 0.3"><freejoint/><geom name="round" type="{}" size="0.02 0.02 0.02" {}/></body>'
)
MOTOR = '<general name="motor" joint="hinge" {}/>'
NESTED = (
    '<body pos="0 2 1"><joint/>'
    '<geom type="box" size="0.02 0.02 0.02" contype="0" conaffinity="4"/>'
    "<body><joint/>"
    '<geom type="cylinder" size="0.02 0.02" contype="4" conaffinity="0"/></body></body>'
)
CORNERS = '<asset><mesh name="wedge" vertex="0 0 0  .1 0 0  0 .1 0  0 0 .1"/></asset>'
WEDGE = '<body pos="0 0 0.3"><freejoint/><geom name="wedge" type="mesh" mesh="wedge" {}/></body>'

REFUSED: list[tuple[dict[str, str], str]] = [
    ({"option": 'noslip_iterations="3"'}, "ignores option noslip_iterations; leave it at 0"),
    ({"option": 'noslip_tolerance="1e-3"'}, "ignores option noslip_tolerance; leave it at 1e-06"),
    ({"option": 'ccd_iterations="99"'}, "ignores option ccd_iterations; leave it at 35"),
    ({"option": 'ccd_tolerance="1e-3"'}, "ignores option ccd_tolerance"),
    ({"option": 'sdf_iterations="3"'}, "ignores option sdf_iterations"),
    ({"option": 'sleep_tolerance="1"'}, "ignores option sleep_tolerance"),
    ({"option": 'actuatorgroupdisable="2"'}, "ignores option disableactuator"),
    ({"option": 'density="1.2"'}, "lacks fluid drag with implicitfast"),
    ({"option": 'wind="1 0 0"'}, "lacks fluid drag with implicitfast"),
    ({"integrator": "discrete"}, "lacks integrator discrete; use implicitfast"),
    ({"integrator": "implicit"}, "lacks integrator implicit; use implicitfast"),
    ({"option": 'solver="PGS"'}, "lacks solver pgs; use Newton"),
    ({"flag": 'sleep="enable"'}, "lacks flag sleep; do not enable it"),
    ({"flag": 'energy="enable"'}, "lacks flag energy"),
    ({"flag": 'override="enable"'}, "lacks flag override"),
    ({"flag": 'fwdinv="enable"'}, "lacks flag fwdinv"),
    ({"flag": 'multiccd="disable"'}, "ignores flag multiccd; do not disable it"),
    ({"flag": 'nativeccd="disable"'}, "ignores flag nativeccd"),
    ({"flag": 'island="disable"'}, "ignores flag island"),
    ({"flag": 'midphase="disable"'}, "ignores flag midphase"),
    ({"flag": 'autoreset="disable"'}, "ignores flag autoreset"),
    ({"joint": 'stiffness="1 2"'}, "ignores joint stiffness of a higher order"),
    ({"joint": 'damping="1 2"'}, "ignores joint damping of a higher order"),
    ({"tendon": 'stiffness="1 2"'}, "ignores tendon stiffness of a higher order"),
    ({"tendon": 'damping="1 2"'}, "ignores tendon damping of a higher order"),
    ({"geom": 'gap="0.01"'}, "ignores geom gap"),
    ({"geom": 'fluidshape="ellipsoid"'}, "ignores geom fluid"),
    ({"geom": 'adhesion="1"'}, "ignores geom adhesion"),
    ({"geom": 'surfacevel="1 0 0 0 0 0"'}, "ignores geom surfacevel"),
    (
        {"more": '<contact><pair geom1="table" geom2="box" gap="0.1"/></contact>'},
        "ignores pair gap",
    ),
    (
        {"more": '<contact><pair geom1="table" geom2="box" adhesion="1"/></contact>'},
        "ignores pair adhesion",
    ),
    (
        {"actuator": MOTOR.format('actearly="true" dyntype="integrator"')},
        "ignores actuator actearly",
    ),
    ({"actuator": MOTOR.format('armature="1"')}, "ignores actuator armature"),
    ({"actuator": MOTOR.format('damping="1"')}, "ignores actuator damping"),
    ({"actuator": MOTOR.format('damping="0 1"')}, "ignores actuator damping of a higher order"),
    ({"actuator": MOTOR.format('delay="0.01" nsample="4"')}, "ignores actuator delay"),
    (
        {"actuator": MOTOR.format('dyntype="user"')},
        "lacks actuator_dyntype user of actuator 'motor'",
    ),
    (
        {"actuator": MOTOR.format('gaintype="user"')},
        "lacks actuator_gaintype user of actuator 'motor'",
    ),
    (
        {"actuator": MOTOR.format('biastype="user"')},
        "lacks actuator_biastype user of actuator 'motor'",
    ),
    (
        {"actuator": '<adhesion body="box" ctrlrange="0 1"/>'},
        "lacks actuator_trntype body of actuator 0",
    ),
    ({"more": '<sensor><user dim="1"/></sensor>'}, "lacks sensor_type user of sensor 0"),
    ({"more": '<sensor><clock delay="0.01" nsample="4"/></sensor>'}, "ignores sensor delay"),
    ({"more": '<sensor><clock interval="0.01" nsample="4"/></sensor>'}, "ignores sensor interval"),
    (
        {"more": '<sensor><contact name="feel" body1="box"/></sensor>'},
        "lacks contact by site, body or subtree",
    ),
    (
        {"more": '<sensor><contact geom1="box" reduce="netforce"/></sensor>'},
        "lacks contact by site, body or subtree",
    ),
    (
        {"body": ROUND.format("cylinder", "")},
        "lacks collisions cylinder x box (geom 'round' and geom 'box')",
    ),
    ({"body": ROUND.format("ellipsoid", "")}, "lacks collisions ellipsoid x box"),
    (
        {"body": ROUND.format("cylinder", 'contype="0" conaffinity="0"')}
        | {"more": '<contact><pair geom1="box" geom2="round"/></contact>'},
        "lacks collisions cylinder x box",
    ),
    (
        {"body": WEDGE.format("") + ROUND.format("cylinder", 'contype="2" conaffinity="2"')}
        | {"more": CORNERS + '<contact><pair geom1="wedge" geom2="round"/></contact>'},
        "lacks collisions cylinder x mesh",
    ),
    ({"body": WEDGE.format('margin="0.01"'), "more": CORNERS}, "lacks margins in collisions"),
]


@pytest.mark.parametrize(
    ("parts", "line"), REFUSED, ids=lambda value: value if isinstance(value, str) else ""
)
def test_what_mjx_ignores_is_refused(parts: dict[str, str], line: str):
    """Claim: an option that MJX ignores or lacks is refused in one line that names it and the
    remedy."""
    message = next(lint.faults(_model(**parts)))
    assert message.startswith(line)
    assert "; " in message
    assert "\n" not in message


@pytest.mark.parametrize(
    "parts",
    [
        {},
        {"integrator": "Euler", "option": 'density="1.2" viscosity="1e-5"'},
        {"option": 'solver="CG" cone="elliptic" impratio="3"'},
        {"flag": 'invdiscrete="enable" warmstart="disable" eulerdamp="disable"'},
        {"body": ROUND.format("cylinder", 'contype="0" conaffinity="0"')},
        {"body": ROUND.format("cylinder", 'contype="2" conaffinity="2"')},
        {"body": ROUND.format("capsule", 'margin="0.01"')},
        {
            "body": ROUND.format("cylinder", ""),
            "more": '<contact><exclude body1="box" body2="b"/></contact>',
        },
        {"body": WEDGE.format(""), "more": CORNERS},
        {"body": NESTED},
        {
            "actuator": '<position joint="hinge" kp="9" kv="1" forcerange="-1 1"/>',
            "joint": 'stiffness="1" damping="2"',
        },
        {
            "more": '<sensor><contact geom1="box"/><touch site="s"/></sensor>',
            "body": '<site name="s" size="1"/>',
        },
    ],
)
def test_what_mjx_takes_is_not_refused(parts: dict[str, str]):
    """Claim: the linter refuses nothing that MJX computes."""
    if "exclude" in parts.get("more", ""):
        parts = parts | {"body": parts["body"].replace("<body ", '<body name="b" ')}
    built = _model(**parts)
    assert list(lint.faults(built)) == []
    mjx.put_model(built, impl="jax")


@pytest.mark.parametrize("robot", typing.get_args(RobotKind))
@pytest.mark.parametrize("gripper", grippers.shipped())
def test_worlds_of_all_robots_pass(robot: RobotKind, gripper: str):
    """Claim: the shipped MJCF has nothing that MJX ignores."""
    sim = SimConfig(robot=robot, gripper=gripper)
    assert list(lint.faults(model.build(Config().scene, sim).model)) == []


def test_build_runs_the_linter(monkeypatch: pytest.MonkeyPatch):
    """Claim: a world for MJX is linted as it is built; C MuJoCo knows every option of its own."""
    plain = model._spec

    def slippery(*arguments: Any) -> mujoco.MjSpec:
        spec = plain(*arguments)
        spec.option.noslip_iterations = 5
        return spec

    monkeypatch.setattr(model, "_spec", slippery)
    with pytest.raises(SceneError, match=r"^MJX ignores option noslip_iterations; leave it at 0$"):
        model.build(Config().scene, SimConfig())
    assert model.build(Config().scene, SimConfig(physics="c")).model.opt.noslip_iterations == 5


# The tables, against the enumerations and fields of the MJX that is installed.


def _words(kind: Any) -> dict[str, int]:
    """Values of an enumeration of MuJoCo by their names without prefix."""
    names = [name for name in dir(kind) if name.startswith("mj") and not name.startswith("mjN")]
    return {name.split("_", 1)[1].lower(): int(getattr(kind, name)) for name in names}


def _missing(kind: Any, mjx_kind: Any) -> set[str]:
    return {word for word, value in _words(kind).items() if value not in {*map(int, mjx_kind)}}


def _sources() -> str:
    """The code of MJX that computes."""
    modules = [importlib.import_module(f"mujoco.mjx._src.{name}") for name in COMPUTING.split()]
    modules.append(collision_driver)
    return "".join(inspect.getsource(module) for module in modules)


def test_tables_are_those_of_the_installed_mjx():
    """Claim: integrators, solvers, flags and kinds are refused exactly where MJX has no code for
    them."""
    lacking = _missing(mujoco.mjtIntegrator, types.IntegratorType)
    assert lacking | {"discrete"} == {*_words(mujoco.mjtIntegrator)} - {*lint.INTEGRATORS}
    lacking = _missing(mujoco.mjtSolver, types.SolverType)  # discrete above raises as it steps
    assert lacking == {*_words(mujoco.mjtSolver)} - {*lint.SOLVERS}
    ignored = _missing(mujoco.mjtDisableBit, types.DisableBit)
    assert ignored == {*lint.DISABLE_FLAGS_IGNORED}
    read = _sources()
    used = {flag.name.lower() for flag in types.EnableBit if f"EnableBit.{flag.name}" in read}
    assert {*lint.ENABLE_FLAGS} == used
    kinds = {
        "actuator_biastype": types.BiasType,
        "actuator_dyntype": types.DynType,
        "actuator_gaintype": types.GainType,
        "actuator_trntype": types.TrnType,
        "eq_type": types.EqType,
        "sensor_type": types.SensorType,
    }
    for field, mjx_kind in kinds.items():
        _, kind, lacking = lint.KINDS_LACKING[field]
        assert _missing(kind, mjx_kind) == {*lacking}, field


def test_ignored_options_are_those_without_a_field():
    """Claim: every option of MuJoCo that MJX has no field for, or never reads, is refused unless it
    is the default."""
    ours = {name for name in dir(mujoco.MjOption) if not name.startswith("_")}
    theirs = {field.name for kind in (types.Option, types.OptionJAX) for field in kind.fields()}
    only_with_override = {"o_margin", "o_solref", "o_solimp", "o_friction"}
    read = _sources()
    unread = {
        name
        for name in ours & theirs
        if f"opt.{name}" not in read and f"opt._impl.{name}" not in read
    }
    at_building = {
        "enableflags",
        "density",
        "viscosity",
        "jacobian",
        "sdf_initpoints",
    }  # read in `io`
    assert set(lint.IGNORED_OPTIONS) == (ours - theirs) | (
        unread - only_with_override - at_building
    )


def test_collisions_lacking_are_those_without_a_function():
    """Claim: pairs of geom types are refused exactly where MJX has no collision function and C
    MuJoCo collides."""
    words = _words(mujoco.mjtGeom)
    kinds = sorted((word for word in words if words[word] <= words["sdf"]), key=words.get)
    static = {"plane", "hfield"}
    lacking = {
        (one, two)
        for i, one in enumerate(kinds)
        for two in kinds[i:]
        if not collision_driver.has_collision_fn(words[one], words[two])
        and not {one, two} <= static
    }
    assert lacking == set(lint.COLLISIONS_LACKING)


def test_ignored_fields_are_read_nowhere():
    """Claim: what is refused as ignored is indeed read nowhere in MJX's code."""
    read = _sources()
    for name in itertools.chain(*lint.IGNORED_FIELDS.values()):
        assert f"m.{name}" not in read, name


def test_meeting_pairs_are_those_of_mjx():
    """Claim: the pairs of geoms that the linter looks at are those that MJX collides."""
    world = model.build(Config().scene, SimConfig(robot="ur5"))
    ours = {(int(one), int(two)) for one, two, _ in lint._meeting(world.model)}
    theirs = {(int(one), int(two)) for one, two, _ in collision_driver.geom_pairs(world.model)}
    assert {tuple(sorted(pair)) for pair in ours} == {tuple(sorted(pair)) for pair in theirs}
    assert len(ours) > 20
