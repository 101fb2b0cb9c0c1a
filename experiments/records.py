"""Writes experiments/results/README.md: what each record shows, its folder and its command."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from csac_jax.report import results, tables

RESULTS = Path(__file__).resolve().parent / "results"
COPIES = "the same on another host"

RUNS = {
    "quick/csac_beta": "what `quick` learns on two CPU cores",
    "quick/yaws16": "the same in sixteen yaws and without mirror images",
    "quick/random": "the floor: random places above blocks",
    "quick/oracle": "the ceiling: a planner that reads the blocks' poses",
    "paper_small/csac_beta": "CSAC-beta by the paper's protocol with the small net",
    "paper_small/csac_beta-2": f"{COPIES}; the four cases",
    "paper_small/csac_beta-3": COPIES,
    "paper_small/csac_per": "CSAC-PER likewise; the four cases",
    "paper_small/csac_per-2": COPIES,
    "paper_small/csac": "CSAC likewise; the four cases",
    "paper_small/csac-2": COPIES,
    "paper_small/vpg": "VPG likewise, in its first variant; the four cases",
    "paper_small/vpg-2": COPIES,
    "paper_small/reactive": "P+G reactive likewise; the four cases",
    "paper_small/reactive-2": COPIES,
    "paper_small/grasp_only": "Grasping-only likewise; the four cases",
    "paper_small/grasp_only-2": COPIES,
    "paper_small/max_target": "ablation: no softmax in the target",
    "paper_small/argmax": "ablation: the best cell, no cross-entropy search",
    "paper_small/power_law": "ablation: VPG's power law in place of the Beta law",
    "paper_small/no_actor": "ablation: no actor",
    "paper_small/one_critic": "ablation: one critic",
    "paper_small/no_push_reward": "ablation: no reward for pushes",
    "paper_small/no_colour": "ablation: heights alone",
    "paper_small/no_augmentation": "ablation: no shifts and no symmetries",
    "paper_small/no_shift": "ablation: no shifts",
    "paper_small/target_csac_beta": "the target protocol of secs. 4.3 and 4.4: CSAC-beta",
    "paper_small/target_csac_per": "the target protocol: CSAC-PER",
    "paper_small/target_csac": "the target protocol: CSAC",
    "paper_small/target_vpg": "the target protocol: VPG as its authors wrote it",
    "paper_small/target_vpg_episodic": "the target protocol: VPG in its first variant",
    "paper_small/target_reactive": "the target protocol: P+G reactive",
    "paper_small/target_grasp_only": "the target protocol: Grasping-only",
    "paper_small/target_stored_labels": "the target protocol: pushes labelled once",
    "paper_small/target_offset": "the target protocol: Q between cells, search from the actor",
    "paper_small/push_target_bonus1_gamma02": "bonus and discount of pushes: as in the preset",
    "paper_small/push_target_bonus1_gamma05": "the same: a larger discount",
    "paper_small/push_target_bonus0_gamma02": "the same: no bonus",
    "paper_small/push_target_bonus0_gamma05": "the same: neither",
    "paper_small/push_packed_bonus1_gamma02": "the same in packed scenes, the table cleared",
    "paper_small/push_packed_bonus1_gamma05": "a larger discount there",
    "paper_small/push_packed_bonus0_gamma02": "no bonus there",
    "paper_small/push_packed_bonus0_gamma05": "neither there",
    "paper_small/switch_sensed": "rewards by finger gap and depth",
    "paper_small/switch_anywhere": "actions anywhere",
    "paper_small/switch_oblique": "an oblique camera",
    "paper_small/switch_noisy": "an oblique camera with noise",
    "paper_small/switch_ur5": "the UR5",
    "paper_small/switch_together": "all of these together",
    "paper/csac_beta": "the paper's protocol with DenseNet-121",
    "paper/csac_beta-2": "more seeds of it",
    "paper/csac_beta-3": "more seeds of it",
    "objects/csac_beta": "what `objects` learns on two CPU cores; other work on both",
    "objects/from_shipped": "the same by `--init shipped`; other work on both",
    "objects/from_shipped_slow": "the same, smaller steps and less exploration",
    "objects/from_shipped_retry": "from `shipped`, six objects, bolder retries",
    "objects/from_shipped_ten": "from `shipped`, five to ten objects, bolder retries",
    "objects/gpu": "five to ten objects of families alone, `--init shipped`, on a GPU",
    "objects/gpu_mixed": "the same, half of them assemblies, which had no walls yet",
    "objects/gpu_hollow": "from `objects/gpu_mixed`, assemblies with walls",
    "objects/gpu_hollow_large_steps": "the same, steps 2.5 times as large",
    "objects/gpu_longer": "from `gpu_hollow`, twice the shapes",
    "objects/gpu_averaged": "from `gpu_longer`; evaluations are of their mean",
    "objects/gpu_cones": "from that mean, by cones; evaluations are of `shipped_objects`",
    "objects/gpu_mixed_uniform": "the same, replay uniform and of 131,072",
    "objects/gpu_fine": "from nothing, on maps of 96 cells",
    "objects/gpu_grippers": "a gripper that varies, from `objects/gpu`",
    "objects/gpu_target": "the policy `shipped_target`, from `objects/gpu`",
    "objects/gpu_target_mixed": "the same from `objects/gpu_mixed`, among assemblies",
    "grippers/from_shipped": "a gripper that varies, by `--init shipped` on two CPU cores",
    "grippers/from_shipped_gpu": "the policy `shipped_grippers`, the same on a GPU",
    "grippers/longer_gpu": "twice as many actions more",
    "objects/oracle": "a planner that reads the objects' poses",
    "objects/geometric": "antipodal grasps from the edges of the height map",
    "objects/target": "what `objects_target` learns on two CPU cores; other work on both",
    "objects/target_oracle": "the planner in the target task",
    "objects/target_random": "random places above the target",
    "fast/csac_beta": "what `fast` learns on one GPU",
    "fast/short": "half as many actions",
    "fast/half_rate": "half the learning rate",
    "fast/scenes_8192": "twice as many scenes, half as many updates",
    "fast/slow_decay": "half as many actions, exploration that ends later",
    "fast/scenes_4096": "exploration that ends later, one and a half times as many actions",
    "fast/scenes_2048": "half the scenes, fewer actions, a net with three times the parameters",
    "fast/long": "the same, three times as many actions",
    "fast/shipped": "the shipped policy (seed 0) on every suite",
    "fast/piles": "piles of up to 30 blocks and packed scenes, by `--init shipped`",
    "fast/clutter": "the policy `shipped_clutter`, from `fast/piles`",
    "fast/camera": "the policy `shipped_camera`, by `--init shipped`",
    "fast/camera_heights": "the same of heights alone, from nothing; stopped at 159,744 actions",
    "fast/updates_128": "2,048 scenes, the wide net, 128 updates",
    "fast/small_net": "the same with the net of `fast`",
    "fast/target": "the target task",
    "fast/target_grasp_only": "the target task without pushes, Grasping-only",
    "fast/target_no_pushes": "the target task without pushes, CSAC-beta",
}
"""Folder of runs -> what it shows. Its command follows from its configs."""

SEARCHES = ("paper_small",)
"""Presets whose settings were searched."""

_NET = "--net.head 96 --net.growth 64 --net.stem 48"
_WIDE = f"--train.scenes 2048 --learn.updates 64 {_NET}"
_FORMER = f"train fast {_WIDE} --train.actions 163840 --explore.decay 0.9999"
"""What `fast` was when these were recorded."""

_SEEDS_OF_PAPER_SMALL = "paper_small --sim.physics c --seeds 16"
_SEEDS_OF_FAST = (
    "fast --sim.physics c --seeds 8 --train.scenes 64 --train.actions 640 "
    "--train.learning-starts 64 --scene.pool 8"
)
_QUICK = (
    "quick --net.rotations 16 --net.growth 32 --learn.updates 2 --learn.learning_rate 1e-3 "
    "--explore.decay 0.998"
)
"""What `quick` was when these were recorded."""

BENCHES = {
    "train/xeon-quick": ("a run as `quick` was, Intel Xeon", f"train {_QUICK}"),
    "train/epyc-quick": ("the same, AMD EPYC", f"train {_QUICK}"),
    "train/h200-paper-cold": ("compilation of `paper`", "train paper --train.actions 50"),
    "train/h200-paper-cached": ("the same from the cache", "train paper --train.actions 50"),
    "train/h200-fast-cold": (
        "compilation of `fast` in MJX",
        f"train fast --sim.physics mjx --train.actions 4096 {_WIDE}",
    ),
    "train/h200-fast-cached": (
        "the same from the cache",
        f"train fast --sim.physics mjx --train.actions 4096 {_WIDE}",
    ),
    "train/h200-fast-warp": ("a whole run of a wide net in 2,048 scenes", _FORMER),
    "train/h200-fast-4096": (
        "the same, more scenes and a smaller net",
        "train fast --train.actions 163840 --learn.updates 64 --explore.decay 0.9999",
    ),
    "train/h200-fast-4096-long": (
        "three times as many actions",
        "train fast --train.actions 491520 --learn.updates 64 --explore.decay 0.9999",
    ),
    "train/h200-fast-8192-long": (
        "more scenes, larger updates",
        "train fast --train.scenes 8192 --train.actions 491520 --learn.updates 128 "
        "--learn.batch 128 --explore.decay 0.9999",
    ),
    "train/h100-fast": ("a wide net in 2,048 scenes, in steps of 5.1 ms", _FORMER),
    "train/h100-fast-4ms": (
        "the same in steps of 4 ms, with STEP = 0.004; ten cores were busy",
        _FORMER,
    ),
    "train/h100-fast-4096": (
        "the first, more scenes and a smaller net",
        "train fast --train.actions 327680 --explore.decay 0.9999",
    ),
    "train/h100-fast-target": (
        "the target task",
        "train fast --task.kind target --train.actions 61440",
    ),
    "train/h100-fast-alone": ("a process alone", "train fast --seed 3 --train.actions 122880"),
    "train/h100-fast-pair-0": (
        "with CUDA_VISIBLE_DEVICES=0, at the same time as the next",
        "train fast --seed 4 --train.actions 122880",
    ),
    "train/h100-fast-pair-1": (
        "with CUDA_VISIBLE_DEVICES=1",
        "train fast --seed 4 --train.actions 122880",
    ),
    "train/h200-fast-single": (
        "a process alone on one of four H200s",
        "train fast --seed 0 --train.actions 163840",
    ),
    **{
        f"train/h200-fast-four-{gpu}": (
            f"with CUDA_VISIBLE_DEVICES={gpu}, four at the same time",
            f"train fast --seed {gpu} --train.actions 163840",
        )
        for gpu in range(4)
    },
    "doctor/h100": ("Warp's kernels of `fast`, built from nothing", "doctor --build"),
    "start/epyc-quick": (
        "how soon `quick` learns, and did in commit 71c8723, one run after another",
        "bench start quick --other CHECKOUT",
    ),
    "start/epyc-quick-yaws16": (
        "the same in sixteen yaws, which `quick` had then",
        "bench start quick --other CHECKOUT",
    ),
    "warp_action/h100-2048": (
        "an action on Warp, kernel by kernel",
        "bench warp_action --repeats 3 --details",
    ),
    "warp_action/h100-16384": ("16,384 scenes", "bench warp_action --scenes 16384"),
    "warp_action/h100-blocks": ("5 and 20 blocks", "bench warp_action --blocks 5 20"),
    "warp_action/h100-lanes": (
        "halves and quarters of the scenes on CUDA streams of their own; no longer in the code",
        "bench warp_action --lanes 2 4 --repeats 3",
    ),
    "warp_action/h100-contacts": (
        "contacts in the same order in every run",
        "bench warp_action --scenes 512 --repeats 2 --repeatable contacts",
    ),
    "warp_action/h100-rows": (
        "and the rows of constraints",
        "bench warp_action --scenes 512 --repeats 2 --repeatable contacts rows",
    ),
    "warp_action/h100-smooth": (
        "and the sums over bodies",
        "bench warp_action --scenes 512 --repeats 1 --repeatable contacts rows smooth",
    ),
    "warp_kernels/h100": ("physics' kernels by the GPU's counters", "bench warp_kernels"),
    "warp_action/h100-scenes": (
        "an action against scenes",
        "bench warp_action --scenes 512 4096 8192 --repeats 2",
    ),
    "warp_action/h100-target": (
        "an action of the target task",
        "bench warp_action --task target --repeats 2",
    ),
    "step/epyc-quick": ("a step of `quick` and its stages", "bench step quick"),
    "learner/epyc-quick": (
        "share of the float32 peak that the parts of an update of `quick` reach",
        "bench learner",
    ),
    "benchmark/epyc-tenth": (
        "what ships and its baselines in every suite",
        "benchmark --share 0.1",
    ),
    "step_kernels/h100-fast": ("kernels of a step by what they do", "bench step_kernels fast"),
    "step_kernels/h200-fast-8192": (
        "the same in MJX's physics, 8,192 scenes",
        "bench step_kernels fast --sim.physics mjx --train.scenes 8192",
    ),
    "step_kernels/h200-fast-8192-two": (
        "the same, the scenes over two GPUs",
        "bench step_kernels fast --sim.physics mjx --train.scenes 8192 --devices 2",
    ),
    "step_kernels/h200-fast-8192-four": (
        "the same, the scenes over four GPUs",
        "bench step_kernels fast --sim.physics mjx --train.scenes 8192 --devices 4",
    ),
    "step_kernels/h200-fast-seeds8": (
        "the same, eight seeds of 2,048 scenes, with XLA_PYTHON_CLIENT_MEM_FRACTION=0.93",
        "bench step_kernels fast --sim.physics mjx --train.scenes 2048 --seeds 8",
    ),
    "step_kernels/h200-fast-seeds8-two": (
        "the same, the seeds over two GPUs",
        "bench step_kernels fast --sim.physics mjx --train.scenes 2048 --seeds 8 --devices 2",
    ),
    "step_kernels/h200-paper_small-16": (
        "the same of 16 seeds of `paper_small`",
        f"bench step_kernels {_SEEDS_OF_PAPER_SMALL}",
    ),
    "step_kernels/h200-paper_small-16-grouped": (
        "the same before the small net convolved by taps",
        f"bench step_kernels {_SEEDS_OF_PAPER_SMALL}",
    ),
    "step_kernels/h200-fast-64-seeds8": (
        "the same of eight seeds of `fast`, 64 scenes",
        f"bench step_kernels {_SEEDS_OF_FAST}",
    ),
    "step_kernels/h200-fast-64-seeds8-grouped": (
        "the same before the small net convolved by taps",
        f"bench step_kernels {_SEEDS_OF_FAST}",
    ),
    "step/xeon-quick": ("a step as `quick` was, Intel Xeon", f"bench step {_QUICK}"),
    "step/epyc-quick-scenes": (
        "such a step against scenes",
        f"bench step {_QUICK} --repeats 3 --curve scenes --smallest 4 --largest 32",
    ),
    "step/epyc-quick-map": (
        "a step against cells of the map",
        f"bench step {_QUICK} --repeats 3 --curve map --smallest 32 --largest 128",
    ),
    "step/epyc-quick-blocks": (
        "a step against blocks",
        f"bench step {_QUICK} --repeats 3 --curve blocks --smallest 2 --largest 8",
    ),
    "step/epyc-quick-capacity": (
        "a step against the replay's capacity",
        f"bench step {_QUICK} --repeats 3 --curve capacity --smallest 1024 --largest 16384",
    ),
    "step/h200-fast": (
        "a step of a wide net in 2,048 scenes on Warp, and its stages",
        f"bench step fast --physics warp --repeats 3 {_WIDE}",
    ),
    "sweep/epyc-quick": (
        "seeds of `quick` one after another",
        f"bench sweep {_QUICK} --seeds 1 4 --steps 10 --repeats 2",
    ),
    "sweep/h200-paper_small": (
        "seeds of `paper_small` side by side",
        "bench sweep paper_small --seeds 1 4 16 --steps 10 --repeats 10",
    ),
    "sweep/h200-paper_small-2": (
        COPIES,
        "bench sweep paper_small --seeds 1 4 16 --steps 10 --repeats 10",
    ),
    "sweep/h200-paper": (
        "16 seeds of `paper` side by side",
        "bench sweep paper --seeds 16 --steps 13 --repeats 1",
    ),
    "sweep/h200-fast-seeds": (
        "seeds over GPUs, 512 scenes each, 128 updates",
        "bench sweep fast --physics mjx --steps 1 --devices 1 2 4 --seeds 4 "
        f"--train.scenes 512 --learn.updates 128 {_NET}",
    ),
    "sweep/h200-fast-seeds2048": (
        "seeds over GPUs, 2,048 scenes each",
        f"bench sweep fast --physics mjx --steps 1 --repeats 1 --devices 1 2 --seeds 4 {_WIDE}",
    ),
    "sweep/h200-fast-seeds8": (
        "eight seeds over GPUs, 2,048 scenes each",
        "bench sweep fast --physics mjx --steps 1 --repeats 1 --devices 1 2 4 --seeds 8 "
        "--train.scenes 2048",
    ),
    "sweep/h200-fast-scenes": (
        "scenes of one seed over GPUs, 128 updates",
        "bench sweep fast --physics mjx --steps 1 --devices 1 2 4 --seeds 1 "
        f"--shard scenes --train.scenes 2048 --learn.updates 128 {_NET}",
    ),
    "sweep/h200-fast-scenes8192": (
        "8,192 scenes of one seed over GPUs",
        "bench sweep fast --physics mjx --steps 1 --repeats 1 --devices 1 2 4 --seeds 1 "
        "--shard scenes --train.scenes 8192",
    ),
    "sweep/h100-fast-seeds1024": (
        "eight seeds over GPUs, 1,024 scenes each",
        "bench sweep fast --physics mjx --steps 1 --repeats 1 --devices 1 4 --seeds 8 "
        "--train.scenes 1024",
    ),
    "act/cpu": ("dense Q maps of DenseNet-121", "bench act --pixels 64 --states 4 --repeats 7"),
    "act/h200": ("dense Q maps of DenseNet-121 and VPG's way in PyTorch", "bench act"),
    "replay/cpu": ("the samplers and flashbax's; other work on both cores", "bench replay"),
    "replay/cpu-20": ("a million transitions; other work on both cores", "bench replay 20 20"),
    "replay/h200-12": ("the samplers and flashbax's", "bench replay 12 17"),
    "replay/h200-18": ("the same, larger rings", "bench replay 18 20"),
    "raycast/cpu": ("our rays and `mjx.ray`", "bench raycast --size 64 --scenes 32 --repeats 7"),
    "raycast/h200": ("our rays and `mjx.ray`", "bench raycast"),
    "parity/cpu": (
        "MJX against C MuJoCo, whole actions",
        "bench parity --primitives 512 --poses 125",
    ),
    "parity/cpu-warp": (
        "Warp against C MuJoCo, on the CPU",
        "bench parity --warp --primitives 128 --poses 16",
    ),
    "parity/h200-warp": (
        "Warp against C MuJoCo, whole actions",
        "bench parity --warp --primitives 500 --poses 25",
    ),
    "parity/h100-warp-off": (
        "Warp against C MuJoCo, grasps of which some fail, steps of 5.1 ms",
        "bench parity --warp --off --primitives 384 --poses 1",
    ),
    "one_step/cpu": ("MJX against C MuJoCo, one step", "bench one_step --states 1000"),
    "labels/cpu": ("outcomes by finger gap and by ground truth", "bench labels"),
    "robots/cpu": ("the UR5 against the floating hand", "bench robots --grasps 500"),
    "export/cpu": ("exported policies; much other work on both cores", "bench export"),
    "closed_loop/cpu": (
        "the shipped policy, the UR5 and MuJoCo's renderer; much other work on both cores",
        "bench closed_loop",
    ),
    "closed_loop/cpu-camera": (
        "the same of `shipped_camera`",
        "bench closed_loop --policy shipped_camera",
    ),
    "between_cells/cpu": (
        "what search between cells lifts; RUN by `train quick --net.kind offset --net.rotations 16 "
        "--policy.no-augment --cem.start actor --sim.physics c --seed 20`",
        "bench between_cells RUN",
    ),
    "objects/h100": (
        "objects against blocks on Warp, by convex parts an object",
        "bench objects --warp --scenes 1024",
    ),
    "objects/cpu": ("objects against blocks, by convex parts an object", "bench objects"),
    "geometric/cpu": (
        "weights of the geometric baseline, one after another; their terms `gap` and `margin` went",
        "bench geometric --episodes 40",
    ),
    "grippers/cpu": (
        "the planner and the shipped policy with each gripper; other work on both cores",
        "bench grippers",
    ),
    "grasp_depth/cpu": (
        "how low and how deep the tips should go among objects",
        "bench grasp_depth --episodes 40",
    ),
    "finetune/cpu": (
        "fine-tuning on 500 recorded grasps of fingers that open 65 mm; other work on both cores",
        "bench finetune",
    ),
    "finetune/cpu-85": (
        "the same of one that opens 85 mm",
        "bench finetune --opening-mm 85 --episodes 16",
    ),
    "serve/cpu": ("decisions over HTTP; other work on both cores", "bench serve"),
    "soak/h200": (
        "100,000 random actions: nothing lost, nothing infinite",
        "bench soak --actions 100000 --scenes 1024",
    ),
}
"""File of a benchmark -> what it shows, and its command."""

HEAD = """# Recorded results

Written by `make figures`. Each file holds the config, device, versions and commit it was made with.
[docs/results.md](../../docs/results.md) has the numbers of all runs, with intervals;
[docs/benchmarks](../../docs/benchmarks) has those of the benchmarks. Older records are in the
history of this folder.

| folder or file | holds |
|---|---|
| `PRESET/VARIANT/seed-K/` | a run: `config.json`, `metrics.jsonl`, `eval*.json` |
| `PRESET/VARIANT/*.json` | the sweep that made the runs, if one did |
| `search/PRESET/METHOD.json` | what a search of settings tried |
| `study/PART-TASK.tar.xz` | [study](../../docs/study.md) sweeps, read by `csac-jax report` |
| `bench/NAME/DEVICE-*.json` | what `csac-jax bench NAME`, or a short `csac-jax train`, wrote |

Files keep the names of settings and metrics that they were written with. A variant that ends in a
number repeats the one without. Most runs on H200s shared a host, so their seconds are upper bounds.

"""


def readme() -> str:
    """The whole file."""
    return f"{HEAD}{tables.table_text([*_runs(), *_searches(), *_benches()])}\n"


def _runs() -> Iterator[dict[str, str]]:
    for name, claim in RUNS.items():
        found = results.read([RESULTS / name])
        commands = dict.fromkeys(_commands(found, RESULTS / name))
        record = (found.runs or found.evaluations)[0].record
        yield _row(claim, name, "; ".join(f"`{command}`" for command in commands), record)


def _commands(found: results.Results, folder: Path) -> Iterator[str]:
    """How the runs of a folder were trained, then measured."""
    seeds = [str(run.config["seed"]) for run in found.runs]
    for run in found.runs[:1]:
        command = results.command(run)
        if (folder / "sweep.json").exists():
            command = command.replace("csac-jax train", "csac-jax sweep")
            yield command.replace("--seed ", f"--seeds {len(seeds)} --seed ")
        else:
            yield command.replace(f"--seed {seeds[0]}", f"--seed {'|'.join(seeds)}")
    trained = found.runs[0].config if found.runs else None
    yield from (results.command(one, trained) for one in found.evaluations)


def _searches() -> Iterator[dict[str, str]]:
    for preset in SEARCHES:
        for path in sorted((RESULTS / "search" / preset).glob("*.json")):
            record = json.loads(path.read_text())
            method, name = record["algo"], path.relative_to(RESULTS).as_posix()
            run = f"run {preset} FOLDER --methods {method} --trials {record['budget']['settings']}"
            kept = f"record FOLDER --actions {record['budget']['actions']}"
            commands = f"`python -m experiments.search {run}`; `... {kept}`"
            yield _row(f"settings searched for {method}", name, commands, record)


def _benches() -> Iterator[dict[str, str]]:
    for name, (claim, command) in BENCHES.items():
        path = f"bench/{name}.json"
        record = json.loads((RESULTS / path).read_text())
        yield _row(claim, path, f"`csac-jax {command}`", record)


def _row(claim: str, path: str, command: str, record: dict[str, Any]) -> dict[str, str]:
    link = f"[{path}]({path})"
    device = record.get("device", "not recorded")  # of a sweep that was stopped
    return {"claim": claim, "folder": link, "command": command, "device": device}


if __name__ == "__main__":
    (RESULTS / "README.md").write_text(readme())
