"""Certificates for tests of secured links."""

from __future__ import annotations

from pathlib import Path

from scripts.make_certificates import new_authority, new_certificate, write_site

ADDRESSES = {"studio": ["127.0.0.1"], "hub": ["127.0.0.1"], "elsewhere": ["elsewhere.example"]}


def make_sites(folder: Path) -> Path:
    """Folders ``studio lobby wall rogue hub elsewhere`` of one authority, ``expired`` (a lobby's of yesterday) and
    ``foreign`` (a lobby's of another authority)."""
    authority = new_authority()
    for name in ("studio", "lobby", "wall", "rogue", "hub", "elsewhere"):
        write_site(folder / name, authority, *new_certificate(authority, name, ADDRESSES.get(name, ())))
    write_site(folder / "expired", authority, *new_certificate(authority, "lobby", days=-1 / 48))
    other = new_authority()
    write_site(folder / "foreign", other, *new_certificate(other, "lobby", ["127.0.0.1"]))
    return folder
