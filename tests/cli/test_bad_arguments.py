"""Arguments that no command can take: one line, exit code 2, and nothing begins or is written."""

from pathlib import Path

import pytest

from csac_jax import api, cli
from csac_jax.runtime import signals
from csac_jax.sweeps import runner
from tests.deploy import image_files, scenes

EXTRAS = {"calibrate": "cv2", "serve": "uvicorn", "export": "jax2onnx"}
IMAGE = image_files.rounded(scenes.take(scenes.blocks_at([[0.1, 0.09, 0.4]])))
LENS = "--rgb a.png --intrinsics c.json"
TAUS = ",".join(f"0.{i:03d}" for i in range(100, 205))
BAD = [  # command, message
    ("trian quick", "'trian'; did you mean train? choose one of: demo, train, sweep"),
    ("train --seed 3", "give a preset first, one of: smoke, quick"),
    ("train quik", "unknown preset 'quik'; did you mean quick? choose one of: smoke, quick"),
    ("train quick --learn.bath 3", "--learn.bath 3; perhaps you meant --learn.batch; see csac"),
    ("train quick --learn.tau 2", "learn.tau: must be at most 1, not 2.0"),
    ("train quick --net.norm=batch", "--net.norm=batch: --net.kind small has no such setting"),
    (f"train quick --replay.capacity {2**30}", "replay.capacity: "),  # larger than memory
    ("train smoke --device tpu", "--device: 'tpu' is not one of: cpu, gpu"),
    ("train quick smoke", "unknown arguments: smoke"),
    ("train smoke --sim.physics warp --scene.size-jitter 0.1 0", "warp computes on CUDA"),
    ("train smoke --algo dqn", "unknown algorithm 'dqn'; choose one of: csac, csac_per"),
    ("sweep smoke --seeds 2 --seed 2147483647", "no seed may exceed 2147483647"),
    ("sweep smoke --vary replay.sampler=uniform --replay.end 1 4", "uniform has no such setting"),
    ("sweep smoke --vary learn.tau=x,0.1", "could not convert string to float: 'x'"),
    ("sweep smoke --devices 4096", "devices: 4096 asked for, there are "),
    ("sweep smoke --sim.physics c --devices 2", "--sim.physics: c computes on the host's cores"),
    ("sweep smoke --replay.capacity 65536 --seeds 9999", "lower seeds, set together or raise dev"),
    (f"sweep smoke --vary learn.tau={TAUS} --vary target.gamma={TAUS}", "more than 10000"),
    ("sweep smoke --cluster", "several processes need --run-dir"),
    ("sweep smoke --run-dir y --coordinator a:1 --processes 2 --process-id 2", "process_id: must "),
    ("sweep --resume x --learn.tau 0.1", "leave all others out"),
    ("eval", "these arguments are missing: source"),
    ("eval . --episodes 0", "--episodes: at least 1"),
    ("eval shipped --which worst", "--which: 'worst' is neither best, last nor a step"),
    ("eval shipped --suite nowhere", "'nowhere' is neither a case file nor one of: in_distr"),
    ("eval shipped --suites cases target", "--suites: several need --out DIR"),
    ("eval shipped --suites all", "--suites: several need --out DIR"),
    ("eval shipped --out . --json a.json", "--json: is for a single suite"),
    ("eval shipped --out . --share 0", "--share: above 0"),
    ("eval shipped --out . --jobs -1", "--jobs: must lie in"),
    ("eval shipped --out . --suites nowhere", "'nowhere' is neither a case file nor one of"),
    ("eval shipped_clutter --suite pile", "objects: pile needs a library"),
    ("eval shipped_clutter --objects x", "'in_distribution' has no objects of a library"),
    ("play --scene pile", "objects: pile needs a library"),
    ("play --scene nowhere", "--scene: 'nowhere' is neither a case file nor one of: random"),
    ("play --scene cases", "--scene: cases has several parts"),
    ("play --size 95 64", "--size: both numbers must be even"),
    ("play --png a.txt", "a.txt: its name must end in"),
    ("play --video a.png", "a.png: its name must end in"),
    ("doctor --build", "--build: only warp has kernels to build, and sim.physics is c here"),
    ("bench spet", "bench: unknown benchmark 'spet'; choose one of: "),
    ("objects mak", "mak"),
    ("objects make --out x --count 9999", "--count"),
    ("objects make --out x --seed -1", "--seed"),
    ("objects make --out .", "--out: . exists"),
    ("objects show procedural:0:3 --png x.txt", ".png"),
    ("objects import nowhere --out x", "nowhere does not exist"),
    ("objects import . --out x", "no mesh file"),
    ("objects import . --out x --density 5", "--density"),
    ("scenes certify bars", "--out"),
    ("scenes certify nowhere --out x.npz", "'nowhere' is neither a folder"),
    ("scenes certify bars --out x.txt", "--out: x.txt must end in .npz"),
    ("scenes certify bars --out x.npz --count 0", "--count"),
    ("scenes certify . --out x.npz", "holds no case file"),
    ("act shipped {} --top 0", "top: must lie in 1 .. 64, not 0"),
    ("act shipped {} --gripper frank", "csac-jax: --gripper: 'frank' is neither one of 2f85, "),
    ("act shipped {} --check --record r", "--record: --check decides nothing"),
    ("act shipped {} --record .", "is no record: it has no record.json"),
    ("serve shipped --host 0.0.0.0", "give --token-file too"),
    ("serve shipped --token-file rgb.png", "must have 16 printable characters or more"),
    ("serve shipped --port 70000", "--port: "),
    ("finetune shipped nowhere", "nowhere is no record: it has no record.json"),
    ("finetune shipped nowhere --out new.bin", "--out: new.bin must end in .safetensors"),
    ("finetune shipped nowhere --updates 0", "--updates: "),
    ("export shipped p.safetensors --average shipped_clutter", "has critic.params."),
    ("export shipped p.onnx --format onnx --input image", "needs --format stablehlo"),
    ("calibrate", "calibrate: give --rgb and --intrinsics, or --board FILE to print"),
    (f"calibrate {LENS} --rgb a.png b.png", "--rgb: one image of a board on the table"),
    (f"calibrate {LENS} --robot d.json", "--robot and --workspace go together"),
    (f"calibrate {LENS} --square 30", "the side of a square in m"),
]
MISSING = [  # what is not there has exit code 1
    ("sweep --resume nowhere", "there is no sweep.json in nowhere"),
    ("play --policy nowhere", "there is no folder nowhere"),
    ("act nowhere {}", "there is no folder nowhere"),
    ("objects show nowhere", "nowhere: no library"),
]


@pytest.mark.parametrize(
    ("command", "message", "code"), [*((*row, 2) for row in BAD), *((*row, 1) for row in MISSING)]
)
def test_bad_arguments(
    command: str,
    message: str,
    code: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
):
    """Claim: what a command cannot do, or not safely, is one line that names the option or the
    thing; nothing begins, and nothing is written."""

    def forbidden(*_: object, **__: object) -> None:
        raise AssertionError("it began")

    pytest.importorskip(EXTRAS.get(command.split()[0], "csac_jax"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(api, "Terminal", forbidden)
    monkeypatch.setattr(runner, "run", forbidden)
    monkeypatch.setattr(signals, "install", signals.Stop)
    if "{}" in command or "rgb.png" in command:
        command = command.format(" ".join(image_files.write(tmp_path, IMAGE)))
    before = sorted(tmp_path.rglob("*"))
    assert cli.main(command.split()) == code
    captured = capsys.readouterr()
    assert message in captured.err
    assert (captured.out, captured.err.count("\n")) == ("", 1)
    assert sorted(tmp_path.rglob("*")) == before
