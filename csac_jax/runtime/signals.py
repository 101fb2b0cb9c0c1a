"""SIGINT and SIGTERM: the first makes the loop save and end, a later one ends it at once.

Python's own signal handlers wait while XLA compiles or a chunk runs. The C handler behind
`signal.set_wakeup_fd` does not: it writes the signal's number into a socket, which a thread reads.
"""

import os
import signal
import socket
import sys
import threading
import time

SIGNALS = (signal.SIGINT, signal.SIGTERM)
ECHO = 0.3  # s, in which another one is the same: timeout(1) signals a process and its group


class Stop:
    """A flag for the loop: the number of the first signal, None before there is one."""

    def __init__(self) -> None:
        self.signal: int | None = None

    @property
    def exit_code(self) -> int:
        """Returns 130 for SIGINT, 143 for SIGTERM, 0 if there was none."""
        return 0 if self.signal is None else 128 + self.signal


def install() -> Stop:
    """Starts listening and returns the flag. Call it early, in the main thread."""
    stop = Stop()
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    signal.set_wakeup_fd(writer.fileno())
    for number in SIGNALS:
        signal.signal(number, lambda *_: None)
    threading.Thread(target=_listen, args=(stop, reader, writer), daemon=True).start()
    return stop


def _listen(stop: Stop, reader: socket.socket, writer: socket.socket) -> None:
    """Reads signal numbers until the process ends. It holds `writer`, which must stay open."""
    seen: dict[int, float] = {}
    while writer.fileno() >= 0:
        for number in reader.recv(64):
            if number in seen and time.monotonic() - seen[number] > ECHO:
                os._exit(128 + number)
            if number in SIGNALS and number not in seen:
                seen[number] = time.monotonic()
                stop.signal = stop.signal or number
                text = f"{signal.Signals(number).name}: saving after this chunk"
                print(f"{text}; once more to end at once", file=sys.stderr, flush=True)
