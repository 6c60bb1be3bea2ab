"""What a process really listens on, as the kernel tells it."""

from __future__ import annotations

import os
from pathlib import Path

_LISTEN, _ANY_PEER = "0A", {"00000000:0000", "00000000000000000000000000000000:0000"}


def listening_ports(pid: int) -> set[tuple[str, int]]:
    """``("tcp", port)`` of sockets that accept connections, ``("udp", port)`` of those that take anyone's datagrams."""
    inodes = set()
    for descriptor in Path(f"/proc/{pid}/fd").iterdir():
        try:
            target = os.readlink(descriptor)
        except FileNotFoundError:  # closed meanwhile
            continue
        if target.startswith("socket:["):
            inodes.add(target.removeprefix("socket:[").removesuffix("]"))
    ports = set()
    for protocol in ("tcp", "tcp6", "udp", "udp6"):
        for line in Path(f"/proc/{pid}/net/{protocol}").read_text().splitlines()[1:]:
            fields = line.split()
            local, remote, state, inode = fields[1], fields[2], fields[3], fields[9]
            open_to_all = state == _LISTEN if protocol.startswith("tcp") else remote in _ANY_PEER
            if inode in inodes and open_to_all:
                ports.add((protocol[:3], int(local.rpartition(":")[2], 16)))
    return ports
