"""The import contract: who may import what, read off the sources.

Imports point back along the data path: a module imports from its own stage and from those below it.
"""

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import csac_jax

PACKAGE = Path(csac_jax.__file__).parent

# Top first. Stages in one row do not import each other.
ORDER = (
    ("__main__",),
    ("cli",),
    ("api",),
    ("render", "report"),
    ("sweeps", "deploy", "gym"),
    ("evaluation",),
    ("training",),
    ("io",),
    ("env",),
    ("baselines",),
    ("replay", "agent"),
    ("nets",),
    ("vision",),
    ("sim",),
    ("scenes",),
    ("world",),
    ("robot",),
    ("objects",),
    ("geometry",),
    ("presets",),
    ("algorithms",),
    ("runtime",),
    ("config",),
    ("section",),
    ("grippers",),
    ("constants", "errors", "cache_folder", "assets", "reading"),
    ("__init__",),
    ("_guard", "_version"),
)
RANK = {stage: rank for rank, row in enumerate(ORDER) for stage in row}

# Module -> where it may be imported, as a stage or a file.
ONLY_IN = {
    "mujoco": ("world", "scenes", "robot", "sim", "render", "objects/descriptions.py"),
    "flax.linen": ("nets",),
    "flax.nnx": (),
    "optax": ("agent",),
    "orbax": ("io/checkpoint.py",),
    "tyro": ("cli",),
    "rich": ("training/progress.py", "report", "cli", "api"),
    "pydantic": ("io", "deploy", "grippers.py", "scenes/case_file.py"),
    "jax2onnx": ("deploy/onnx.py",),
    "cv2": ("deploy/board.py",),
    "fastapi": ("deploy/service.py",),
    "uvicorn": ("deploy/server.py",),
    "mcp": ("cli/mcp_tools.py",),
    "safetensors": ("io",),
    "matplotlib": ("render", "report"),
    "gymnasium": ("gym.py",),
    "imageio": ("render/media.py", "deploy/image_files.py"),
    "jinja2": ("report/page.py",),
    "viser": ("render/viewer.py",),
    "tensorboardX": ("training/trackers.py",),
    "wandb": ("training/trackers.py",),
    "mlflow": ("training/trackers.py",),
    "yaml": ("io/configs.py", "report/model_card.py"),
    "trimesh": ("objects", "render/viewer.py"),
    "coacd": ("objects/conversion.py",),
}
JIT_IN = (
    *("training", "sweeps", "evaluation", "deploy"),
    *("runtime/compiler.py", "sim/selftest.py"),  # small programs that test this machine
    "scenes/arrange.py",
    "agent/maps.py",  # where an arm reaches is a table, computed once
    "nets/networks.py",  # a net that is seen from several places of a step is traced once
    "gym.py",  # its users call it step by step
)
PURE = ("vision", "nets", "agent", "replay", "sim")  # no printing, no files
NOT_PURE = ("sim/quiet_mjx.py",)  # passes on what MJX prints as it is imported


def violations(root: Path) -> list[str]:
    """Returns every breach of the contract under `root`, as `file:line: text`."""
    sources = {path.relative_to(root).as_posix(): path for path in sorted(root.rglob("*.py"))}
    return [fault for name in sources for fault in _file_faults(name, sources[name].read_text())]


def _file_faults(name: str, source: str) -> Iterator[str]:
    stage = name.split("/")[0].removesuffix(".py")
    if stage not in RANK:
        yield f"{name}:1: stage '{stage}' has no place in the order"
        return
    aliases = {}
    tree = ast.parse(source)
    exempt = _for_type_checkers(tree) if name == "__init__.py" else set()
    for node in ast.walk(tree):
        for module in [] if node in exempt else _imported(node):
            if fault := _import_fault(name, stage, module):
                yield f"{name}:{node.lineno}: {fault}"
        aliases |= _aliases(node)
    for node in ast.walk(tree):
        if fault := _use_fault(name, stage, node, aliases):
            yield f"{name}:{node.lineno}: {fault}"


def _for_type_checkers(tree: ast.AST) -> set[ast.AST]:
    ifs = [node for node in ast.walk(tree) if isinstance(node, ast.If)]
    return {n for node in ifs if _full_name(node.test, {}) == "TYPE_CHECKING" for n in node.body}


def _imported(node: ast.AST) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom):
        if node.level:
            return ["." * node.level]
        return [f"{node.module}.{alias.name}" for alias in node.names]
    return []


def _aliases(node: ast.AST) -> dict[str, str]:
    """Maps the local names of an import statement to full names."""
    if isinstance(node, ast.Import):
        return {alias.asname: alias.name for alias in node.names if alias.asname}
    if isinstance(node, ast.ImportFrom) and node.module:
        return {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    return {}


def _within(module: str, parent: str) -> bool:
    return f"{module}.".startswith(f"{parent}.")


def _allowed(name: str, stage: str, places: tuple[str, ...]) -> bool:
    return not {stage, name}.isdisjoint(places)


def _import_fault(name: str, stage: str, module: str) -> str | None:
    if module.startswith("."):
        return "relative import"
    for parent, places in ONLY_IN.items():
        if _within(module, parent) and not _allowed(name, stage, places):
            return f"{parent} is imported"
    if _within(module, "pathlib") and _is_pure(name, stage):
        return "pathlib is imported"
    if not _within(module, "csac_jax") or module.count(".") == 0:
        return None
    other = module.split(".")[1]
    if other not in RANK:  # a name of the package itself, such as csac_jax.__version__
        return None
    if other != stage and RANK[other] <= RANK[stage]:
        return f"{other} is imported, which does not lie below {stage}"
    return None


def _is_pure(name: str, stage: str) -> bool:
    return stage in PURE and name not in NOT_PURE


def _full_name(node: ast.AST, aliases: dict[str, str]) -> str:
    """Returns `jax.jit` of such an expression, through the aliases; empty for anything else."""
    if isinstance(node, ast.Name):
        return aliases.get(node.id, node.id)
    if isinstance(node, ast.Attribute):
        return f"{_full_name(node.value, aliases)}.{node.attr}"
    return ""


def _use_fault(name: str, stage: str, node: ast.AST, aliases: dict[str, str]) -> str | None:
    full = _full_name(node, aliases) if isinstance(node, ast.Name | ast.Attribute) else ""
    if full in ("jax.jit", "jax.pmap") and not _allowed(name, stage, JIT_IN):
        return f"{full} is used"
    if full == "flax.linen" and not _allowed(name, stage, ONLY_IN["flax.linen"]):
        return "flax.linen is used"
    if full in ("print", "open", "jax.debug.print", "jax.debug.callback") and _is_pure(name, stage):
        return f"{full} is used"
    return None


def test_package_keeps_the_contract():
    """Claim: imports point back along the data path, and each library is used in its stage only."""
    assert violations(PACKAGE) == []


def test_policies_need_no_mujoco():
    """Claim: what sees, thinks and reads policies is imported without MuJoCo installed."""
    names = "agent.policy", "deploy", "io.policy_file", "nets.networks", "vision.observe"
    imports = ", ".join(f"csac_jax.{name}" for name in names)
    code = f"import sys; sys.modules['mujoco'] = None; import {imports}"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_training_in_c_needs_no_mjx():
    """Claim: where C MuJoCo moves, neither MJX nor Warp is imported, nor SciPy's statistics before
    something is measured."""
    code = (
        "import sys; sys.modules['mujoco.mjx'] = sys.modules['warp'] = None\n"
        "from csac_jax import api, presets\nfrom csac_jax.sim import backend, physics\n"
        "from csac_jax.world import model\ncfg = backend.resolve(presets.quick())\n"
        "physics.make(model.build(cfg.scene, cfg.sim), cfg.sim)\n"
        "assert 'scipy.stats' not in sys.modules"
    )
    variables = {**os.environ, "JAX_PLATFORMS": "cpu"}
    subprocess.run([sys.executable, "-c", code], check=True, env=variables)


FORBIDDEN = ("pickle", "marshal", "shelve", "dill", "yaml", "eval", "exec", "os.system", "os.popen")
HARMLESS = ("yaml", "yaml.scan", "yaml.AliasToken", "yaml.safe_load", "yaml.YAMLError")
HARMLESS += ("yaml.safe_dump",)


def dangers(source: str) -> list[str]:
    """Returns all uses that could run the content of a file, or a shell."""
    tree, aliases = ast.parse(source), {}
    for node in ast.walk(tree):
        aliases |= _aliases(node)
    found = []
    for node in ast.walk(tree):
        names = [name for name in _imported(node) if name != "yaml"]
        if isinstance(node, ast.Name | ast.Attribute):
            name = _full_name(node, aliases).removeprefix("builtins.")
            names = [] if name in HARMLESS else [name]
        found += [name for name in names if any(_within(name, bad) for bad in FORBIDDEN)]
        if isinstance(node, ast.keyword) and node.arg in ("shell", "allow_pickle"):
            harmless = isinstance(node.value, ast.Constant) and node.value.value is False
            found += [] if harmless else [f"{node.arg}="]
    return found


def test_nothing_is_executed():
    """Claim: the package has no pickle, no eval, no exec and no shell; YAML is plain data."""
    every = {path: dangers(path.read_text()) for path in PACKAGE.rglob("*.py")}
    assert len(every) > 100
    assert not {path: found for path, found in every.items() if found}
