"""Simulated hosts: network namespaces on this machine, connected by a bridge in a namespace of its own."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, Self


class Hosts:
    """Hosts on one network, 10.77.0.1 and so on, which are removed on close; needs root and Debian's iproute2.

    Raises
    ------
    OSError
        If they cannot be made.
    """

    def __init__(self, *names: str) -> None:
        self.addresses = {name: f"10.77.0.{number}" for number, name in enumerate(names, start=1)}
        self._mark = f"catstream-{os.getpid()}"

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self._namespace(stack, "switch")
            self._ip("-n", self._named("switch"), "link", "add", "bridge", "type", "bridge")
            self._ip("-n", self._named("switch"), "link", "set", "bridge", "up")
            for name in self.addresses:
                self._namespace(stack, name)
                self._plug_in(name)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def start(self, name: str, *command: object, **options: Any) -> subprocess.Popen[str]:
        """Start a command on a host; it is killed when the hosts are removed."""
        words = ["ip", "netns", "exec", self._named(name), *map(str, command)]
        process = subprocess.Popen(words, stdin=subprocess.DEVNULL, text=True, **options)
        self._stack.enter_context(process)
        self._stack.callback(process.kill)
        return process

    @contextmanager
    def cut_off(self, name: str) -> Iterator[None]:
        """Drop all packets from and to a host inside a `with`, without closing connections."""
        port = ["-n", self._named("switch"), "link", "set", name]
        self._ip(*port, "down")
        try:
            yield
        finally:
            self._ip(*port, "up")

    def power_off(self, name: str, *processes: subprocess.Popen[str]) -> None:
        """Restart a host: its processes and the state of its connections are lost, without notice to other hosts."""
        with self.cut_off(name):
            for process in processes:
                process.kill()
                process.wait()
            self._ip("netns", "delete", self._named(name))
            self._ip("netns", "add", self._named(name))
            self._ip("-n", self._named("switch"), "link", "delete", name)
            self._plug_in(name)

    def _plug_in(self, name: str) -> None:
        host, port = self._named(name), ["-n", self._named("switch"), "link"]
        self._ip(*port, "add", name, "type", "veth", "peer", "name", "eth0", "address", self._mac(name), "netns", host)
        self._ip(*port, "set", name, "master", "bridge", "up")
        self._ip("-n", host, "address", "add", f"{self.addresses[name]}/24", "dev", "eth0")
        for device in ("eth0", "lo"):
            self._ip("-n", host, "link", "set", device, "up")

    def _mac(self, name: str) -> str:
        """A host keeps it when it restarts, as real ones do: others would send to the old one for a minute or two."""
        return f"02:00:00:00:00:{list(self.addresses).index(name):02x}"

    def _namespace(self, stack: ExitStack, name: str) -> None:
        self._ip("netns", "add", self._named(name))
        stack.callback(self._ip, "netns", "delete", self._named(name))

    def _named(self, name: str) -> str:
        return f"{self._mark}-{name}"

    def _ip(self, *words: str) -> None:
        program = shutil.which("ip", path=os.pathsep.join([os.environ["PATH"], "/usr/sbin"]))
        if program is None:
            raise OSError("the command ip is not installed: apt-get install iproute2")
        done = subprocess.run([program, *words], capture_output=True, text=True, check=False)
        if done.returncode:
            raise OSError(f"ip {' '.join(words)}: {done.stderr.strip()}")
