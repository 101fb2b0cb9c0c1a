"""Tools of the Model Context Protocol: decide, policies and evaluate.

They are served on stdin and stdout; what else prints goes to stderr. Needs the extra `mcp`.
"""

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mcp.server.mcpserver import MCPServer
from mcp.server.mcpserver.exceptions import ToolError

from csac_jax.cli import shipped
from csac_jax.deploy import CameraPolicy, image_files
from csac_jax.errors import FailedError, SettingsError
from csac_jax.evaluation import policies, rollout
from csac_jax.section import require

MOST_EPISODES = 1000


@contextlib.contextmanager
def _working() -> Iterator[None]:
    """Keeps stdout free for answers, and gives a client the message of an error."""
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    except (SettingsError, FailedError, OSError) as error:
        raise ToolError(str(error)) from None


def make(camera: CameraPolicy) -> MCPServer:
    """Builds the server of a policy."""
    server = MCPServer("csac-jax")

    @server.tool()
    def decide(rgb: str, depth: str, intrinsics: str, pose: str, top: int = 1) -> dict[str, Any]:
        """Decides where to grasp or push in a camera's image: the best `top` actions, in m and rad
        in the workspace's frame. All but `top` are paths of files, as of `csac-jax act`."""
        with _working():
            image = image_files.read_image(*map(Path, (rgb, depth, intrinsics, pose)))
            return {"decisions": [one.to_dict() for one in camera.decide(*image, None, top)]}

    @server.tool(name="policies")
    def list_policies() -> dict[str, Any]:
        """Lists the policies that come with the package: task, hand, view and a result of each."""
        return {"policies": shipped.table()}

    @server.tool()
    def evaluate(policy: str, suite: str = "random10", episodes: int = 20) -> dict[str, Any]:
        """Measures a policy (a name of `policies`, a file or a run) in a suite of simulated scenes:
        metrics with 95 % intervals. It takes a minute or more."""
        with _working():
            require(1 <= episodes <= MOST_EPISODES, f"episodes: must lie in 1 .. {MOST_EPISODES}")
            return dict(rollout.evaluate(policies.load(policy), suite, episodes))

    return server
