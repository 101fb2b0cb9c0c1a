"""`csac-jax export`: a policy as one file."""

import dataclasses
from pathlib import Path
from typing import Any, Literal

import tyro

from csac_jax.cli import settings
from csac_jax.cli.failures import check_extra
from csac_jax.cli.robot_options import PolicyOptions, check_size, naming_the_option
from csac_jax.config import Config
from csac_jax.errors import SettingsError
from csac_jax.section import require


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExportOptions(PolicyOptions, settings.DecisionOptions):
    """Writes a policy, networks and config, into one file.

    Settings of view and hand, such as --sim.gripper and --sensor.dropped, go into its config: a
    policy that learned with many hands and noises is measured with those of the file.
    """

    file: tyro.conf.Positional[Path]
    """File to write, which must not exist, such as policy.safetensors."""
    format: Literal["safetensors", "stablehlo", "onnx"] = "safetensors"
    """safetensors: a policy file for the other commands. stablehlo: a program that jax runs alone.
    onnx: one that onnxruntime runs alone, of the small net; it takes the best cell."""
    average: str | None = None
    """Another policy, with the same networks and trained from the same start, such as the start
    itself. Each number of the networks is the mean of both policies' (Wortsman et al. 2022)."""
    card: tuple[Path, ...] = ()
    """Results of `eval`, files or folders of them, for a model card, README.md beside the file. Its
    head is the `model-index` that model hubs read; change the licence there if it is not yours."""
    input: Literal["maps", "image"] = "maps"
    """Input of a program: colour and height map, or (stablehlo) a camera's image and pose."""
    size: tuple[int, int] = (640, 480)
    """Width and height of that image, px."""


@naming_the_option()
def run(arguments: list[str]) -> int:
    """Writes the file; returns the exit code."""
    options, view = settings.parse_view(ExportOptions, "export", arguments)
    _check(options)
    from csac_jax import deploy
    from csac_jax.io import configs, files, policy_file
    from csac_jax.report import model_card, results

    evaluated = model_card.read(options.card) if options.card else []
    policy = deploy.CameraPolicy.load(options.policy, gripper=options.gripper)
    cfg = policy.cfg.change(**view, policy=options.decision)
    params = policy.params if options.average is None else _mean(policy.params, options.average)
    if options.format == "safetensors":
        policy_file.save(options.file, params, cfg)
    else:
        files.replace(options.file, _program(options, cfg, params))
    print(f"wrote {options.file}, {options.file.stat().st_size} bytes")
    if evaluated:
        record = results.training_record(Path(options.policy), configs.to_dict(policy.cfg))
        print(f"wrote {model_card.write(options.file, cfg, evaluated, record)}")
    return 0


def _check(options: ExportOptions) -> None:
    file, suffix = options.file, f".{options.format}"
    require(file.suffix == suffix, f"{file}: the name must end in {suffix}, see --format")
    require(not file.exists(), f"{file} exists; give another name")
    beside = file.with_name("README.md")
    require(not (options.card and beside.exists()), f"--card: {beside} exists; give another folder")
    fits = options.input == "maps" or options.format == "stablehlo"
    require(fits, "--input image: needs --format stablehlo")
    check_size(options.size)
    if options.format == "onnx":
        check_extra("--format onnx", "jax2onnx", "export")


def _mean(params: Any, source: str) -> Any:
    """Returns the mean of these networks and another policy's."""
    import jax

    from csac_jax import deploy
    from csac_jax.io import leaves

    other = deploy.CameraPolicy.load(source).params
    if difference := leaves.difference(leaves.layout(other), leaves.layout(params)):
        name, has, asked = difference
        fault = f"--average {source}: has {name} as {has}, the first policy as {asked}"
        raise SettingsError(f"{fault}; give policies with the same networks")
    return jax.tree.map(lambda a, b: 0.5 * (a + b), params, other)


def _program(options: ExportOptions, cfg: Config, params: Any) -> bytes:
    import jax

    from csac_jax.deploy import stablehlo

    params = jax.device_get(params)
    if options.format == "onnx":
        from csac_jax.deploy import onnx

        return onnx.serialize(cfg, params)
    if options.input == "image":
        return stablehlo.serialize(*stablehlo.from_image(cfg, params, options.size))
    return stablehlo.serialize(*stablehlo.from_maps(cfg, params))
