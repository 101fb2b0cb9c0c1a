"""`csac-jax serve`: a policy as an HTTP service, or as tools of the Model Context Protocol."""

import dataclasses
import shlex
from pathlib import Path

import tyro

from csac_jax.cli import parsing
from csac_jax.cli.failures import check_extra
from csac_jax.cli.robot_options import RobotOptions, check_size, naming_the_option
from csac_jax.section import require

LOCAL = ("127.0.0.1", "::1", "localhost")
SHORTEST_TOKEN = 16  # characters


@dataclasses.dataclass(frozen=True, kw_only=True)
class ServeOptions(RobotOptions):
    """Answers images by decisions over HTTP: POST /decide and /outcome, GET /health, /version and
    /openapi.json."""

    port: int = 8000
    """Port to listen on; 0 takes a free one."""
    host: str = "127.0.0.1"
    """Address to listen on; any but 127.0.0.1 needs --token-file."""
    token_file: Path | None = None
    """File whose first line clients must send as the header Authorization: Bearer LINE."""
    size: tuple[int, int] = (640, 480)
    """Width and height of the images, px, to compile for at the start; others compile later."""
    mcp: tyro.conf.FlagCreatePairsOff[bool] = False
    """Serve the tools decide, policies and evaluate on stdin and stdout instead, by the Model
    Context Protocol (extra `mcp`)."""


@naming_the_option()
def run(arguments: list[str]) -> int:
    """Serves until it is stopped; returns the exit code."""
    options = parsing.parse(ServeOptions, arguments, "serve")
    if options.mcp:
        return _serve_tools(options)
    for module in ("fastapi", "uvicorn"):
        check_extra("serve", module, "serve")
    token = _token(options)
    require(0 <= options.port < 2**16, "--port: must lie in 0 .. 65535")
    check_size(options.size)
    from csac_jax.deploy import decider, server, service

    with server.claim(options.host, options.port) as listener:
        policy, recorder = options.load(), options.recorder()
        options.warn(policy)
        policy.warm_up(*options.size, decider.batches())
        app = service.make(policy, options.policy, token, recorder, options.size)
        print(_usage(options, listener.getsockname()[1]), flush=True)
        server.configured(app).run(sockets=[listener])
    return 0


def _serve_tools(options: ServeOptions) -> int:
    check_extra("--mcp", "mcp", "mcp")
    require(options.record is None, "--record: --mcp records nothing; leave one of them out")
    from csac_jax.cli import mcp_tools

    mcp_tools.make(options.load()).run("stdio")
    return 0


def _usage(options: ServeOptions, port: int) -> str:
    """Returns where the service listens, and a call of it."""
    host = f"[{options.host}]" if ":" in options.host else options.host
    url, file = f"http://{host}:{port}", shlex.quote(str(options.token_file))
    token = "" if options.token_file is None else f' -H "Authorization: Bearer $(head -n 1 {file})"'
    return (
        f"listens on {url}; {url}/openapi.json says what it answers\n"
        f"try: curl{token} -d @request.json {url}/decide"
    )


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
