"""Images, decisions and outcomes on disc, in the files that `csac-jax act` reads.

    DIR/record.json           {"format": 1}
    DIR/000001/rgb.png        depth.npy, intrinsics.json, pose.json, maybe mask.png: the image
    DIR/000001/decision.json  {"time", "policy", "decisions": as `act --json` has them}
    DIR/000001/outcome.json   {"outcome", "number"?: 1, "ended"?: false}, once it is known

An image shows what the action before it led to: a record is of one robot. An entry appears all at
once. Errors are SettingsErrors, one line that names the file.
"""

import dataclasses
import datetime
import json
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from csac_jax.constants import OUTCOMES
from csac_jax.deploy import files as image_files, images
from csac_jax.deploy.decision import Decision
from csac_jax.errors import SettingsError
from csac_jax.io import files

FORMAT = 1
PUSHED = "pushed"  # the outcome of every push: its effect is seen in the next image
KNOWN = (*OUTCOMES, PUSHED)
_HEAD, _DECISION, _OUTCOME = "record.json", "decision.json", "outcome.json"
_DIGITS = 6  # of an entry's name, or more

Image = tuple[Any, Any, Any, Any, Any]  # rgb, depth, intrinsics, pose, mask, of `Policy.decide`


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What came of an action. Raises SettingsError for what cannot be."""

    outcome: str  # of KNOWN
    number: int = 1  # which of the decisions was carried out, 1 the best
    ended: bool = False  # no object to get is left, or the scene was changed by hand

    def __post_init__(self) -> None:
        if self.outcome not in KNOWN:
            raise SettingsError(f"outcome: must be one of {', '.join(KNOWN)}")
        if type(self.number) is not int or self.number < 1:
            raise SettingsError("number: must be that of a decision, 1 the best")
        if type(self.ended) is not bool:
            raise SettingsError("ended: must be true or false")

    @classmethod
    def of(cls, values: dict[str, Any]) -> "Outcome":
        """Of a JSON object."""
        known = {field.name for field in dataclasses.fields(cls)}
        if "outcome" not in values or not set(values) <= known:
            raise SettingsError('give {"outcome": NAME, "number": 1, "ended": false}')
        return cls(**values)

    def check(self, decisions: Sequence[dict[str, Any]]) -> None:
        """Raises SettingsError where it is no outcome of these decisions."""
        if self.number > len(decisions):
            raise SettingsError(f"number: there are {len(decisions)} decisions, not {self.number}")
        pushed = decisions[self.number - 1]["primitive"] == "push"
        if pushed != (self.outcome == PUSHED):
            primitive, names = ("push", PUSHED) if pushed else ("grasp", ", ".join(OUTCOMES))
            raise SettingsError(f"outcome: of a {primitive} it is {names}, not {self.outcome}")


class Entry(NamedTuple):
    """One image, what was decided, and what came of it."""

    path: Path
    decisions: list[dict[str, Any]]
    outcome: Outcome | None  # None: not known yet

    @property
    def image(self) -> Image:
        """What `Policy.decide` was given."""
        mask = self.path / "mask.png"
        return (
            image_files.read_rgb(self.path / "rgb.png"),
            image_files.read_depth(self.path / "depth.npy"),
            image_files.read_intrinsics(self.path / "intrinsics.json"),
            image_files.read_pose(self.path / "pose.json"),
            image_files.read_mask(mask) if mask.exists() else None,
        )

    @property
    def action(self) -> tuple[str, list[float]]:
        """The primitive and the pose x, y, yaw (m, m, rad) of what was carried out."""
        assert self.outcome is not None
        done = self.decisions[self.outcome.number - 1]
        return done["primitive"], [*done["position"][:2], done["yaw"]]


class Recorder:
    """Adds to a record, which it makes if there is none."""

    def __init__(self, folder: Path, policy: str) -> None:
        """Entries name the `policy`. Raises SettingsError for a folder of anything else."""
        self._folder, self._policy = folder, policy
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            check(folder)
        else:
            files.write_json(folder / _HEAD, {"format": FORMAT})

    def add(self, image: Image, decisions: Sequence[Decision]) -> str:
        """Keeps an image and what was decided; returns the entry's name. Raises OSError."""
        draft = Path(tempfile.mkdtemp(prefix=".", dir=self._folder))
        try:
            _write(draft, image)
            about = {"time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")}
            listed = [decision.to_dict() for decision in decisions]
            content = {**about, "policy": self._policy, "decisions": listed}
            files.write_json(draft / _DECISION, content)
            draft.chmod(0o755)
            return _publish(self._folder, draft)
        finally:
            shutil.rmtree(draft, ignore_errors=True)

    def post(self, name: str, outcome: Outcome) -> None:
        """Keeps what came of the entry `name`, in place of what was said before. Raises
        FileNotFoundError where there is no such entry, SettingsError, OSError."""
        folder = self._folder / name
        if not is_name(name) or not folder.is_dir():
            raise FileNotFoundError(f"there is no decision {name[:20]} in the record")
        outcome.check(_decisions(folder))
        files.write_json(folder / _OUTCOME, dataclasses.asdict(outcome))


def is_name(name: str) -> bool:
    """Whether an entry may be called so."""
    return len(name) >= _DIGITS and name.isascii() and name.isdigit()


def check(folder: Path) -> None:
    """Raises SettingsError for a folder that is no record, or is of another format."""
    if not (folder / _HEAD).is_file():
        raise SettingsError(f"{folder} is no record: it has no {_HEAD}; give another folder")
    number = _object(folder / _HEAD).get("format")
    if number != FORMAT:
        raise SettingsError(
            f"{folder}: format {number!r:.20} is unknown, this version reads {FORMAT}; "
            "update csac-jax"
        )


def read(folder: Path) -> list[Entry]:
    """The entries of a record in their order, images not yet read."""
    check(folder)
    names = sorted((path.name for path in folder.iterdir() if is_name(path.name)), key=int)
    return [_entry(folder / name) for name in names]


def _entry(folder: Path) -> Entry:
    decisions, path = _decisions(folder), folder / _OUTCOME
    if not path.exists():
        return Entry(folder, decisions, None)
    values = _object(path)
    try:
        outcome = Outcome.of(values)
        outcome.check(decisions)
    except SettingsError as error:
        raise SettingsError(f"{path}: {error}") from None
    return Entry(folder, decisions, outcome)


def _decisions(folder: Path) -> list[dict[str, Any]]:
    path = folder / _DECISION
    decisions = _object(path).get("decisions")
    if not isinstance(decisions, list) or not all(map(_is_decision, decisions)):
        raise SettingsError(f"{path} has no decisions as `csac-jax act` writes them")
    return decisions


def _is_decision(values: Any) -> bool:
    """Whether a JSON value has what is read of a decision."""
    if not isinstance(values, dict) or values.get("primitive") not in ("grasp", "push"):
        return False
    position = values.get("position")
    numbers = [*(position if isinstance(position, list) else []), values.get("yaw")]
    finite = all(type(number) in (int, float) and np.isfinite(number) for number in numbers)
    return len(numbers) == 4 and finite


def _object(path: Path) -> dict[str, Any]:
    try:
        return files.read_object(path)
    except FileNotFoundError:
        raise SettingsError(f"there is no file {path}") from None
    except (ValueError, OSError) as error:
        raise SettingsError(f"{path}: {files.first_line(error)}") from None


def _write(folder: Path, image: Image) -> None:
    """The files of an image."""
    rgb, depth, intrinsics, pose, mask = image
    files.replace(folder / "rgb.png", image_files.encode(np.asarray(rgb)))
    files.replace(folder / "depth.npy", image_files.encode_array(np.asarray(depth, np.float32)))
    lens = dataclasses.asdict(images.Intrinsics.of(intrinsics))
    files.replace(folder / "intrinsics.json", json.dumps(lens) + "\n")
    matrix = np.asarray(pose, np.float64).tolist()
    files.replace(folder / "pose.json", json.dumps({"matrix": matrix}) + "\n")
    if mask is not None:
        marked = np.where(np.asarray(mask) != 0, 255, 0).astype(np.uint8)
        files.replace(folder / "mask.png", image_files.encode(marked))


def _publish(folder: Path, draft: Path) -> str:
    """Gives a draft the next free number; another process may take one meanwhile."""
    taken = [int(path.name) for path in folder.iterdir() if is_name(path.name)]
    number = max(taken, default=0)
    while True:
        number += 1
        name = f"{number:0{_DIGITS}d}"
        try:
            draft.rename(folder / name)  # fails where there is a folder with files
        except FileExistsError:
            continue
        except OSError:
            if not (folder / name).exists():
                raise
            continue
        files.sync_folder(folder)
        return name
