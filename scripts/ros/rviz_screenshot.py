"""Show a recording in RViz under Xvfb, tracked by `gvo live ros1`, and write a picture of it.

Example: python scripts/ros/rviz_screenshot.py RECORDING rviz.png

Debian, Ubuntu: apt-get install rviz xvfb imagemagick python3-rosmaster python3-rospy
"""

import argparse
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from xmlrpc.client import ServerProxy

HERE = Path(__file__).parent
DRAWN_S = 5.0
SIZE = "1280x800"


def main() -> None:
    """Parse the arguments, and take the picture when all is played."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--config", type=Path, default=HERE / "gvo.rviz")
    parser.add_argument("--option", action="append", default=[], help="of gvo live, repeatable")
    arguments = parser.parse_args()
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        port = free_port()
        display = f":{port}"
        world = os.environ | {
            "ROS_MASTER_URI": f"http://127.0.0.1:{port}",
            "ROS_IP": "127.0.0.1",
            "ROS_HOME": folder,
            "DISPLAY": display,
            "LIBGL_ALWAYS_SOFTWARE": "1",
            "XDG_RUNTIME_DIR": folder,
        }
        for command in (
            ["rosmaster", "--core", "-p", str(port)],
            ["Xvfb", display, "-screen", "0", f"{SIZE}x24", "+extension", "GLX"],
        ):
            stack.enter_context(running(command, world))
        simulate_clock(world["ROS_MASTER_URI"])
        gvo = [sys.executable, "-c", "from gvo.cli import main; main()"]
        live = [*gvo, "live", "ros1", "--no-report", "--out", f"{folder}/run", *arguments.option]
        stack.enter_context(running(live, world))
        stack.enter_context(running(["rviz", "-d", str(arguments.config)], world))
        time.sleep(DRAWN_S)
        player = [sys.executable, str(HERE / "play.py"), str(arguments.recording)]
        subprocess.run(player, env=world, check=True)
        time.sleep(DRAWN_S)
        picture = ["import", "-window", "root", str(arguments.picture)]
        subprocess.run(picture, env=world, check=True)


def free_port() -> int:
    """Return a port of the loopback on which nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def running(command: list[str], world: dict[str, str]) -> Iterator[None]:
    """Run a program until the end of the block."""
    with subprocess.Popen(command, env=world) as process:
        try:
            yield
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()


def simulate_clock(master: str) -> None:
    """Have all nodes take their time from `/clock`, when the master is there."""
    with ServerProxy(master) as server:
        for _ in range(100):
            try:
                server.setParam("/rviz_screenshot", "/use_sim_time", True)
            except ConnectionError:
                time.sleep(0.1)
            else:
                return
    sys.exit("the master does not answer")


if __name__ == "__main__":
    main()
