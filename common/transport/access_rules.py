"""Who may do what with which keys, as Zenoh's access control wants it: by the common name of a link's certificate.

Everything is denied that is not here. Of a site's stream there are two parties: its sender, and receivers whose names
begin with their own site's, ``lobby.wall``. Both ends of a link apply the rules, and a router does for all.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

from common.transport import channels
from common.transport.channels import ANY, Channel, check_name

Party = Literal["sender", "receiver"]

_QUESTIONS = (channels.BODY, channels.REPOSITORY, channels.STATUS, channels.CLOCK)
_WATCH = ("declare_liveliness_subscriber", "liveliness_query")
# Zenoh's kinds of message, and the channels whose keys they may name.
_SAYS: dict[Party, tuple[tuple[tuple[str, ...], tuple[Channel, ...]], ...]] = {
    "sender": (
        (("put",), (channels.SKELETON, channels.BODY, channels.BULK)),
        (("declare_queryable",), (channels.BODY, channels.STATUS, channels.CLOCK)),
        (("reply",), _QUESTIONS),
        (("liveliness_token",), (channels.SENDER_PRESENCE,)),
    ),
    "receiver": (
        (("put",), (channels.REPORT,)),
        (("query",), _QUESTIONS),
        (("liveliness_token",), (channels.RECEIVER_PRESENCE,)),
        (("declare_subscriber",), (channels.SKELETON, channels.BODY, channels.BULK)),
        (_WATCH, (channels.SENDER_PRESENCE,)),
    ),
}
# What a sender listens to is one expression for all receivers: what comes of it is bounded by what they may say.
_SENDER_HEARS: tuple[tuple[tuple[str, ...], tuple[Channel, ...]], ...] = (
    (("declare_subscriber",), (channels.REPORT,)),
    (("declare_queryable",), (channels.REPOSITORY,)),
    (_WATCH, (channels.RECEIVER_PRESENCE,)),
)


@dataclass(frozen=True, slots=True)
class Allowance:
    """A process at the other end of a link may be ``party`` of the stream of ``site``.

    ``certificate``: its common name; None: whoever is at the end of a link of protocol ``link``, or of any link.
    ``receivers``: the names of receivers it may be, or serve, as a part of a key expression.
    """

    site: str
    party: Party
    receivers: str = ANY
    certificate: str | None = None
    link: str | None = None


def receiver_name(certificate: str, name: str) -> str:
    """A receiver's name at the site of a certificate."""
    return f"{certificate}.{name}"


def receivers_of(certificate: str) -> str:
    """A key expression's part that matches ``receiver_name(certificate, …)`` and no other site's."""
    return f"{check_name('certificate', certificate)}.$*"


def for_sender(site: str, receiving_sites: Iterable[str], through_router: bool = False) -> tuple[Allowance, ...]:
    """A sender's: each of these sites may receive, under names of its own. A router tells itself who is who."""
    if through_router:
        return (Allowance(site, "receiver"),)
    return tuple(Allowance(site, "receiver", receivers_of(other), other) for other in receiving_sites)


def for_receiver(site: str, name: str, through_router: bool = False) -> tuple[Allowance, ...]:
    """A receiver's: the certificate of ``site`` may send it that site's stream; or the router, whatever its name."""
    return (Allowance(site, "sender", name, None if through_router else site),)


def for_router(sites: Iterable[str]) -> tuple[Allowance, ...]:
    """A router's: each site may send its own stream and receive those of the others."""
    names = tuple(sites)
    own = tuple(Allowance(name, "sender", ANY, name) for name in names)
    return own + tuple(a for site in names for a in for_sender(site, (name for name in names if name != site)))


def access_control(realm: str, allowances: Iterable[Allowance]) -> dict[str, Any]:
    """The value of Zenoh's ``access_control``, default deny; keys carry the realm, as they do on the wire."""
    rules: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for number, allowance in enumerate(allowances):
        other: Party = "receiver" if allowance.party == "sender" else "sender"
        theirs = _rules(realm, allowance, allowance.party, "ingress", number)
        ours = _rules(realm, allowance, other, "egress", number)
        subject: dict[str, Any] = {"id": f"{number}"}
        if allowance.certificate is not None:
            subject["cert_common_names"] = [allowance.certificate]
        if allowance.link is not None:
            subject["link_protocols"] = [allowance.link]
        rules += theirs + ours
        subjects.append(subject)
        policies.append({"rules": [rule["id"] for rule in theirs + ours], "subjects": [subject["id"]]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _rules(realm: str, allowance: Allowance, party: Party, flow: str, number: int) -> list[dict[str, Any]]:
    """What ``party`` may say, for messages that come in or go out."""
    rows = [(messages, table, allowance.receivers) for messages, table in _SAYS[party]]
    if party == "sender":
        rows += [(messages, table, ANY) for messages, table in _SENDER_HEARS]
    stream = f"{realm}/{channels.SCHEMA}/{check_name('site', allowance.site)}/{ANY}"
    return [
        {
            "id": f"{number} {party} {flow} {row} {messages[0]}",
            "permission": "allow",
            "flows": [flow],
            "messages": list(messages),
            "key_exprs": [f"{stream}/{channel.key.format(receiver=receivers, layer=ANY)}" for channel in table],
        }
        for row, (messages, table, receivers) in enumerate(rows)
    ]
