"""Scripts that no test runs name nothing of ours that is not there."""

import ast
import importlib
import types
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
OURS = ("csac_jax", "experiments")
SCRIPTS = sorted(
    path for folder in (*OURS[1:], "examples") for path in (ROOT / folder).rglob("*.py")
)


def _module(name: str) -> types.ModuleType | None:
    """Imports a module of ours; returns None without a package that it needs."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] in OURS:
            raise
        return None


def missing(source: str) -> list[str]:
    """Returns the missing attributes of our modules that a script reads, as `module.name`."""
    nodes = list(ast.walk(ast.parse(source)))
    modules = {}
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in OURS:
            parent = _module(str(node.module))
            for alias in node.names if parent else ():
                is_attribute = hasattr(parent, alias.name)
                found = getattr(parent, alias.name) if is_attribute else None
                found = found if is_attribute else _module(f"{node.module}.{alias.name}")
                if isinstance(found, types.ModuleType):
                    modules[alias.asname or alias.name] = found
    bound = {node.arg for node in nodes if isinstance(node, ast.arg)}
    bound |= {n.id for n in nodes if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
    read = [n for n in nodes if isinstance(n, ast.Attribute) and isinstance(n.value, ast.Name)]
    return [
        f"{node.value.id}.{node.attr}"
        for node in read
        if node.value.id in modules.keys() - bound
        and not hasattr(modules[node.value.id], node.attr)
    ]


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_scripts_name_what_is_there(path: Path):
    """Claim: every attribute of our modules that a benchmark or an example reads exists."""
    assert missing(path.read_text()) == []
