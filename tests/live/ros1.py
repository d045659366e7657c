"""A master of ROS 1 on the loopback, and programs that talk through it, for tests."""

import json
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from xmlrpc.client import ServerProxy

import pytest

from tests.conftest import ENVIRONMENT
from tests.live.pipe import Program

DEBIAN = Path("/usr/lib/python3/dist-packages")
PACKAGES = ("rospy", "rosmaster", "sensor_msgs", "std_srvs", "dynamic_reconfigure", "nav_msgs")
INSTALL = "apt-get install " + " ".join(
    f"python3-{package.replace('_', '-')}" for package in (*PACKAGES, "tf2_msgs")
)


class Ros:
    """A master, and the environment in which its nodes run."""

    def __init__(self, folder: Path, port: int) -> None:
        self.environment = ENVIRONMENT | {
            "ROS_MASTER_URI": f"http://127.0.0.1:{port}",
            "ROS_HOME": str(folder),
            "ROS_LOG_DIR": str(folder / "log"),
            "PYTHONWARNINGS": "ignore",
        }
        for name in ("ROS_IP", "ROS_HOSTNAME"):
            self.environment.pop(name, None)
        self._programs: list[Program] = []

    def use_simulated_clock(self) -> None:
        """Have nodes that start take their time from `/clock`."""
        with ServerProxy(self.environment["ROS_MASTER_URI"]) as server:
            assert server.setParam("/test", "/use_sim_time", True)[0] == 1  # type: ignore[index]

    def end_node(self, name: str) -> None:
        """End a node as rosnode kill does."""
        with ServerProxy(self.environment["ROS_MASTER_URI"]) as server:
            uri = server.lookupNode("/test", name)[2]  # type: ignore[index]
        with ServerProxy(str(uri)) as node, suppress(ConnectionError):  # it may not answer
            node.shutdown("/test", "a test")

    def start(self, *command: object) -> Program:
        program = Program([sys.executable, *map(str, command)], self.environment)
        self._programs.append(program)
        return program

    def ask(self, *command: object) -> Any:
        """Run a program to its end and return what it prints, of JSON."""
        program = self.start(*command)
        code = program.end()
        assert code == 0, program.errors
        return json.loads("".join(program.lines) or "null")

    def kill(self) -> None:
        for program in self._programs:
            program.process.kill()
            program.end()


@contextmanager
def master(folder: Path) -> Iterator[Ros]:
    """Run a master on a free port of the loopback."""
    missing = [package for package in PACKAGES if not (DEBIAN / package).is_dir()]
    rosmaster = shutil.which("rosmaster")
    if missing or rosmaster is None:
        pytest.skip(f"no {', '.join(missing) or 'rosmaster'}: {INSTALL}")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    ros = Ros(folder, port)
    command = [rosmaster, "--core", "-p", str(port)]
    environment = ros.environment | {"ROS_IP": "127.0.0.1", "PYTHONPATH": ""}
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:
        try:
            while True:
                assert process.poll() is None, "rosmaster ended"
                with socket.socket() as probe:
                    if probe.connect_ex(("127.0.0.1", port)) == 0:
                        break
            yield ros
        finally:
            ros.kill()
            process.kill()
