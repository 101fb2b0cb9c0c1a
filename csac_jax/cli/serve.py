"""`csac-jax serve`: a policy as an HTTP service."""

import dataclasses
from pathlib import Path

import tyro

from csac_jax.cli import parsing
from csac_jax.cli.failures import check_extra
from csac_jax.errors import SettingsError

LOCAL = ("127.0.0.1", "::1", "localhost")
SHORTEST_TOKEN = 16  # characters


@dataclasses.dataclass(frozen=True)
class ServeOptions:
    """Answers images by decisions over HTTP: POST /decide, POST /outcome, GET /health, GET
    /version."""

    policy: tyro.conf.Positional[str]
    """A policy file, one that comes with the package, such as shipped, or a run's folder."""
    port: int = 8000
    """Port to listen on; 0 takes a free one."""
    host: str = "127.0.0.1"
    """Address to listen on; any but 127.0.0.1 needs --token-file."""
    token_file: Path | None = None
    """File whose first line clients must send as the header Authorization: Bearer LINE."""
    workspace: Path | None = None
    """JSON with the 4 x 4 matrix from workspace to robot, for the waypoints' tool poses."""
    record: Path | None = None
    """Folder of one robot that stores images, decisions and posted outcomes, for finetune."""
    gripper: str | None = None
    """The robot's gripper, by name or folder; by default that of the training."""
    size: tuple[int, int] = (640, 480)
    """Width and height of the images, px, to compile for at the start; others compile later."""


def run(arguments: list[str]) -> int:
    """Serves until it is stopped; returns the exit code."""
    options = parsing.parse(ServeOptions, arguments, "serve")
    for module in ("fastapi", "uvicorn"):
        check_extra("serve", module, "serve")
    token = read_token(options)
    if not 0 <= options.port < 2**16:
        raise SettingsError("--port: must lie in 0 .. 65535")
    if not all(16 <= side <= 4096 for side in options.size):
        raise SettingsError("--size: both numbers must lie in 16 .. 4096 px")
    import uvicorn

    from csac_jax import deploy
    from csac_jax.deploy import image_files, record, service

    workspace = None if options.workspace is None else image_files.read_pose(options.workspace)
    policy = deploy.CameraPolicy.load(options.policy, workspace, options.gripper)
    recorder = None if options.record is None else record.Recorder(options.record, options.policy)
    policy.warm_up(*options.size)
    app = service.make(policy, options.policy, token, recorder)
    uvicorn.run(app, host=options.host, port=options.port, log_level="warning", lifespan="off")
    return 0


def read_token(options: ServeOptions) -> str | None:
    """Returns the token that clients must send, or None. Raises SettingsError."""
    if options.token_file is None:
        if options.host not in LOCAL:
            raise SettingsError(
                f"--host {options.host}: others could use the service; give --token-file too"
            )
        return None
    if not options.token_file.is_file():
        raise SettingsError(f"--token-file: there is no file {options.token_file}")
    token = options.token_file.read_text().split("\n")[0].strip()
    if len(token) < SHORTEST_TOKEN or not token.isascii() or not token.isprintable():
        raise SettingsError(
            f"--token-file: its first line must have {SHORTEST_TOKEN} printable characters or more"
        )
    return token
