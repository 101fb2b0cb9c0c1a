"""Decisions about batches of questions: decoded, decided together, recorded."""

import json
import os
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax

from csac_jax.deploy import CameraPolicy
from csac_jax.deploy.batching import Pending
from csac_jax.deploy.record import Image, Recorder
from csac_jax.deploy.requests import MOST_PIXELS, Question
from csac_jax.section import require
from csac_jax.vision.heightmap import Observation

THREADS = min(4, 1 + (os.cpu_count() or 1) // 4)  # that decide; one decision keeps two cores busy
MOST_SIZES = 8  # of images, px: each is compiled for


class View(NamedTuple):
    """A question whose image was found sound."""

    image: Image
    obs: Observation
    doubts: list[str]


def batches() -> tuple[int, ...]:
    """Returns the numbers of questions that are decided together; CPUs gain nothing by several."""
    return (1,) if jax.default_backend() == "cpu" else (1, 4, 16)


def batch_size(waiting: Sequence[Question]) -> int:
    """Returns how many of the first questions are decided together: all with or all without a
    mask, of MOST_PIXELS in all if they are several, and one of `batches`."""
    fit, pixels, sizes = 0, 0, batches()
    for question in waiting[: sizes[-1]]:
        pixels += question.pixels
        if (question.mask is None) != (waiting[0].mask is None) or (fit and pixels > MOST_PIXELS):
            break
        fit += 1
    return max(size for size in sizes if size <= fit)


class Decider:
    """Decides about batches of questions, and records what was decided."""

    def __init__(
        self, policy: CameraPolicy, recorder: Recorder | None, size: tuple[int, int]
    ) -> None:
        """`size` of images, px, is always taken."""
        self._policy, self._recorder, self._sizes = policy, recorder, {size}

    def answer(self, batch: list[Pending]) -> list[bytes | Exception]:
        """Returns the JSON of each answer, or the reason why there is none."""
        begun = time.perf_counter()
        views = [self._view(entry.item) for entry in batch]
        sound = [view.obs for view in views if isinstance(view, View)]
        if not sound:
            return [view for view in views if isinstance(view, Exception)]
        observations = [view.obs if isinstance(view, View) else sound[0] for view in views]
        tops, masked = [entry.item.top for entry in batch], batch[0].item.mask is not None
        decided = self._policy.decide_each(observations, tops, masked)
        milliseconds = round(1e3 * (time.perf_counter() - begun), 1)
        return [
            view if isinstance(view, Exception) else self._finish(entry, view, one, milliseconds)
            for entry, view, one in zip(batch, views, decided, strict=True)
        ]

    def _view(self, question: Question) -> View | Exception:
        try:
            text = "this service has compiled for {} other sizes of images; send one of them"
            known = question.size in self._sizes or len(self._sizes) < MOST_SIZES
            require(known, text.format(len(self._sizes)))
            image = question.image()
            obs, doubts = self._policy.inspect(*image)
            self._sizes.add(question.size)
            return View(image, obs, doubts)
        except Exception as error:
            return error

    def _finish(
        self, entry: Pending, view: View, decisions: list[Any], milliseconds: float
    ) -> bytes | Exception:
        """Records the decisions, unless the client has left."""
        if entry.has_left:
            return ConnectionError("the client has left")
        try:
            name = None if self._recorder is None else self._recorder.add(view.image, decisions)
        except OSError as error:
            return error
        listed = [decision.to_dict() for decision in decisions]
        answer = {"decisions": listed, "id": name, "warnings": view.doubts}
        return json.dumps({**answer, "milliseconds": milliseconds}).encode()
