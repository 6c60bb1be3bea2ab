"""Makes a certificate authority and one certificate per site, for mutual TLS between sites (RFC 5280).

A site's certificate carries its name as common name, which access rules go by, and the addresses others dial it under,
which they verify. Nothing is ever overwritten.
"""

from __future__ import annotations

import argparse
import datetime
import ipaddress
import os
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

CA_DAYS, SITE_DAYS = 3650, 397
_EARLIER = datetime.timedelta(hours=1)  # valid from then on: the sites' clocks need not agree to the second
_SITE = re.compile(r"[a-z0-9](?:[a-z0-9-]{0,38}[a-z0-9])?")
_HOST = re.compile(r"(?=.{1,253}$)[a-z0-9](?:[a-z0-9-]*[a-z0-9])?(?:\.[a-z0-9](?:[a-z0-9-]*[a-z0-9])?)*")

DESCRIPTION = """Makes FOLDER/ca.pem and FOLDER/ca.key, a certificate authority, unless they are there, and for each
SITE the folder FOLDER/SITE with ca.pem, certificate.pem and key.pem. Give each site its own folder, and only that, and
name it there in the settings: [link] certificates = "SITE". Keep ca.key where no daemon runs: whoever has it can add
sites."""
EXAMPLES = """examples:
  ./scripts/make_certificates certificates studio=studio.example lobby
      studio is dialled as studio.example; lobby only dials, so it needs no address
  ./scripts/make_certificates certificates hub=hub.example,192.0.2.7
      one more site of the same authority, with a name and an address
  ./scripts/make_certificates certificates --only example,192.0.2.0/24 studio=studio.example
      an authority whose certificates count for addresses below .example and in 192.0.2.0/24 alone
  openssl x509 -in certificates/studio/certificate.pem -noout -text      what it says
To renew a site's certificate, move its folder away and run this again."""


class MakeCertificatesError(Exception):
    """Nothing was made for this reason."""


@dataclass(frozen=True, slots=True)
class Authority:
    """The certificate authority: its certificate and the key it signs with."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey


def new_authority(only: Sequence[str] = (), days: float = CA_DAYS, now: datetime.datetime | None = None) -> Authority:
    """An authority of its own. ``only``: domains and networks beside which its certificates count for nothing
    (name constraints, RFC 5280 §4.2.1.10); none: it is not bound.

    Raises:
        MakeCertificatesError: ``only`` has something that is neither.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "telepose authority")])
    usage = x509.KeyUsage(False, False, False, False, False, True, True, False, False)  # signs certificates and lists
    builder = (
        _builder(name, name, key, days, now or _now())
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
    )
    if only:
        builder = builder.add_extension(_constraints(only), critical=True)
    return Authority(builder.sign(key, hashes.SHA256()), key)


def new_certificate(
    authority: Authority,
    site: str,
    addresses: Sequence[str] = (),
    days: float = SITE_DAYS,
    now: datetime.datetime | None = None,
) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    """A certificate for both ends of a link, with its key. ``addresses``: host names and IP addresses.

    Raises:
        MakeCertificatesError: a name or address that cannot be one.
    """
    if _SITE.fullmatch(site) is None:
        raise MakeCertificatesError(f"site {site!r}: use a-z, 0-9 and - (not first or last), at most 40")
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, site)])
    usage = x509.KeyUsage(True, False, False, False, False, False, False, False, False)  # signs handshakes
    issuer = authority.certificate.subject
    signer = x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.key.public_key())
    both_ends = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
    builder = (
        _builder(name, issuer, key, days, now or _now())
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(usage, critical=True)
        .add_extension(x509.ExtendedKeyUsage(both_ends), critical=False)
        .add_extension(signer, critical=False)
    )
    if addresses:
        names = x509.SubjectAlternativeName([_address(address) for address in addresses])
        builder = builder.add_extension(names, critical=False)
    return builder.sign(authority.key, hashes.SHA256()), key


def write_site(
    folder: Path, authority: Authority, certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey
) -> None:
    """``ca.pem``, ``certificate.pem`` and ``key.pem`` (readable by its owner alone) in a new folder.

    Raises:
        MakeCertificatesError: the folder is there already.
        OSError: it cannot be written.
    """
    try:
        folder.mkdir(mode=0o700, parents=True)
    except FileExistsError:
        raise MakeCertificatesError(f"{folder} exists: nothing in it is overwritten, move it away first") from None
    _write(folder / "key.pem", _key_pem(key), 0o600)
    _write(folder / "certificate.pem", _pem(certificate), 0o644)
    _write(folder / "ca.pem", _pem(authority.certificate), 0o644)


def open_authority(folder: Path, only: Sequence[str] = ()) -> Authority:
    """The authority kept in ``folder``, made there first where there is none.

    Raises:
        MakeCertificatesError: half of it is missing or unreadable, or it exists and ``only`` would bind a new one.
    """
    certificate_file, key_file = folder / "ca.pem", folder / "ca.key"
    if not certificate_file.exists() and not key_file.exists():
        authority = new_authority(only)
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        _write(key_file, _key_pem(authority.key), 0o600)
        _write(certificate_file, _pem(authority.certificate), 0o644)
        return authority
    if only:
        raise MakeCertificatesError(f"--only binds a new authority, and {folder} has one: choose another folder")
    try:
        certificate = x509.load_pem_x509_certificate(certificate_file.read_bytes())
        key = serialization.load_pem_private_key(key_file.read_bytes(), password=None)
    except (OSError, ValueError, TypeError) as error:
        raise MakeCertificatesError(f"the authority in {folder} cannot be used: {error}") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
        raise MakeCertificatesError(f"{key_file} is not the key of {certificate_file}")
    return Authority(certificate, key)


def parse_site(text: str) -> tuple[str, list[str]]:
    """``studio=a,b`` → ``("studio", ["a", "b"])``."""
    site, _, addresses = text.partition("=")
    return site, [address for address in addresses.split(",") if address]


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="./scripts/make_certificates",
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="where the authority is, or will be")
    parser.add_argument("sites", nargs="+", metavar="SITE[=ADDRESS,...]", help="a site, and what it is dialled under")
    parser.add_argument("--only", type=lambda text: text.split(","), default=[], metavar="DOMAIN|NETWORK,...",
                        help="bind a new authority to addresses below these domains and in these networks")  # fmt: skip
    parser.add_argument("--days", type=float, default=SITE_DAYS, help="how long they are valid (default: %(default)s)")
    options = parser.parse_args(arguments)
    try:
        for site, folder in make(
            options.folder, [parse_site(site) for site in options.sites], options.only, options.days
        ):
            print(f"{site}: {folder}")
    except (MakeCertificatesError, OSError) as error:
        print(f"make_certificates: {error}", file=sys.stderr)
        return 1
    return 0


def make(
    folder: Path, sites: Sequence[tuple[str, Sequence[str]]], only: Sequence[str] = (), days: float = SITE_DAYS
) -> list[tuple[str, Path]]:
    """Folders of all ``sites``, or of none when one cannot be made.

    Raises:
        MakeCertificatesError, OSError: as the functions it calls.
    """
    for site, _ in sites:
        if (folder / site).exists():
            raise MakeCertificatesError(f"{folder / site} exists: nothing in it is overwritten, move it away first")
    if not 1 <= days <= CA_DAYS:
        raise MakeCertificatesError(f"--days {days:g} is outside 1..{CA_DAYS}")
    authority = open_authority(folder, only)
    made = [(site, *new_certificate(authority, site, addresses, days)) for site, addresses in sites]
    for site, certificate, key in made:
        write_site(folder / site, authority, certificate, key)
    return [(site, folder / site) for site, _ in sites]


def _now() -> datetime.datetime:
    return datetime.datetime.now(datetime.UTC)


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, days: float, now: datetime.datetime
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _EARLIER)
        .not_valid_after(now + datetime.timedelta(days=days))
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _address(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(text.strip("[]")))
    except ValueError:
        pass
    if _HOST.fullmatch(text.lower()) is None:
        raise MakeCertificatesError(f"address {text!r}: neither a host name nor an IP address (no port, no wildcard)")
    return x509.DNSName(text.lower())


def _constraints(only: Sequence[str]) -> x509.NameConstraints:
    """What is permitted; of a kind of address of which nothing is, everything is excluded."""
    networks: list[x509.IPAddress] = []
    domains: list[x509.DNSName] = []
    for text in only:
        try:
            networks.append(x509.IPAddress(ipaddress.ip_network(text)))
        except ValueError:
            if _HOST.fullmatch(text.lower()) is None:
                raise MakeCertificatesError(f"--only {text!r}: neither a domain nor a network (192.0.2.0/24)") from None
            domains.append(x509.DNSName(text.lower()))
    versions = {network.value.version for network in networks}
    excluded: list[x509.GeneralName] = [x509.DNSName("")] if not domains else []
    everything = (ipaddress.ip_network("0.0.0.0/0"), ipaddress.ip_network("::/0"))
    excluded += [x509.IPAddress(network) for network in everything if network.version not in versions]
    return x509.NameConstraints([*domains, *networks], excluded or None)


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _write(file: Path, content: bytes, mode: int) -> None:
    """A new file, with its mode from the first byte on."""
    with os.fdopen(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as opened:
        opened.write(content)


if __name__ == "__main__":
    sys.exit(main())
