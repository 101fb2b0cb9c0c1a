"""The package as its users get it: a wheel, installed without the checkout."""

import ast
import inspect
import os
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

import csac_jax
from csac_jax.scenes import cases

from jax._src.export import serialization  # isort: skip

ROOT = Path(csac_jax.__file__).parents[1]
PINS = (ROOT / "requirements.txt").read_text()
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
DATA = (
    "policies/shipped.safetensors",
    "policies/shipped.md",
    "report/page.html",
    "py.typed",
    "_scenes/ur5.xml",
)
COMMANDS = (
    "train smoke --run-dir run",
    "eval run --episodes 2 --json run/eval.json",
    "eval shipped --suite cases --episodes 1",
    "demo",
    "play --scene pinwheel --policy shipped --png play.png",
    "export run policy.safetensors",
    "report run --out page",
)


def test_versions_agree():
    """Claim: package, CITATION.cff and the newest heading of CHANGELOG.md name one version, and
    the classifiers begin with the oldest Python that is let in. Both commands are one."""
    version = csac_jax.__version__
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    newest = (ROOT / "CHANGELOG.md").read_text().split("\n## ")[1]
    assert newest.split("\n")[0].split(",")[0] == version
    minor = [line.split("3.")[1] for line in PROJECT["classifiers"] if ":: 3." in line]
    assert PROJECT["requires-python"] == f">=3.{minor[0]}"
    assert PROJECT["scripts"] == dict.fromkeys(("csac-jax", "csac_jax"), "csac_jax.cli:main")


def test_extras_are_sorted_and_pinned():
    """Claim: the extras for users stand in order, and every library of the checkout's extras has
    a tested version in requirements.txt."""
    extras = PROJECT["optional-dependencies"]
    names = list(extras)
    assert names[: names.index("bench")] == sorted(names[: names.index("bench")])
    assert set(names[names.index("bench") :]) == {"bench", "dist", "docs", "dev"}
    needed = [*PROJECT["dependencies"]]
    for extra in ("bench", "dist", "dev", *extras["dev"][0][9:-1].split(","), "report"):
        needed += extras[extra]
    for one in needed:
        name = one.split("[")[0].split(">")[0].split("=")[0].lower().replace("_", "-")
        assert name == "csac-jax" or f"\n{name}==" in PINS, name


def test_traced_programs_need_no_extra():
    """Claim: a plain installation has the library by which JAX writes traced programs: a training
    on a CPU keeps them on disk."""
    tree = ast.parse(inspect.getsource(serialization))
    lines = [node for node in ast.walk(tree) if isinstance(node, ast.Import)]
    imported = {name.name for line in lines for name in line.names}
    foreign = imported - sys.stdlib_module_names - {"jax", "numpy"}
    assert foreign <= {one.split(">")[0] for one in PROJECT["dependencies"]}


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Builds wheel and sdist; returns their folder."""
    folder = tmp_path_factory.mktemp("dist")
    pytest.importorskip("build.__main__")  # a folder "build" would pass for the package
    command = [sys.executable, "-m", "build", "--outdir", str(folder), str(ROOT)]
    subprocess.run(command, check=True, capture_output=True, cwd=folder)
    return folder


@pytest.mark.slow
def test_wheel_and_sdist_are_whole(built: Path):
    """Claim: the wheel holds scenes, cases, policy and page, the sdist what builds it, and twine
    finds no fault."""
    pytest.importorskip("twine")
    (wheel,), (sdist,) = built.glob("*.whl"), built.glob("*.tar.gz")
    held = set(zipfile.ZipFile(wheel).namelist())
    wanted = {f"csac_jax/{name}" for name in DATA}
    wanted |= {f"csac_jax/_scenes/cases/{name}.json" for name in cases.names()}
    assert wanted <= held
    assert not {name.split("/")[0] for name in held} - {"csac_jax", f"{wheel.name[:14]}.dist-info"}
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"CITATION.cff", "CONTRIBUTING.md", "pyproject.toml", "scenes/ur5.xml"} <= names
    check = [sys.executable, "-m", "twine", "check", "--strict", str(wheel), str(sdist)]
    subprocess.run(check, check=True, capture_output=True)


@pytest.mark.slow
def test_installed_package_works(built: Path, tmp_path: Path):
    """Claim: a fresh environment with the wheel alone trains, evaluates, plays, exports and
    reports, far from the checkout."""
    venv.create(tmp_path / "venv", with_pip=True)
    wheel = next(built.glob("*.whl"))
    python = str(tmp_path / "venv/bin/python")
    pins = [line.removesuffix(" \\") for line in PINS.splitlines() if "==" in line]  # no hashes
    (tmp_path / "pins.txt").write_text("\n".join(pins))
    constraints = ["-c", str(tmp_path / "pins.txt")]
    install = ["-m", "pip", "install", "-q", *constraints, f"{wheel}[report]"]
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    subprocess.run([python, *install], check=True, env=clean, capture_output=True)
    where = "import csac_jax; print(csac_jax.__file__)"
    (tmp_path / "work").mkdir()
    here = {"cwd": tmp_path / "work", "env": clean, "capture_output": True, "text": True}
    found = subprocess.run([python, "-c", where], check=True, **here).stdout
    assert found.startswith(str(tmp_path / "venv"))
    for command in COMMANDS:
        done = subprocess.run([python, "-m", "csac_jax", *command.split()], check=False, **here)
        assert done.returncode == 0, f"{command}: {done.stderr}"
    made = {path.name for path in (tmp_path / "work").iterdir()}
    assert made == {"run", "demo.webp", "play.png", "policy.safetensors", "page"}
