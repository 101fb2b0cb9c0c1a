"""`csac-jax scenes certify`: scenes in which a push must come before a grasp."""

import dataclasses
import typing
from pathlib import Path
from typing import Any, Literal

import tyro

from csac_jax import presets
from csac_jax.cli import output, parsing
from csac_jax.cli.failures import check_seed
from csac_jax.config import SceneConfig, SlotKind
from csac_jax.errors import SettingsError
from csac_jax.io import files
from csac_jax.runtime import processes
from csac_jax.section import require


@dataclasses.dataclass(frozen=True)
class CertifyOptions:
    """Keeps the candidates in which at most 1 % of all grasps lift, and after the best of 64 pushes
    at least 10 %. Each is saved as it is judged: the same command goes on from there."""

    sources: tyro.conf.Positional[tuple[str, ...]]
    """Constructions of one suite by name, or one folder of case files."""
    out: Path
    """File to write the scenes and their certificates to: .npz."""
    count: int = 10
    """Candidates of each construction."""
    seed: int = 0
    """Seed of the first candidate; each further one has the next."""
    jobs: int = 0
    """Candidates at a time, one a core; 0 for one per core. 1 has all cores, or the GPU."""
    physics: Literal["c", "warp"] = "c"
    """Engine of the search. With warp, C MuJoCo certifies what passes."""


def run(arguments: list[str]) -> int:
    """Runs the command; returns the exit code."""
    return parsing.subcommand("scenes", {"certify": _certify}, arguments)


def _certify(arguments: list[str]) -> int:
    options = parsing.parse(CertifyOptions, arguments, "scenes certify")
    _check(options)
    from csac_jax.evaluation import certification
    from csac_jax.scenes import certify, constructions

    scene_cfg, candidates = _candidates(options)
    base = presets.TEN_BLOCKS.change(scene=scene_cfg, sim={"physics": "c", **constructions.SIM})
    cfgs = [base]
    if options.physics == "warp":  # whose meshes have one size
        alike = {"size_jitter": (base.scene.size_jitter[0], 0.0)}
        cfgs = [base.change(scene=alike, sim={"physics": "warp"}), base]
    certified = certify.CertifiedScenes(certification.settings(base), {})
    if options.out.exists():
        stored = certify.load(options.out)
        if stored.settings != certified.settings:
            raise SettingsError(f"--out: {options.out} was made by other settings; take a new name")
        certified = stored
    judged = {one[:2] for one in certified.entries}
    tasks = [(cfgs, *candidate) for candidate in candidates if candidate[:2] not in judged]
    with output.progress() as bar:
        task = bar.add_task("candidates", total=len(tasks))

        def on_done(_: int, result: Any) -> None:
            certificate, scene = result
            certified.entries[certificate] = scene
            files.replace(options.out, certify.encode(certified))
            bar.update(task, advance=1, description=f"candidates, {len(certified.kept)} kept")

        jobs = 1 if options.physics == "warp" else options.jobs or processes.cores()
        processes.each(_judge, tasks, jobs, lambda *_: None, on_done)
    kept = len(certified.kept)
    print(f"{options.out}: {kept} scenes, {len(certified.entries) - kept} candidates refused")
    return 0


def _judge(_: Any, cfgs: Any, generator: str, seed: int, scene: Any) -> tuple[Any, Any]:
    """Returns the certificate of the last config, or of the first that refuses; and the scene."""
    from csac_jax.evaluation import certification
    from csac_jax.runtime import cache

    cache.enable()
    for cfg in cfgs:
        certificate = certification.judge(certification.make_lab(cfg), scene, generator, seed)
        if certificate.push < 0:
            return certificate, None
    return certificate, scene


def _check(options: CertifyOptions) -> None:
    check_seed(options.seed)
    require(bool(options.sources), "sources: give constructions, or a folder of case files")
    fits = 1 <= options.count <= 100_000 and 0 <= options.jobs <= 1024
    require(fits, "--count must lie in 1 .. 100000, --jobs in 0 .. 1024")
    require(options.out.suffix == ".npz", f"--out: {options.out} must end in .npz")
    if options.physics == "warp":
        import jax

        if jax.default_backend() != "gpu":
            raise SettingsError("--physics: warp computes on CUDA, and JAX sees none here; take c")


def _candidates(options: CertifyOptions) -> tuple[SceneConfig, list[tuple[str, int, Any]]]:
    """Returns the scenes' config; source, seed and scene of every candidate."""
    import jax

    from csac_jax.scenes import cases, constructions

    first, *others = options.sources
    if not others and Path(first).is_dir():
        loaded = {path.stem: cases.load(path) for path in sorted(Path(first).glob("*.json"))}
        slots: tuple[SlotKind, ...] = ()
        for kind in typing.get_args(SlotKind):
            slots += (kind,) * max((c.slots.count(kind) for c in loaded.values()), default=0)
        require(bool(slots), f"{first}: holds no case file")
        seated = [(name, 0, cases.seat(case, slots)) for name, case in loaded.items()]
        return SceneConfig(slots=slots, min_blocks=1), seated
    known = {**constructions.TRAIN, **constructions.TEST}
    for source in options.sources:
        if source not in known:
            names = ", ".join(known)
            raise SettingsError(f"'{source}' is neither a folder of case files nor one of: {names}")
        if known[source].suite != known[first].suite:
            raise SettingsError(f"{first} and {source} are of two suites; give those of one")
    seeds = range(options.seed, options.seed + options.count)
    made = [
        (name, n, known[name].make(jax.random.key(n))) for name in options.sources for n in seeds
    ]
    return constructions.SUITES[known[first].suite], made
