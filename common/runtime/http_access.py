"""Who may use a daemon's HTTP: on loopback everyone of this host; beyond it whoever has the token, over TLS alone.

The token comes as ``Authorization: Bearer TOKEN`` (Prometheus), or as the password of HTTP's own login with any name
(browsers). A browser that logged in gets a cookie too, since not all send the login along with a WebSocket.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import ssl
from collections import Counter

from aiohttp import web
from aiohttp.typedefs import Handler, Middleware

from common.runtime.daemon import DaemonError
from common.runtime.http_settings import HttpSettings

TOKEN_MIN_LENGTH = 32
COOKIE = "telepose-token"


def read_token(settings: HttpSettings) -> str | None:
    """What clients have to show; None where they need nothing.

    Raises:
        DaemonError: the file cannot be read, is readable by everyone, or its token is short or not plain ASCII.
    """
    file = settings.token_file
    if file is None:
        return None
    try:
        token = file.read_text("ascii").strip()
        mode = file.stat().st_mode
    except OSError as error:
        raise DaemonError(f"[http] token_file {file}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise DaemonError(f"[http] token_file {file}: not plain ASCII") from error
    if mode & 0o007:
        raise DaemonError(f"[http] token_file {file}: everyone on this host may read it; chmod 600 {file}")
    if len(token) < TOKEN_MIN_LENGTH or not token.isalnum():
        raise DaemonError(
            f"[http] token_file {file}: expected one line of {TOKEN_MIN_LENGTH} or more letters and digits, "
            "as openssl rand -hex 32 makes"
        )
    return token


def tls_context(settings: HttpSettings) -> ssl.SSLContext | None:
    """TLS 1.2 or newer with the settings' certificate; None where they name none.

    Raises:
        DaemonError: the certificate cannot be used.
    """
    folder = settings.certificates
    if folder is None:
        return None
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    try:
        context.load_cert_chain(folder / "certificate.pem", folder / "key.pem")
    except OSError as error:  # ssl.SSLError is one
        raise DaemonError(f"[http] certificates {folder}: {error.strerror or error}") from error
    return context


def require_token(token: str, counts: Counter[str]) -> Middleware:
    """A middleware for everything that is served: 401 without the token, counted under "no token" or "wrong token"."""
    digest = _digest(token)

    @web.middleware
    async def check(request: web.Request, handler: Handler) -> web.StreamResponse:
        shown = _shown(request)
        # Of digests, so that how long it takes tells nothing of the token, its length included.
        if shown is None or not hmac.compare_digest(_digest(shown), digest):
            counts["no token" if shown is None else "wrong token"] += 1
            raise web.HTTPUnauthorized(
                text="This needs the token of [http] token_file, as the password of any name.\n",
                headers={"WWW-Authenticate": 'Basic realm="telepose", charset="UTF-8"'},
            )
        response = await handler(request)
        if not response.prepared and COOKIE not in request.cookies:
            response.set_cookie(COOKIE, token, secure=True, httponly=True, samesite="Strict")
        return response

    return check


def _shown(request: web.Request) -> str | None:
    """The token that a request shows, right or wrong."""
    scheme, _, value = request.headers.get("Authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        return value.strip()
    if scheme.lower() == "basic":
        try:
            return base64.b64decode(value, validate=True).decode("utf-8").partition(":")[2]
        except (binascii.Error, UnicodeDecodeError):
            return ""
    return request.cookies.get(COOKIE)


def _digest(token: str) -> bytes:
    return hashlib.sha256(token.encode("utf-8", "surrogateescape")).digest()
