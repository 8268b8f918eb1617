"""A SLURM of two nodes with two cores each on this machine, which a test starts and ends.

It needs Debian's packages slurmctld, slurmd, slurm-client and munge, and root, as `slurmd` does. The partition `low` is
the default one; jobs of `high` preempt its jobs, which then go back into the queue. Each node has two GPUs in name.
"""

import contextlib
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from photonfarm.core.processes import free_port

COMMANDS = ("slurmctld", "slurmd", "sbatch", "squeue", "munged")
NODES = ("n1", "n2")
PATHS = os.pathsep.join((os.environ.get("PATH", ""), "/usr/sbin", "/sbin"))

CONFIGURATION = """\
ClusterName=test
SlurmctldHost=localhost(127.0.0.1)
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CredType=cred/munge
SlurmctldPort={ports[0]}
StateSaveLocation={folder}/state
SlurmctldPidFile={folder}/slurmctld.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdSpoolDir={folder}/%n
SlurmdPidFile={folder}/%n.pid
SlurmdLogFile={folder}/%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
GresTypes=gpu
ReturnToService=2
SlurmdTimeout=30
KillWait=10
SchedulerParameters=sched_interval=5
NodeName=n1 NodeHostname=localhost NodeAddr=127.0.0.1 Port={ports[1]} CPUs=2 RealMemory=2000 Gres=gpu:2
NodeName=n2 NodeHostname=localhost NodeAddr=127.0.0.1 Port={ports[2]} CPUs=2 RealMemory=2000 Gres=gpu:2
PartitionName=low Nodes=n[1-2] Default=YES MaxTime=60 State=UP PriorityTier=1
PartitionName=high Nodes=n[1-2] MaxTime=60 State=UP PriorityTier=10
"""


GPUS = """\
NodeName=n1 Name=gpu File=/dev/null
NodeName=n1 Name=gpu File=/dev/zero
NodeName=n2 Name=gpu File=/dev/full
NodeName=n2 Name=gpu File=/dev/urandom
"""
"""Any devices will do."""


def lacking() -> str:
    """Why no SLURM can be started here; "" if one can."""
    missing = [name for name in COMMANDS if shutil.which(name, path=PATHS) is None]
    if missing:
        return f"SLURM is not installed: {', '.join(missing)} (Debian: slurmctld slurmd slurm-client munge)"
    return "" if os.geteuid() == 0 else "slurmd needs root"


@dataclass(frozen=True)
class Cluster:
    """A running cluster."""

    folder: Path

    @property
    def environment(self) -> dict[str, str]:
        """What SLURM's commands need to find it."""
        return {"SLURM_CONF": str(self.folder / "slurm.conf")}

    def run(self, *words: str | Path) -> str:
        """What a command says; raises CalledProcessError if it fails."""
        environment = os.environ | self.environment | {"PATH": PATHS}
        return subprocess.run(
            [str(word) for word in words], env=environment, check=True, capture_output=True, text=True
        ).stdout.strip()

    def states(self, job: str) -> dict[str, str]:
        """The states of a job's tasks that have not ended, as R or PD, by the tasks' names."""
        lines = self.run("squeue", "--noheader", "--array", "--format", "%i %t").splitlines()
        found = dict(line.split() for line in lines)
        return {name: state for name, state in found.items() if name.partition("_")[0] == job}

    def about(self, task: str) -> dict[str, str]:
        """All that SLURM says of a task."""
        words = self.run("scontrol", "--oneliner", "show", "job", task).split()
        return dict(word.split("=", 1) for word in words if "=" in word)

    def start_node(self, name: str) -> None:
        """Start the daemon of a node, and wait until it takes jobs."""
        self.run("slurmd", "-N", name)
        deadline = time.monotonic() + 60
        while not self.run("sinfo", "--noheader", "--nodes", name, "--format", "%t").startswith(("idle", "mix", "all")):
            assert time.monotonic() < deadline, (self.folder / f"{name}.log").read_text()
            time.sleep(0.5)

    def kill_node(self, name: str) -> None:
        """Kill the daemon of a node, whose processes go on."""
        os.kill(int((self.folder / f"{name}.pid").read_text()), signal.SIGKILL)


@contextlib.contextmanager
def running(folder: Path) -> Iterator[Cluster]:
    """Run a cluster with all its files in a folder, until the block ends."""
    for name in ("state", *NODES):
        (folder / name).mkdir(parents=True)
    folder.chmod(0o755)
    (folder / "key").write_bytes(os.urandom(1024))
    (folder / "key").chmod(0o600)
    (folder / "gres.conf").write_text(GPUS)
    ports = [free_port() for _ in range(3)]
    (folder / "slurm.conf").write_text(CONFIGURATION.format(folder=folder, ports=ports))
    cluster = Cluster(folder)
    munge = {"key-file": "key", "socket": "munge.socket", "pid-file": "munged.pid", "log-file": "munged.log"}
    files = [f"--{option}={folder / name}" for option, name in (munge | {"seed-file": "munged.seed"}).items()]
    try:
        cluster.run("munged", "--force", *files)
        cluster.run("slurmctld")
        for name in NODES:
            cluster.start_node(name)
        yield cluster
    finally:
        with contextlib.suppress(subprocess.CalledProcessError):
            cluster.run("scancel", "--user", "root")
            time.sleep(3)
        for name in (*NODES, "slurmctld", "munged"):
            with contextlib.suppress(FileNotFoundError, ProcessLookupError, ValueError):
                os.kill(int((folder / f"{name}.pid").read_text()), signal.SIGTERM)
