"""A Slurm cluster of one node, from Debian's packages slurm-wlm and munge, as the user who runs this.

`python tests/slurm/cluster.py COMMAND …` runs a command in it. Nothing outside its folder is touched: key,
sockets, ports, state and logs are its own.
"""

import contextlib
import getpass
import os
import secrets
import shutil
import socket
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "srun", "scontrol", "squeue")

_CONF = """\
ClusterName=one
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={controller}
SlurmdPort={daemon}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket,cred_expire=5
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmdParameters=config_overrides
ReturnToService=2
KillWait=2
SchedulerParameters=sched_interval=1,bf_interval=1
NodeName={host} NodeAddr=127.0.0.1 CPUs={cpus} State=UNKNOWN
PartitionName=short Nodes=ALL Default=YES MaxTime=60 State=UP
"""
# What submitit asks for the states of jobs; the real one needs a data base.
_SACCT = """\
#!/bin/sh
echo 'JobID|State|NodeList'
squeue --states=all --array --noheader --format='%i|%T|%N'
"""


def missing() -> list[str]:
    """Programs that are not there."""
    return [name for name in PROGRAMS if shutil.which(name, path=_path()) is None]


@contextlib.contextmanager
def cluster(cpus: int = 4) -> Iterator[dict[str, str]]:
    """The environment in which Slurm's commands speak to a new cluster; it ends with the block."""
    # Not below pytest's folders: a socket's path has at most 107 characters.
    folder = Path(tempfile.mkdtemp(prefix="slurm-"))
    environment = os.environ | {"SLURM_CONF": str(folder / "slurm.conf"), "PATH": f"{folder}/bin:{_path()}"}
    daemons: list[subprocess.Popen] = []
    try:
        _configure(folder, cpus)
        munged = (
            "munged", "--foreground", "--force",
            f"--socket={folder}/munge.socket", f"--key-file={folder}/key", f"--seed-file={folder}/seed",
            f"--pid-file={folder}/munged.pid", f"--log-file={folder}/munged.log",
        )  # fmt: skip
        for command in (munged, ("slurmctld", "-D", "-i"), ("slurmd", "-D", "-N", _host())):
            with open(folder / f"{command[0]}.out", "w") as out:
                daemons.append(subprocess.Popen(command, env=environment, stdout=out, stderr=out))
            if command[0] == "munged":
                _wait_for((folder / "munge.socket").exists, folder)
        _wait_for(lambda: "idle" in _sinfo(environment), folder)
        yield environment
    finally:
        for daemon in reversed(daemons):
            daemon.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                daemon.wait(10)
            daemon.kill()
        shutil.rmtree(folder, ignore_errors=True)


def _configure(folder: Path, cpus: int) -> None:
    for name in ("state", "spool", "bin"):
        (folder / name).mkdir()
    (folder / "key").write_bytes(secrets.token_bytes(128))
    (folder / "key").chmod(0o400)
    ports = [_free_port() for _ in range(2)]
    (folder / "slurm.conf").write_text(
        _CONF.format(
            folder=folder,
            host=_host(),
            user=getpass.getuser(),
            cpus=cpus,
            controller=ports[0],
            daemon=ports[1],
        )
    )
    sacct = folder / "bin" / "sacct"
    sacct.write_text(_SACCT)
    sacct.chmod(sacct.stat().st_mode | stat.S_IXUSR)
    folder.chmod(0o755)  # munge wants others to reach its socket


def _wait_for(ready, folder: Path, seconds: float = 60) -> None:
    began = time.monotonic()
    while not ready():
        if time.monotonic() - began > seconds:
            logs = "\n".join(
                f"--- {log.name}\n{log.read_text()[-2000:]}"
                for log in sorted([*folder.glob("*.log"), *folder.glob("*.out")])
            )
            raise RuntimeError(f"Slurm did not come up in {seconds:g} s\n{logs}")
        time.sleep(0.2)


def _sinfo(environment: dict[str, str]) -> str:
    done = subprocess.run(
        ["sinfo", "--noheader", "--format=%T"], env=environment, capture_output=True, text=True
    )
    return done.stdout


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def _host() -> str:
    return socket.gethostname().split(".")[0]


def _path() -> str:
    return f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"


if __name__ == "__main__":
    if absent := missing():
        sys.exit(f"not installed: {', '.join(absent)}; apt install slurm-wlm munge")
    with cluster() as where:
        sys.exit(subprocess.run(sys.argv[1:] or ["sinfo"], env=where).returncode)
