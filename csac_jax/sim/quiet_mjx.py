"""Imports MJX without its two printed lines about Warp, an extra. Other output is kept."""

import contextlib
import io

_printed = io.StringIO()
with contextlib.redirect_stdout(_printed):
    from mujoco import mjx as mjx

for _line in _printed.getvalue().splitlines():
    if "No module named 'warp'" not in _line:
        print(_line)
