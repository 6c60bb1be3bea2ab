"""Real daemons with certificates on the two sides of an emulated network, asked and signalled from outside it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from scripts.daemon_processes import Running, Site
from scripts.link_model import LinkConditions
from scripts.make_certificates import make
from scripts.network_emulation import EmulatedNetwork, Side, emulated_network

PORT = 7447


class RunningInside(Running):
    """A process in a namespace."""

    def __init__(
        self,
        name: str,
        command: list[str],
        folder: Path,
        http_port: int | None,
        together: list[Running],
        network: EmulatedNetwork,
        side: Side,
    ) -> None:
        self._network, self._side = network, side
        super().__init__(name, network.command(side, command), folder, http_port, together)

    def get(self, path: str) -> tuple[int, str]:
        with self._network.inside(self._side):
            return super().get(path)


class EmulatedSite(Site):
    """The rig and the sender on side A, receivers on side B."""

    def __init__(self, folder: Path, network: EmulatedNetwork) -> None:
        super().__init__(folder)
        self.network = network
        self._sites = folder / "certificates"
        make(self._sites, [("studio", [network.addresses["A"]]), ("lobby", [])])

    def sender(self, *options: str) -> Running:
        self.link = f"0.0.0.0:{PORT}"
        return super().sender("--certificates", str(self._sites / "studio"), "--receiver", "lobby", *options)

    def receiver(self, *options: str, name: str = "receiver", headless: bool = True) -> Running:
        self.link = f"{self.network.addresses['A']}:{PORT}"
        own = ("--certificates", str(self._sites / "lobby"), "--name", name)
        return super().receiver(*own, *options, name=name, headless=headless)

    def _start(self, name: str, command: list[str], port: int | None = None) -> Running:
        side: Side = "A" if name in ("rig", "sender") else "B"
        started = RunningInside(name, command, self.folder, port, self.running, self.network, side)
        self.running.append(started)
        return started


@contextlib.contextmanager
def emulated_site(folder: Path, path: LinkConditions, mtu: int = 1500) -> Iterator[EmulatedSite]:
    """A site whose processes end with the context, and after them the network.

    Raises:
        EmulationError: there can be no emulation here.
    """
    with emulated_network(path, mtu=mtu) as network:
        made = EmulatedSite(folder, network)
        try:
            yield made
        finally:
            made.close()
