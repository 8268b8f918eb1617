"""A scene's lease, with real processes: who is at work is waited for, the dead are not, and nobody has it twice."""

import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from photonfarm.core.errors import StoreError
from photonfarm.core.processes import process_space
from photonfarm.store import Store
from photonfarm.store.io.local import LocalStorage
from photonfarm.store.model import lease as leasing
from photonfarm.store.model.lease import LeasedError, announce_work, hold_lease, read_leases

SCENE = "0123456789abcdef0123456789abcdef"

AT_WORK = """
import sys, time
from photonfarm.store import Store
from photonfarm.store.model.lease import announce_work
with announce_work(Store(sys.argv[1]).storage, sys.argv[2], "worker w1 at job 12"):
    print("in", flush=True)
    sys.stdin.readline()
"""


@pytest.fixture
def storage(tmp_path: Path) -> LocalStorage:
    storage = Store(tmp_path / "store", create=True).storage
    assert isinstance(storage, LocalStorage)
    return storage


@pytest.fixture
def worker(storage: LocalStorage) -> Iterator[subprocess.Popen[str]]:
    """Another process that is at work until it gets a line."""
    command = [sys.executable, "-c", AT_WORK, storage.where, SCENE]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "in\n"
        yield process
        process.kill()


def test_a_lease_waits_for_who_is_at_work_and_says_whom(storage: LocalStorage, worker: subprocess.Popen[str]) -> None:
    waited: list[str] = []

    def let_go(sentence: str) -> None:
        waited.append(sentence)
        assert worker.stdin is not None
        worker.stdin.write("\n")
        worker.stdin.flush()

    with hold_lease(storage, SCENE, "store check --repair", let_go):
        assert worker.wait() == 0
        assert "store check --repair" in read_leases(storage)[SCENE]
    assert f"scene {SCENE}: store check --repair waits for worker w1 at job 12" in waited[0]
    assert str(worker.pid) in waited[0]
    assert read_leases(storage) == {}


def test_nobody_begins_to_work_under_a_lease_and_other_scenes_are_free(storage: LocalStorage) -> None:
    refused = pytest.raises(LeasedError, match=r"store forget .* has it for itself")
    with hold_lease(storage, SCENE, "store forget", pytest.fail):
        with refused, announce_work(storage, SCENE, "worker w1 at job 3"):
            pytest.fail("worked under a lease")
        with announce_work(storage, SCENE[::-1], "worker w1 at job 3"):
            pass
    with announce_work(storage, SCENE, "worker w1 at job 3"):
        pass


def test_who_may_wait_goes_on_when_the_lease_has_ended(storage: LocalStorage) -> None:
    taken, said = threading.Event(), threading.Event()

    def hold() -> None:
        with hold_lease(storage, SCENE, "store join", print):
            taken.set()
            said.wait(10)

    thread = threading.Thread(target=hold)
    thread.start()
    taken.wait(10)
    with announce_work(storage, SCENE, "submit", on_wait=lambda _: said.set()):
        assert said.is_set()
    thread.join()


def test_two_never_have_the_lease_at_once(storage: LocalStorage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leasing, "LOOK_S", 0.01)
    inside, most = [0], [0]

    def hold() -> None:
        for _ in range(4):
            with hold_lease(storage, SCENE, "store withdraw", lambda _: None):
                inside[0] += 1
                most[0] = max(most[0], inside[0])
                time.sleep(0.01)
                inside[0] -= 1

    threads = [threading.Thread(target=hold) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == [1]


def test_the_killed_are_not_waited_for(storage: LocalStorage, worker: subprocess.Popen[str]) -> None:
    worker.send_signal(signal.SIGKILL)
    worker.wait()
    with hold_lease(storage, SCENE, "store check --repair", pytest.fail):
        pass
    assert storage.names(f"{leasing.LEASES}/{SCENE}") == []


def test_two_who_find_a_lease_of_the_dead_do_not_both_take_it(
    storage: LocalStorage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(leasing, "LOOK_S", 0.01)
    inside, most = [0], [0]
    name = Path(storage.where, leasing.LEASES, f"{SCENE}.json")
    name.parent.mkdir(exist_ok=True)
    document = {"what": "store join", "space": process_space(), "process": 2**22, "token": "dead", "beat": 0}

    def hold(begun: threading.Barrier) -> None:
        begun.wait()
        with hold_lease(storage, SCENE, "store withdraw", lambda _: None):
            inside[0] += 1
            most[0] = max(most[0], inside[0])
            time.sleep(0.01)
            inside[0] -= 1

    for _ in range(10):
        name.write_text(json.dumps(document))
        begun = threading.Barrier(3)
        threads = [threading.Thread(target=hold, args=(begun,)) for _ in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert most == [1]
    assert read_leases(storage) == {}


def test_who_was_suspended_for_too_long_notices_that_others_went_on(
    storage: LocalStorage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(leasing, "SILENT_S", -1.0)  # everybody counts as dead
    monkeypatch.setattr(leasing, "BEAT_S", 0.01)
    with hold_lease(storage, SCENE, "store forget", pytest.fail) as held:
        held.check()
        with hold_lease(storage, SCENE, "store join", pytest.fail) as other:
            with pytest.raises(StoreError, match="store forget was silent for so long that others went on"):
                held.check()
            time.sleep(0.1)
            other.check()
    assert storage.names(leasing.LEASES) in ([], [SCENE])


def test_who_is_silent_on_another_machine_counts_as_dead(
    storage: LocalStorage, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = Path(storage.where, leasing.LEASES, f"{SCENE}.json")
    name.parent.mkdir(exist_ok=True)
    name.write_text(json.dumps({"what": "store join", "space": "elsewhere-1", "process": 1, "beat": 7}))
    assert "store join (elsewhere, process 1)" in read_leases(storage)[SCENE]
    now = time.monotonic()
    monkeypatch.setattr(leasing.time, "monotonic", lambda: now + leasing.SILENT_S + 1)
    assert read_leases(storage) == {}
    name.write_text(json.dumps({"what": "store join", "space": "elsewhere-1", "process": 1, "beat": 8}))
    assert SCENE in read_leases(storage)  # it lives


def test_it_is_renewed(storage: LocalStorage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leasing, "BEAT_S", 0.01)
    with hold_lease(storage, SCENE, "store join", pytest.fail):
        time.sleep(0.2)
        assert json.loads(storage.read(f"{leasing.LEASES}/{SCENE}.json"))["beat"] > 1


def test_a_reader_of_a_store_that_cannot_be_written_announces_nothing(
    storage: LocalStorage, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> bool:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(LocalStorage, "adopt", refuse)
    with announce_work(storage, SCENE, "trainer of run r"):
        assert storage.names(f"{leasing.LEASES}/{SCENE}") == []
