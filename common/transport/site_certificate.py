"""A site's certificate, as ``scripts/make_certificates`` makes it, checked before a link relies on it.

Zenoh says "timeout" whatever is wrong with a certificate; here a person is told what it is.
"""

from __future__ import annotations

import datetime
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.x509.oid import NameOID

from common.runtime.daemon import DaemonError

CA_FILE, CERTIFICATE_FILE, KEY_FILE = "ca.pem", "certificate.pem", "key.pem"


class CertificateError(DaemonError):
    """The certificate cannot be used; the text names the file and says why."""


@dataclass(frozen=True, slots=True)
class SiteCertificate:
    """``name``: its common name, the site. ``expires``: when it ends, UTC. The files are absolute paths."""

    name: str
    expires: datetime.datetime
    ca_file: Path
    certificate_file: Path
    key_file: Path

    def days_left(self, now: datetime.datetime) -> float:
        """Until it expires."""
        return (self.expires - now) / datetime.timedelta(days=1)

    def zenoh_tls(self) -> dict[str, Any]:
        """Zenoh's ``transport/link/tls`` (QUIC uses it too): both ends show a certificate of this authority."""
        return {
            "root_ca_certificate": str(self.ca_file),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
            "listen_certificate": str(self.certificate_file),
            "listen_private_key": str(self.key_file),
            "connect_certificate": str(self.certificate_file),
            "connect_private_key": str(self.key_file),
        }


def load_site_certificate(folder: Path, now: datetime.datetime) -> SiteCertificate:
    """The certificate in ``folder``: ``ca.pem``, ``certificate.pem`` and ``key.pem``.

    Raises:
        CertificateError: a file is missing, unreadable or not what it should be; the key is readable by everyone or
            another certificate's; not signed by the authority; not valid at ``now``; no or several names.
    """
    ca_file, certificate_file, key_file = (folder.absolute() / name for name in (CA_FILE, CERTIFICATE_FILE, KEY_FILE))
    authority, certificate = _certificate(ca_file), _certificate(certificate_file)
    key = _private_key(key_file)
    if key.public_key() != certificate.public_key():
        raise CertificateError(f"{key_file}: not the key of {certificate_file}")
    try:
        certificate.verify_directly_issued_by(authority)
    except Exception as error:  # InvalidSignature, ValueError, TypeError: whatever its kind, it is not ours
        raise CertificateError(f"{certificate_file}: not issued by the authority in {ca_file}") from error
    for file, made in ((ca_file, authority), (certificate_file, certificate)):
        if not made.not_valid_before_utc <= now <= made.not_valid_after_utc:
            period = f"{made.not_valid_before_utc:%Y-%m-%d %H:%M} to {made.not_valid_after_utc:%Y-%m-%d %H:%M} UTC"
            raise CertificateError(f"{file}: valid from {period}, and now it is {now:%Y-%m-%d %H:%M}")
    names = [str(name.value) for name in certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)]
    if len(names) != 1:
        raise CertificateError(f"{certificate_file}: {len(names)} common names, expected one")
    return SiteCertificate(names[0], certificate.not_valid_after_utc, ca_file, certificate_file, key_file)


def _certificate(file: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(_content(file))
    except ValueError as error:
        raise CertificateError(f"{file}: not a certificate in PEM form") from error


def _private_key(file: Path) -> Any:
    content = _content(file)
    if file.stat().st_mode & 0o007:
        raise CertificateError(f"{file}: everyone on this host may read it; chmod 600 {file}")
    try:
        return serialization.load_pem_private_key(content, password=None)
    except (ValueError, TypeError) as error:
        raise CertificateError(f"{file}: not an unencrypted private key in PEM form") from error


def _content(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise CertificateError(f"{file}: {error.strerror}") from error
