"""`csac-jax serve`: a policy as an HTTP service."""

import dataclasses
from pathlib import Path

from csac_jax.cli import parsing
from csac_jax.cli.failures import check_extra
from csac_jax.cli.robot_options import RobotOptions, check_size
from csac_jax.section import require

LOCAL = ("127.0.0.1", "::1", "localhost")
SHORTEST_TOKEN = 16  # characters


@dataclasses.dataclass(frozen=True, kw_only=True)
class ServeOptions(RobotOptions):
    """Answers images by decisions over HTTP: POST /decide, POST /outcome, GET /health, GET
    /version."""

    port: int = 8000
    """Port to listen on; 0 takes a free one."""
    host: str = "127.0.0.1"
    """Address to listen on; any but 127.0.0.1 needs --token-file."""
    token_file: Path | None = None
    """File whose first line clients must send as the header Authorization: Bearer LINE."""
    size: tuple[int, int] = (640, 480)
    """Width and height of the images, px, to compile for at the start; others compile later."""


def run(arguments: list[str]) -> int:
    """Serves until it is stopped; returns the exit code."""
    options = parsing.parse(ServeOptions, arguments, "serve")
    for module in ("fastapi", "uvicorn"):
        check_extra("serve", module, "serve")
    token = _token(options)
    require(0 <= options.port < 2**16, "--port: must lie in 0 .. 65535")
    check_size(options.size)
    import uvicorn

    from csac_jax.deploy import service

    policy, recorder = options.load(), options.recorder()
    policy.warm_up(*options.size)
    app = service.make(policy, options.policy, token, recorder)
    uvicorn.run(app, host=options.host, port=options.port, log_level="warning", lifespan="off")
    return 0


def _token(options: ServeOptions) -> str | None:
    file, host = options.token_file, options.host
    if file is None:
        fault = f"--host {host}: others could use the service; give --token-file too"
        require(host in LOCAL, fault)
        return None
    require(file.is_file(), f"--token-file: there is no file {file}")
    token = file.read_text(errors="replace").split("\n")[0].strip()
    fits = len(token) >= SHORTEST_TOKEN and token.isascii() and token.isprintable()
    needed = f"{SHORTEST_TOKEN} printable characters or more"
    require(fits, f"--token-file: its first line must have {needed}")
    return token
