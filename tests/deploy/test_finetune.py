"""Learning from a record: transitions as the environment would have made them, and what they
teach."""

import dataclasses
import json
import shutil
import signal
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from csac_jax import cli, presets
from csac_jax.agent import actor_critic, maps, values
from csac_jax.config import CameraConfig
from csac_jax.constants import Outcome
from csac_jax.deploy import CameraPolicy, fine_tuning, record
from csac_jax.deploy.decision import Decision
from csac_jax.deploy.fine_tuning import Settings
from csac_jax.deploy.record import Recorder, ReportedOutcome
from csac_jax.errors import DataWarning, FailedError, SettingsError
from csac_jax.io import policy_file
from csac_jax.runtime.signals import Stop
from csac_jax.vision import heightmap
from tests.deploy import scenes
from tests.sections import scaled

pytestmark = pytest.mark.optax

CFG = presets.smoke().change(target={"gamma": 0.0}, learn={"augment": False})
SMALL = scaled(CameraConfig(), 0.25)
LEFT, RIGHT = (-0.1, 0.0), (0.1, 0.05)


@pytest.fixture(scope="module")
def policy() -> CameraPolicy:
    """Returns an untrained policy."""
    learner = actor_critic.make(CFG)
    params = jax.jit(lambda: actor_critic.init(jax.random.key(3), learner).online)()
    return CameraPolicy(CFG, params)


def _take(*places: tuple[float, float]) -> scenes.Image:
    return scenes.take(scenes.blocks_at([(*place, 0.3) for place in [*places, (3.0, 3.0)]]), SMALL)


BOTH, ONLY_LEFT = _take(LEFT, RIGHT), _take(LEFT)


def _grasp(place: tuple[float, float], primitive: str = "grasp") -> Decision:
    return Decision(primitive, (*place, 0.02), 0.3, 0.11, 1.0, ())


def _write(folder: Path, *actions: tuple[scenes.Image, Decision, ReportedOutcome | None]) -> Path:
    recorder = Recorder(folder, "test")
    for image, decision, outcome in actions:
        name = recorder.add((*image, None), [decision])
        if outcome is not None:
            recorder.post(name, outcome)
    return folder


Lifted, Empty, Pushed = (ReportedOutcome(outcome=name) for name in ("lifted", "empty", "pushed"))
End = ReportedOutcome(outcome="lifted", ended=True)


def _transitions(policy: CameraPolicy, loaded: fine_tuning.Experience) -> Any:
    program = fine_tuning.make_program(fine_tuning.configure(policy.cfg, Settings(batch=2), 4))
    state = fine_tuning.init(program, policy.params)
    return fine_tuning.transitions(policy, program.learner, state, loaded)


def test_transitions_are_those_of_training(policy: CameraPolicy, tmp_path: Path):
    """Claim: an action is stored with the map that it was decided on, the map of the next image,
    its pose, and the reward of eqs. 10 to 15; the end of a scene ends an episode; an action without
    outcome or without a next image is left out."""
    outcomes = [Empty, End, None, Lifted, Lifted, End]
    images = [ONLY_LEFT, ONLY_LEFT, BOTH, BOTH, BOTH, ONLY_LEFT]
    others = [(image, _grasp(LEFT), end) for image, end in zip(images, outcomes, strict=True)]
    folder = _write(tmp_path, (BOTH, _grasp(RIGHT), Lifted), *others)
    shutil.rmtree(folder / "000006")  # what the fifth action led to
    found = fine_tuning.load(policy, record.read(folder))
    assert found.outcome.tolist() == [Outcome.LIFTED, Outcome.EMPTY, Outcome.LIFTED, Outcome.LIFTED]
    both, left = (policy.observe(*image) for image in (BOTH, ONLY_LEFT))
    for number, (before, after) in enumerate([(both, left), (left, left), (left, None)]):
        for seen, wanted in [(found.obs, before), (found.next_obs, after)]:
            if wanted is not None:
                row = jax.tree.map(lambda leaf, n=number: leaf[n], seen)
                jax.tree.map(np.testing.assert_array_equal, row, heightmap.pack(wanted))
    done = _transitions(policy, found)
    np.testing.assert_allclose(done.reward, [2.0, -0.5, 2.0, 2.0], atol=1e-6)
    assert done.terminated.tolist() == [False, False, True, True]
    np.testing.assert_allclose(done.action.pose[:, :2], [RIGHT, LEFT, LEFT, LEFT], atol=1e-6)
    np.testing.assert_allclose(done.action.pose[:, 2], 0.3, atol=1e-6)
    assert done.action.primitive.tolist() == [1, 1, 1, 1]


@pytest.mark.slow
def test_what_is_learnt_is_what_was_seen(policy: CameraPolicy, tmp_path: Path):
    """Claim: Q of a stored transition is the score that its decision was taken for."""
    decisions = policy.decide(*BOTH, top=3)
    came = Pushed if decisions[2].primitive == "push" else Empty
    recorder = Recorder(tmp_path, "test")
    recorder.post(recorder.add((*BOTH, None), decisions), came.model_copy(update={"number": 3}))
    recorder.add((*ONLY_LEFT, None), [])
    loaded = fine_tuning.load(policy, record.read(tmp_path))
    obs, action = jax.tree.map(lambda leaf: jax.numpy.asarray(leaf[0]), loaded[:2])
    q = _q(policy, heightmap.unpack(obs), action.primitive, action.pose)
    assert q == pytest.approx(decisions[2].score, abs=1e-3)


def test_pushes_are_judged_by_the_next_image(policy: CameraPolicy, tmp_path: Path):
    """Claim: a push earns as in training: by whether the map has changed, or by the critic."""
    push, last = _grasp(LEFT, "push"), (ONLY_LEFT, _grasp(LEFT), None)
    folder = _write(tmp_path, (BOTH, push, Pushed), (ONLY_LEFT, push, Pushed), last)
    judge = dataclasses.replace(policy, cfg=CFG.change(reward={"push_label": "map_changed"}))
    done = _transitions(judge, fine_tuning.load(judge, record.read(folder)))
    np.testing.assert_allclose(done.reward, [0.5, -0.5], atol=1e-6)


def _q(policy: CameraPolicy, obs: Any, primitive: Any, pose: Any) -> float:
    learner = actor_critic.make(policy.cfg)

    @jax.jit
    def read(params: Any, obs: Any, primitive: Any, pose: Any) -> jax.Array:
        batch = values.dense_maps(learner, params, jax.tree.map(lambda x: x[None], obs))
        return maps.read(learner.frames, batch.q[0], primitive, pose)

    return float(read(policy.params, obs, primitive, pose))


SETTINGS = Settings(updates=100, learning_rate=1e-2, batch=8)


@pytest.fixture(scope="module")
def lesson(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Writes a record in which the right block can be lifted, the left one never."""
    actions = [(BOTH, _grasp(RIGHT), Lifted), (BOTH, _grasp(LEFT), Empty)] * 6
    folder = tmp_path_factory.mktemp("lesson") / "record"
    return _write(folder, *actions, (BOTH, _grasp(LEFT), None))


def test_it_learns_what_works(policy: CameraPolicy, lesson: Path):
    """Claim: after learning, Q of what lifted something is near its reward 2, Q of what failed near
    -0.5; config and the policy that was given stay."""
    before = jax.device_get(policy.params)
    tuned, done = fine_tuning.run(policy, lesson, SETTINGS)
    assert (done.actions, done.lifted, done.updates) == (12, 6, 100)
    assert done.td_error[1] < 0.2 < done.td_error[0]
    for place, reward in ((RIGHT, 2.0), (LEFT, -0.5)):
        pose = np.array([*place, 0.3], np.float32)
        assert abs(_q(tuned, tuned.observe(*BOTH), np.int32(1), pose) - reward) < 0.3
    assert tuned.cfg == policy.cfg
    jax.tree.map(np.testing.assert_array_equal, before, jax.device_get(policy.params))


def test_stop_keeps_what_was_learned(policy: CameraPolicy, lesson: Path):
    """Claim: a signal ends the learning after the step that runs, and its networks are returned;
    one that came before keeps those that were given. Few actions are a warning."""
    stop, seen = Stop(), []

    def interrupt(*progress: float) -> None:
        seen.append(progress[:2])
        stop.signal = signal.SIGINT

    with pytest.warns(DataWarning, match=r"has 12 actions; .* may get worse: record 100 or more"):
        tuned, done = fine_tuning.run(policy, lesson, SETTINGS, interrupt, stop)
    assert (done.updates, done.stopped_by, seen) == (10, signal.SIGINT, [(10, 100)])
    again, none = fine_tuning.run(policy, lesson, SETTINGS, interrupt, stop)
    assert none.updates == 0
    jax.tree.map(np.testing.assert_array_equal, again.params, policy.params)
    changed = jax.tree.map(lambda a, b: bool(np.any(a != b)), tuned.params, policy.params)
    assert any(jax.tree.leaves(changed))


def test_command_writes_a_policy(
    policy: CameraPolicy, lesson: Path, tmp_path: Path, capsys: pytest.CaptureFixture
):
    """Claim: the command writes a policy file that loads and decides, and says what it did; it
    overwrites nothing."""
    start, out = tmp_path / "start.safetensors", tmp_path / "new.safetensors"
    policy_file.save(start, policy.params, policy.cfg)
    arguments = ["finetune", str(start), str(lesson), "--out", str(out), "--updates=100"]
    arguments += ["--batch=8", "--learning-rate=1e-2", "--json", str(tmp_path / "done.json")]
    assert cli.main(arguments) == 0
    printed = capsys.readouterr().out
    assert "learned from 12 actions, 6 of them lifted something; TD error" in printed
    assert json.loads((tmp_path / "done.json").read_text())["updates"] == 100
    tuned = CameraPolicy.load(out)
    assert tuned.cfg == CFG
    assert tuned.decide(*BOTH)
    assert cli.main(arguments) == 2
    assert f"--out: {out} exists; give another name" in capsys.readouterr().err


def test_bad_records_are_refused(policy: CameraPolicy, tmp_path: Path):
    """Claim: a record that nothing can be learned from, or that is damaged, is one line that says
    where."""
    folder = _write(tmp_path / "record", *[(BOTH, _grasp(LEFT), Lifted)] * 2)
    (folder / "000001" / "depth.npy").unlink()
    with pytest.raises(SettingsError, match=r"^there is no file .*000001/depth\.npy[^\n]*$"):
        fine_tuning.run(policy, folder)
    empty = _write(tmp_path / "empty", (BOTH, _grasp(LEFT), None))
    lacks = r"^[^\n]*the record lacks an action with an outcome and an image after it[^\n]*$"
    with pytest.raises(SettingsError, match=lacks):
        fine_tuning.run(policy, empty)


def test_loss_that_is_not_finite(policy: CameraPolicy, lesson: Path):
    """Claim: where learning diverges, nothing is returned, and one line says what to change."""
    broken = dataclasses.replace(policy, params=jax.tree.map(lambda x: x * np.nan, policy.params))
    with pytest.raises(FailedError, match=r"not finite after 10 updates; lower learning_rate"):
        fine_tuning.run(broken, lesson, SETTINGS)
