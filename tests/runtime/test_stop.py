"""Signals, in processes of their own."""

import signal
import subprocess
import sys
import time

import pytest

# Computes in C code, which Python's own signal handlers cannot interrupt, as they cannot interrupt
# XLA.
PROGRAM = """
import hashlib, sys, time
from csac_jax.runtime import signals
flag = signals.install()
print("ready", flush=True)
hashlib.pbkdf2_hmac("sha256", b"", b"", int(sys.argv[1]))
time.sleep(1.0)  # so that the thread that listens has had its turn
print("ended", flush=True)
sys.exit(flag.exit_code)
"""
SHORT, LONG = 1_000_000, 200_000_000  # rounds: about 0.3 s and a minute


def _start(rounds: int) -> subprocess.Popen:
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(rounds)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


@pytest.mark.parametrize(
    ("events", "code"),
    [
        ([signal.SIGINT], 130),
        ([signal.SIGTERM], 143),
        ([signal.SIGINT, 0.05, signal.SIGINT], 130),  # as of timeout(1)
        ([signal.SIGINT, 0.2, signal.SIGTERM], 130),
    ],
)
def test_first_signal_sets_the_flag(events: list, code: int):
    """Claim: the first signal lets the program come to its end, and says so once; its echo, or one
    of another kind, changes nothing. Events: signals, and pauses in s."""
    process = _start(SHORT)
    for event in events:
        time.sleep(event) if isinstance(event, float) else process.send_signal(event)
    said, errors = process.communicate(timeout=20)
    assert (process.returncode, said) == (code, "ended\n")
    assert errors.count(f"{events[0].name}: saving") == 1


def test_second_signal_of_a_kind_ends_at_once():
    """Claim: a second signal of the same kind ends the process even while C code runs."""
    process = _start(LONG)
    begun = time.monotonic()
    process.send_signal(signal.SIGINT)
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=15)
    assert process.returncode == 130
    assert time.monotonic() - begun < 10.0
