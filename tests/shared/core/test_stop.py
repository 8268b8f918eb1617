"""What a signal's handler sets: it may interrupt anything, also another handler."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from photonfarm.core.processes import NAP_S, Stop

WAITING = """
import signal, sys
from photonfarm.core.processes import Stop
stop = Stop()
signal.signal(signal.SIGTERM, lambda *_: stop.set())
print("ready", flush=True)
while not stop.wait(0.0001):
    pass
sys.stdin.read()  # more signals come
sys.exit(0 if stop.is_set() else 1)
"""


@pytest.mark.parametrize("storm", [0, *(pytest.param(storm, marks=pytest.mark.slow) for storm in range(1, 6))])
def test_a_storm_of_signals_ends_a_process_as_one_does(storm: int) -> None:
    """About every sixth of these storms left a process with a lock waiting for itself."""
    process = subprocess.Popen([sys.executable, "-c", WAITING], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        process.stdout.readline()
        for _ in range(3000):
            os.kill(process.pid, signal.SIGTERM)
        process.stdin.close()
        assert process.wait(30) == 0
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def test_who_waits_is_told_soon_and_else_waits_its_time() -> None:
    stop = Stop()
    began = time.monotonic()
    assert not stop.wait(0.05)
    assert 0.05 <= time.monotonic() - began < 5
    threading.Timer(0.1, stop.set).start()
    began = time.monotonic()
    assert stop.wait(60)
    assert time.monotonic() - began < 10 * NAP_S + 5
    assert stop.wait(60)
    assert stop.is_set()
