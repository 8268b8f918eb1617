"""Long work says what it does at least every few seconds; Ctrl-C ends it at once, also inside native code."""

import signal
import subprocess
import sys
import time

import pytest

from photonfarm.core.waiting import Steps, WorkLog, pause_after_look


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


def test_the_time_left_follows_from_the_steps_that_are_done_and_never_rises_while_one_is_in_hand() -> None:
    now = [0.0]
    steps = Steps(8, clock=lambda: now[0])
    now[0] = 10.0
    assert (steps.left_s, steps.words()) == (None, "0 of 8")
    steps.reach(2)
    assert steps.words() == "2 of 8, about 30 s left"
    left = []
    for now[0] in (12.0, 14.0, 19.0, 60.0):
        left.append(steps.left_s)
    assert left == [28.0, 26.0, 21.0, 20.0], "those in hand last longer than expected, and the rest not more"
    steps.reach(8)
    assert steps.words() == "8 of 8, about 0 s left"


def test_slow_first_steps_say_how_long_the_rest_takes_at_most_and_do_not_count_afterwards() -> None:
    now = [0.0]
    steps = Steps(8, slow=2, clock=lambda: now[0])
    now[0] = 60.0
    steps.reach(1)
    assert steps.words() == "1 of 8, at most 7 min left"
    now[0] = 64.0
    steps.reach(2)
    now[0] = 67.0
    steps.reach(3)
    assert steps.words() == "3 of 8, about 15 s left"


@pytest.mark.usefixtures("hears_ctrl_c")
def test_ctrl_c_ends_native_code_at_once() -> None:
    code = (
        "from photonfarm.core.processes import end_on_ctrl_c\n"
        "with end_on_ctrl_c():\n    print('in', flush=True); sum(range(10**12))"  # looks at no signal until it ends
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "in\n"
        time.sleep(0.2)
        child.send_signal(signal.SIGINT)
        assert child.wait(2) == -signal.SIGINT


def test_slow_looks_take_a_twentieth_of_the_time_and_pauses_end() -> None:
    assert pause_after_look(0.01, 1.0) == 1.0
    assert pause_after_look(0.5, 1.0) == 10.0
    assert pause_after_look(300.0, 1.0) == 60.0
    assert pause_after_look(300.0, 90.0) == 90.0
