"""Long work says what it does at least every few seconds; Ctrl-C ends it at once, also inside native code."""

import signal
import subprocess
import sys
import time

import pytest

from photonfarm.shared.core.processes import ended_by_ctrl_c
from photonfarm.shared.core.waiting import WorkLog, time_left


def test_what_is_done_is_said_again_with_how_far_it_is() -> None:
    lines: list[str] = []
    with WorkLog(lines.append, silence_s=0.1) as work_log:
        work_log.begin("loading")
        work_log.begin("measuring", lambda: "3 of 8")
        time.sleep(0.35)
    assert lines[:2] == ["loading", "measuring"]
    assert 1 <= len(lines[2:]) <= 4
    assert all(line.startswith("measuring: ") and line.endswith(", 3 of 8") for line in lines[2:])
    said = len(lines)
    time.sleep(0.2)
    assert len(lines) == said, "nothing is said after the end"


def test_the_time_left_follows_from_the_steps_that_are_done() -> None:
    assert time_left(0, 8, time.monotonic()) == "0 of 8"
    assert time_left(2, 8, time.monotonic() - 10).startswith("2 of 8, about 30 s")


@pytest.mark.usefixtures("hears_ctrl_c")
def test_ctrl_c_ends_native_code_at_once() -> None:
    code = (
        "from photonfarm.shared.core.processes import ended_by_ctrl_c\n"
        "with ended_by_ctrl_c():\n    print('in', flush=True); sum(range(10**12))"  # looks at no signal until it ends
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "in\n"
        time.sleep(0.2)
        child.send_signal(signal.SIGINT)
        assert child.wait(2) == -signal.SIGINT


@pytest.mark.usefixtures("hears_ctrl_c")
def test_afterwards_ctrl_c_is_what_it_was() -> None:
    before = signal.getsignal(signal.SIGINT)
    with ended_by_ctrl_c():
        assert signal.getsignal(signal.SIGINT) is signal.SIG_DFL
    assert signal.getsignal(signal.SIGINT) is before
