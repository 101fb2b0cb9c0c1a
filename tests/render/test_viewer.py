"""The viewer: what its page holds, by MuJoCo and by a client."""

import json
import urllib.request
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from csac_jax import cli, presets
from csac_jax.render import gl, viewer
from csac_jax.world import model
from tests.render.test_episode import CUBE

pytestmark = pytest.mark.mjx


@pytest.mark.parametrize("robot", ["hand", "ur5"])
def test_surfaces_are_as_large_as_mujocos(robot: Any):
    """Claim: each geom of the page has the extent that MuJoCo has for it, all of their kinds."""
    pytest.importorskip("viser")
    cfg = presets.get("fast").change(sim={"robot": robot, "physics": "c"})
    world = model.build(cfg.scene, cfg.sim).model
    kinds = set()
    for geom in range(world.ngeom):
        vertices, faces = viewer.mesh(world, geom)
        kinds.add(int(world.geom_type[geom]))
        assert faces.max() < len(vertices)
        if world.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
            assert vertices[:, 2].max() == pytest.approx(0.0, abs=1e-9)
            continue
        centre, half = np.split(world.geom_aabb[geom], 2)
        np.testing.assert_allclose(vertices.max(axis=0), centre + half, atol=2e-3)
        np.testing.assert_allclose(vertices.min(axis=0), centre - half, atol=2e-3)
    assert {mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_MESH} < kinds


@pytest.mark.slow
def test_page_follows_the_motion(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys):
    """Claim: `play --viewer` without a display serves a page, whose parts lie where MuJoCo has the
    geoms in every picture; it goes on to the episode of another seed; Ctrl-C ends it."""
    pytest.importorskip("viser")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(gl, "has_display", lambda: False)
    monkeypatch.setattr(viewer.time, "sleep", lambda _: None)
    Path("cube.json").write_text(json.dumps({"name": "cube", "blocks": [CUBE]}))
    show, pages, heights, films = viewer.Page.show, [], [], []

    def watched(self: viewer.Page, data: mujoco.MjData, text: str, number: int) -> int:
        following = show(self, data, text, number)
        if isinstance(following, viewer.Film):
            films.append(following.seed)
            raise KeyboardInterrupt
        if not pages:
            address = capsys.readouterr().out.split("open ")[1].split(" in a browser")[0]
            pages.append(urllib.request.urlopen(address, timeout=10).status)
        for geom, part in self.parts.items():
            np.testing.assert_allclose(part.position, data.geom_xpos[geom], atol=1e-6)
            turn = np.empty(9)
            mujoco.mju_quat2Mat(turn, np.array(part.wxyz))
            np.testing.assert_allclose(turn, data.geom_xmat[geom], atol=1e-6)
        heights.append(float(data.qpos[2]))
        if len(heights) == 30:  # 19 pictures an action: the second time
            self.ask(3)
        return following

    monkeypatch.setattr(viewer.Page, "show", watched)
    assert cli.main(["play", "--scene", "cube.json", "--viewer"]) == 0
    assert pages == [200]
    assert len(set(heights)) > 5
    assert heights[19:] == heights[:11]
    assert films == [3]
    assert capsys.readouterr().out.count("the table is clear") == 1  # the first was read
