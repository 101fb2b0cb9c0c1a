"""`csac-jax serve --mcp`: what a client of the Model Context Protocol sees."""

import asyncio
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from csac_jax.deploy import CameraPolicy
from csac_jax.io import policy_file
from tests.deploy import image_files, scenes

mcp = pytest.importorskip("mcp")
IMAGE = image_files.rounded(scenes.take(scenes.blocks_at([[0.1, 0.09, 0.4], [-0.1, -0.09, 1.0]])))


def _call(policy: CameraPolicy, name: str, arguments: dict[str, Any]) -> Any:
    from csac_jax.cli import mcp_tools

    async def call() -> Any:
        async with mcp.Client(mcp_tools.make(policy)) as client:
            assert {one.name for one in (await client.list_tools()).tools} == {
                "decide",
                "policies",
                "evaluate",
            }
            return await client.call_tool(name, arguments)

    return asyncio.run(call())


def test_tools_answer_as_the_commands(tmp_path: Path):
    """Claim: `decide` returns what `CameraPolicy.decide` does for the files of an image, `policies`
    those that ship; a missing file and too many episodes are errors that say so."""
    policy = CameraPolicy.load("shipped_clutter")
    flags = image_files.write(tmp_path, IMAGE)
    paths = {
        flag.removeprefix("--"): path for flag, path in zip(flags[::2], flags[1::2], strict=True)
    }
    answer = _call(policy, "decide", {**paths, "top": 2})
    assert not answer.is_error
    wanted = policy.decide(*IMAGE, top=2)
    places = [one["position"] for one in answer.structured_content["decisions"]]
    np.testing.assert_allclose(places, [one.position for one in wanted], atol=1e-4)
    listed = _call(policy, "policies", {}).structured_content["policies"]
    assert [one["name"] for one in listed] == [*policy_file.SHIPPED]
    for name, arguments, message in (
        ("decide", {**paths, "rgb": "nowhere.png"}, "nowhere.png"),
        ("evaluate", {"policy": "shipped", "episodes": 10**6}, "episodes: must lie in 1 .. 1000"),
        ("evaluate", {"policy": "nowhere"}, "there is no folder nowhere"),
    ):
        refused = _call(policy, name, arguments)
        assert refused.is_error
        assert message in refused.content[0].text
