"""Images, decisions and outcomes on disc, in the files that `csac-jax act` reads.

    DIR/record.json           {"format": 1}
    DIR/000001/rgb.png        depth.npy, intrinsics.json, pose.json, maybe mask.png: the image
    DIR/000001/decision.json  {"time", "policy", "decisions": as `csac-jax act` writes them}
    DIR/000001/outcome.json   {"outcome", "number"?: 1, "ended"?: false}, once it is known

An image shows what the action before it led to: a record is of one robot. An entry appears all at
once. Errors are SettingsErrors, one line that names the file.
"""

import datetime
import io
import itertools
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import pydantic

from csac_jax.constants import OUTCOMES
from csac_jax.deploy import image_files, images
from csac_jax.deploy.decision import Decision
from csac_jax.errors import SettingsError
from csac_jax.io import files
from csac_jax.section import require

FORMAT = 1
PUSHED = "pushed"  # the outcome of every push: its effect is seen in the next image
KNOWN = (*OUTCOMES, PUSHED)
_HEAD, _DECISION, _OUTCOME = "record.json", "decision.json", "outcome.json"
_DIGITS, _MOST_DIGITS = 6, 18  # of an entry's name

Image = tuple[Any, Any, Any, Any, Any]  # the arguments of `CameraPolicy.decide` but `top`
_Number = Annotated[float, pydantic.Field(allow_inf_nan=False)]
_WHOLE = pydantic.BeforeValidator(  # JSON does not tell 1 from 1.0
    lambda value: int(value) if isinstance(value, float) and value.is_integer() else value
)


class ReportedOutcome(pydantic.BaseModel, extra="forbid", strict=True, frozen=True):
    """The outcome of an action, as a robot reports it."""

    outcome: Literal[KNOWN]  # type: ignore[valid-type]
    number: Annotated[int, pydantic.Field(ge=1), _WHOLE] = 1  # of the decision done, 1 the best
    ended: bool = False  # no object to get is left, or the scene was changed by hand

    def check(self, decisions: Sequence[dict[str, Any]]) -> None:
        """Raises SettingsError if it is no outcome of these decisions."""
        num = len(decisions)
        require(self.number <= num, f"number: there are {num} decisions, not {self.number}")
        primitive = decisions[self.number - 1]["primitive"]
        outcomes = (PUSHED,) if primitive == "push" else OUTCOMES
        fault = f"outcome: of a {primitive} it is {', '.join(outcomes)}, not {self.outcome}"
        require(self.outcome in outcomes, fault)


class _StoredDecision(pydantic.BaseModel, extra="allow", strict=True):
    """A decision, as far as it is read."""

    primitive: Literal["grasp", "push"]
    position: Annotated[list[_Number], pydantic.Field(min_length=3, max_length=3)]
    yaw: _Number


class _DecisionFile(pydantic.BaseModel, strict=True):
    decisions: list[_StoredDecision]


class Entry(NamedTuple):
    """One image, the decisions about it, and the outcome."""

    path: Path
    decisions: list[dict[str, Any]]
    outcome: ReportedOutcome | None  # None: not known yet

    @property
    def image(self) -> Image:
        """Reads the arguments of `CameraPolicy.decide`."""
        names = "rgb.png", "depth.npy", "intrinsics.json", "pose.json"
        mask = self.path / "mask.png"
        image = image_files.read_image(*(self.path / name for name in names))
        return (*image, image_files.read_mask(mask) if mask.exists() else None)

    @property
    def action(self) -> tuple[str, list[float]]:
        """Returns the primitive and the pose x, y, yaw (m, m, rad) of what was carried out."""
        assert self.outcome is not None
        done = self.decisions[self.outcome.number - 1]
        return done["primitive"], [*done["position"][:2], done["yaw"]]


class Recorder:
    """A writer of a record. It creates a missing one."""

    def __init__(self, folder: Path, policy: str) -> None:
        """Opens a record whose new entries name the `policy`. Raises SettingsError for a folder of
        anything else."""
        self._folder, self._policy = folder, policy
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            _check(folder)
        else:
            files.write_json(folder / _HEAD, {"format": FORMAT})

    def add(self, image: Image, decisions: Sequence[Decision]) -> str:
        """Stores an image and its decisions; returns the entry's name. Raises OSError."""
        now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
        listed = [decision.to_dict() for decision in decisions]
        content = {"time": now, "policy": self._policy, "decisions": listed}
        draft = Path(tempfile.mkdtemp(prefix=".", dir=self._folder))
        try:
            _write(draft, image)
            files.write_json(draft / _DECISION, content)
            draft.chmod(0o755)
            return _publish(self._folder, draft)
        finally:
            shutil.rmtree(draft, ignore_errors=True)

    def post(self, name: str, outcome: ReportedOutcome) -> None:
        """Stores the outcome of the entry `name`, in place of an earlier one.

        Raises FileNotFoundError if there is no such entry, SettingsError, OSError.
        """
        folder = self._folder / name
        if not is_name(name) or not folder.is_dir():
            raise FileNotFoundError(f"there is no decision {name[:20]} in the record")
        outcome.check(_decisions(folder))
        files.write_json(folder / _OUTCOME, outcome.model_dump())


def is_name(name: str) -> bool:
    """Returns True for the name of an entry."""
    return _DIGITS <= len(name) <= _MOST_DIGITS and name.isascii() and name.isdigit()


def _check(folder: Path) -> None:
    """Raises SettingsError for a folder that is no record, or is of another format."""
    fault = f"{folder} is no record: it has no {_HEAD}; give another folder"
    require((folder / _HEAD).is_file(), fault)
    number = image_files.read_json(folder / _HEAD, dict[str, Any]).get("format")
    known = f"this version reads {FORMAT}; update csac-jax"
    require(number == FORMAT, f"{folder}: format {number!r:.20} is unknown, {known}")


def read(folder: Path) -> list[Entry]:
    """Reads the entries of a record in their order, without images."""
    _check(folder)
    names = sorted((path.name for path in folder.iterdir() if is_name(path.name)), key=int)
    return [_entry(folder / name) for name in names]


def _entry(folder: Path) -> Entry:
    decisions, path = _decisions(folder), folder / _OUTCOME
    if not path.exists():
        return Entry(folder, decisions, None)
    outcome = image_files.read_json(path, ReportedOutcome)
    try:
        outcome.check(decisions)
    except SettingsError as error:
        raise SettingsError(f"{path}: {error}") from None
    return Entry(folder, decisions, outcome)


def _decisions(folder: Path) -> list[dict[str, Any]]:
    stored = image_files.read_json(folder / _DECISION, _DecisionFile)
    return stored.model_dump()["decisions"]


def _write(folder: Path, image: Image) -> None:
    rgb, depth, intrinsics, pose, mask = image
    files.replace(folder / "rgb.png", image_files.encode(np.asarray(rgb)))
    np.save(values := io.BytesIO(), np.asarray(depth, np.float32), allow_pickle=False)
    files.replace(folder / "depth.npy", values.getvalue())
    files.write_json(folder / "intrinsics.json", vars(images.Intrinsics.of(intrinsics)))
    files.write_json(folder / "pose.json", {"matrix": np.asarray(pose, np.float64).tolist()})
    if mask is not None:
        marked = np.where(np.asarray(mask) != 0, 255, 0).astype(np.uint8)
        files.replace(folder / "mask.png", image_files.encode(marked))


def _publish(folder: Path, draft: Path) -> str:
    """Names a draft by the next free number; another process may take one meanwhile."""
    taken = [int(path.name) for path in folder.iterdir() if is_name(path.name)]
    for number in itertools.count(max(taken, default=0) + 1):
        entry = folder / f"{number:0{_DIGITS}d}"
        try:
            draft.rename(entry)  # fails where there is a folder with files
            break
        except OSError:
            if not entry.exists():
                raise
    files.sync_folder(folder)
    return entry.name
