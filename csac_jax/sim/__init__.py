"""Physics of a batch of scenes, the two motion primitives and what they achieved."""

import contextlib
import io


def _import_mjx_quietly() -> None:
    """Imports MJX without its two lines about Warp, which is an extra; whatever else it prints is
    kept."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        import mujoco.mjx  # noqa: F401
    kept = [
        line for line in printed.getvalue().splitlines() if "No module named 'warp'" not in line
    ]
    if kept:
        print("\n".join(kept))


_import_mjx_quietly()
