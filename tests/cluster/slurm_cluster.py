# slurm_cluster.py - a real Slurm on this machine: a controller and nodes n1, n2, ... of one core, all in one folder.
# Needs root. `with SlurmCluster(folder) as slurm:` stops everything at its end.
# SPDX-License-Identifier: Apache-2.0
import os
import shutil
import signal
import socket
import subprocess
import time

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "scontrol", "sinfo")

# cred_expire: how long a job that lost its node waits before it restarts.
SLURM_CONF = """
ClusterName=rgs
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={port}
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket,cred_expire=5
MpiDefault=none
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
SlurmdParameters=config_overrides
SwitchType=switch/none
ReturnToService=2
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool-%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd-%n.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd-%n.log
SchedulerParameters=batch_sched_delay=0
SlurmdTimeout={slurmd_timeout}
KillWait=2
"""


def find(program):
    return shutil.which(program, path=os.environ["PATH"] + ":/usr/sbin:/sbin")


def missing():
    """The reason why no cluster can run here, or None."""
    absent = [program for program in PROGRAMS if find(program) is None]
    if absent:
        return f"{', '.join(absent)} not installed"
    return None if os.geteuid() == 0 else "Slurm's daemons need root"


def reserved_ports(n):
    """Sockets of n free ports. While they are open no other cluster gets these ports, but daemons can listen there."""
    sockets = [socket.socket() for _ in range(n)]
    for s in sockets:
        s.bind(("127.0.0.1", 0))
        s.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    return sockets


def wait_for(condition):
    while not condition():
        time.sleep(0.1)


def read_proc(pid, what):
    try:
        with open(f"/proc/{pid}/{what}", encoding="utf-8", errors="replace") as file:
            return file.read()
    except OSError:
        return ""  # ended meanwhile


def parent_of(pid):
    after_name = read_proc(pid, "stat").rpartition(")")[2].split()
    return int(after_name[1]) if after_name else 0


def name_of(pid):
    return read_proc(pid, "comm").strip()


def end(pid):
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        pass


class SlurmCluster:
    def __init__(self, folder, nodes=("n1", "n2"), slurmd_timeout=60_000):
        """slurmd_timeout: seconds after which a node that does not answer is down."""
        self.folder, self.nodes, self.slurmd_timeout = os.path.abspath(folder), nodes, slurmd_timeout
        self.environment = dict(os.environ, SLURM_CONF=f"{self.folder}/slurm.conf")
        self._daemons = {}  # name: process; stopped in reverse order
        self._reserved = []

    def __enter__(self):
        try:
            self._start()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_):
        if os.path.exists(f"{self.folder}/slurm.conf") and "slurmctld" in self._daemons:
            subprocess.run(["scancel", "--user=root", "--signal=KILL"], env=self.environment, check=False)
        for name in reversed(list(self._daemons)):
            self.stop(name)
        for pid in self.processes():  # jobs outlive the daemons that started them
            end(pid)
        for s in self._reserved:
            s.close()

    def _start(self):
        os.makedirs(self.folder + "/state")
        with open(self.folder + "/munge.key", "wb", opener=lambda p, f: os.open(p, f, 0o400)) as key:
            key.write(os.urandom(128))
        host = socket.gethostname()
        self._reserved = reserved_ports(1 + len(self.nodes))
        ports = [s.getsockname()[1] for s in self._reserved]
        with open(self.folder + "/slurm.conf", "w", encoding="utf-8") as conf:
            conf.write(SLURM_CONF.format(host=host, port=ports[0], folder=self.folder,
                                         slurmd_timeout=self.slurmd_timeout))
            for node, port in zip(self.nodes, ports[1:]):
                os.makedirs(f"{self.folder}/spool-{node}")
                conf.write(f"NodeName={node} NodeHostname={host} NodeAddr=127.0.0.1 Port={port} CPUs=1 RealMemory=4000\n")
            conf.write(f"PartitionName=all Nodes={','.join(self.nodes)} Default=YES MaxTime=INFINITE State=UP\n")
        self._launch("munged", "--foreground", "--force", f"--socket={self.folder}/munge.socket",
                     f"--key-file={self.folder}/munge.key", f"--pid-file={self.folder}/munged.pid",
                     f"--log-file={self.folder}/munged.log", f"--seed-file={self.folder}/munge.seed")
        wait_for(lambda: os.path.exists(f"{self.folder}/munge.socket"))
        self._launch("slurmctld", "-D", "-i")
        for node in self.nodes:
            self._launch("slurmd", "-D", "-N", node, name=node)
        wait_for(lambda: self.states() == ["idle"] * len(self.nodes))

    def _launch(self, program, *arguments, name=None):
        with open(f"{self.folder}/{name or program}.out", "wb") as out:
            # A process group of its own: Ctrl-C ends the test, which then stops the daemons in order.
            self._daemons[name or program] = subprocess.Popen(
                [find(program), *arguments], env=self.environment, stdout=out, stderr=out, stdin=subprocess.DEVNULL,
                start_new_session=True)

    def stop(self, name, how=signal.SIGTERM):
        """Stops a daemon by name: munged, slurmctld or a node."""
        daemon = self._daemons.pop(name)
        daemon.send_signal(how)
        daemon.wait()

    def kill_node(self, name):
        """As if its machine lost power: no process reports anything."""
        self.stop(name, signal.SIGKILL)
        jobs = self.processes(f"SLURMD_NODENAME={name}")
        # A slurmstepd is the parent of its job and would report the job's end.
        steps = {pid for pid in map(parent_of, jobs) if name_of(pid) == "slurmstepd"}
        for pid in [*steps, *jobs]:
            end(pid)

    def states(self):
        said = self.run("sinfo", "--noheader", "--Node", "--format=%T", check=False)
        return said.stdout.split() if said.returncode == 0 else []

    def run(self, *command, check=True):
        return subprocess.run(command, env=self.environment, capture_output=True, text=True, check=check)

    def processes(self, variable=None):
        """All processes of this cluster, or only those with a variable in their environment."""
        marks = {f"SLURM_CONF={self.folder}/slurm.conf"} | ({variable} if variable else set())
        found = []
        for pid in map(int, filter(str.isdigit, os.listdir("/proc"))):
            if marks <= set(read_proc(pid, "environ").split("\0")) and pid != os.getpid():
                found.append(pid)
        return found
