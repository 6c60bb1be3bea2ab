"""Certificates as an operator makes them, judged by OpenSSL's own verification (Python's ``ssl``)."""

from __future__ import annotations

import contextlib
import ssl
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.x509.oid import NameOID

from scripts.make_certificates import (
    MakeCertificatesError,
    main,
    make,
    new_authority,
    new_certificate,
    open_authority,
    write_site,
)


def handshake(server: Path, client: Path | None, name: str, ca: Path | None = None) -> None:
    """A TLS handshake in memory in which both ends verify the other; ssl.SSLError when one refuses."""
    there = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH, cafile=server / "ca.pem")
    there.load_cert_chain(server / "certificate.pem", server / "key.pem")
    there.verify_mode = ssl.CERT_REQUIRED
    here = ssl.create_default_context(cafile=(ca or client or server) / "ca.pem")
    if client is not None:
        here.load_cert_chain(client / "certificate.pem", client / "key.pem")
    up, down = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = [here.wrap_bio(down, up, server_hostname=name), there.wrap_bio(up, down, server_side=True)]
    for _ in range(4):
        for end in ends:
            with contextlib.suppress(ssl.SSLWantReadError):
                end.do_handshake()
    with contextlib.suppress(ssl.SSLWantReadError):
        ends[0].read(1)  # TLS 1.3: a refused client hears of it only now
    for end in ends:
        end.do_handshake()  # raises when either still waits for the other


@pytest.fixture
def sites(tmp_path: Path) -> Path:
    make(tmp_path / "c", [("studio", ["studio.example", "127.0.0.1", "::1"]), ("lobby", [])])
    return tmp_path / "c"


@pytest.mark.parametrize("name", ["studio.example", "127.0.0.1", "::1"])
def test_two_sites_know_each_other(sites: Path, name: str) -> None:
    handshake(sites / "studio", sites / "lobby", name)


def test_what_does_not_fit_is_refused(sites: Path, tmp_path: Path) -> None:
    with pytest.raises(ssl.SSLError, match="Hostname mismatch"):
        handshake(sites / "studio", sites / "lobby", "lobby.example")
    with pytest.raises(ssl.SSLError, match="peer did not return a certificate"):
        handshake(sites / "studio", None, "studio.example")
    make(tmp_path / "other", [("studio", ["studio.example"])])
    with pytest.raises(ssl.SSLError, match="verify failed"):
        handshake(tmp_path / "other" / "studio", sites / "lobby", "studio.example")
    with pytest.raises(ssl.SSLError, match="verify failed"):
        handshake(sites / "studio", tmp_path / "other" / "studio", "studio.example", ca=sites)


def test_a_bound_authority_vouches_for_nothing_else(tmp_path: Path) -> None:
    authority = new_authority(only=["example", "10.0.0.0/8"])
    for folder, address in (("good", "a.example"), ("net", "10.1.2.3"), ("bad", "a.test"), ("far", "192.0.2.1")):
        write_site(tmp_path / folder, authority, *new_certificate(authority, "studio", [address]))
    handshake(tmp_path / "good", tmp_path / "net", "a.example")
    handshake(tmp_path / "net", tmp_path / "good", "10.1.2.3")
    for folder, address in (("bad", "a.test"), ("far", "192.0.2.1")):
        with pytest.raises(ssl.SSLError, match="permitted subtree violation"):
            handshake(tmp_path / folder, tmp_path / "good", address)


def test_keys_are_their_owners_alone_and_nothing_is_overwritten(sites: Path) -> None:
    for key in (sites / "ca.key", sites / "studio" / "key.pem", sites / "lobby" / "key.pem"):
        assert key.stat().st_mode & 0o777 == 0o600
    before = {file: file.read_bytes() for file in sites.rglob("*") if file.is_file()}
    with pytest.raises(MakeCertificatesError, match="studio exists"):
        make(sites, [("wall", []), ("studio", ["studio.example"])])
    assert {file: file.read_bytes() for file in sites.rglob("*") if file.is_file()} == before


def test_a_site_is_added_to_the_same_authority(sites: Path) -> None:
    ca = (sites / "ca.pem").read_bytes()
    make(sites, [("wall", ["wall.example"])])
    assert (sites / "wall" / "ca.pem").read_bytes() == ca
    handshake(sites / "wall", sites / "studio", "wall.example")


def test_the_common_name_is_the_site_and_it_is_no_authority(sites: Path) -> None:
    certificate = x509.load_pem_x509_certificate((sites / "lobby" / "certificate.pem").read_bytes())
    (name,) = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    assert name.value == "lobby"
    assert not certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["Studio"], "site 'Studio'"),
        (["a.b"], "site 'a.b'"),
        (["../x"], "site '../x'"),
        (["studio=host:7447"], "address 'host:7447'"),
        (["studio=*.example"], "address '*.example'"),
        (["--only", "10.0.0.1/8", "studio"], "--only '10.0.0.1/8'"),
        (["--days", "0", "studio"], "--days 0"),
    ],
)
def test_mistakes_are_named_and_leave_no_site_behind(
    arguments: list[str], complaint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(tmp_path / "c"), *arguments]) == 1
    assert complaint in capsys.readouterr().err
    assert not list((tmp_path / "c").glob("*/"))


def test_half_an_authority_is_not_completed(sites: Path) -> None:
    (sites / "ca.key").unlink()
    with pytest.raises(MakeCertificatesError, match="cannot be used"):
        open_authority(sites)
    with pytest.raises(MakeCertificatesError, match="--only binds a new authority"):
        open_authority(sites, only=["example"])
