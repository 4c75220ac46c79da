# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Where a page is served, and who may see it."""

from __future__ import annotations

import hmac
import ipaddress
import re
import secrets
import socket
from dataclasses import dataclass, field
from urllib.parse import urlsplit

from relay_autotune.errors import SelectionError

LOOPBACK = "127.0.0.1"
_LOCAL_NAMES = ("localhost", LOOPBACK, "::1")


@dataclass(frozen=True)
class Address:
    """An address on which a page is served.

    :param host: name or number of the machine's interface.
    :param port: 0: any that is free.
    :param token: what a browser has to know; empty on this machine's own loopback address.
    """

    host: str = LOOPBACK
    port: int = 0
    token: str = field(default="", repr=False)

    def admits_host(self, header: str) -> bool:
        """Return whether a request may name the host that it names.

        A page of a stranger can give its own name this machine's address; without a token the
        name is what tells it from ours.

        :param header: the request's field Host.
        """
        if self.token:
            return True
        try:
            return urlsplit(f"//{header}").hostname in (*_LOCAL_NAMES, self.host)
        except ValueError:
            return False

    def admits_token(self, token: str) -> bool:
        """Return whether a token is the right one, in a time that does not depend on it.

        :param token: as the browser sent it.
        """
        return hmac.compare_digest(token.encode(), self.token.encode())

    def url(self, port: int) -> str:
        """Return what to open in a browser.

        :param port: on which the page is served.
        """
        host = self.host
        if host in ("0.0.0.0", "::"):
            host = _own_number(host)
        shown = f"[{host}]" if ":" in host else host
        return f"http://{shown}:{port}/" + (f"?token={self.token}" if self.token else "")


def address_of(text: str) -> Address:
    """Return an address from the command line, with a new token unless it is the loopback's.

    :param text: such as 127.0.0.1:8080, 0.0.0.0 or [::]:8080.
    :raises SelectionError: if the text is no address.
    """
    try:
        parts = urlsplit(f"//{text}")
        host, port = parts.hostname or "", parts.port or 0
    except ValueError:
        host, port = "", 0
    if not re.fullmatch(r"[\w.:-]+", host) or parts.netloc != text or "@" in text:
        raise SelectionError(f"{text!r} is not an address such as 127.0.0.1:8080 or 0.0.0.0:8080")
    return Address(host, port, "" if _is_loopback(host) else secrets.token_urlsafe(18))


def _own_number(every: str) -> str:
    """Return this machine's number in its network: a phone seldom knows its name.

    :param every: stands for all interfaces, 0.0.0.0 or ::.
    """
    kind, far = (socket.AF_INET6, "2001:db8::1") if ":" in every else (socket.AF_INET, "192.0.2.1")
    with socket.socket(kind, socket.SOCK_DGRAM) as probe:
        try:
            # Nothing is sent: the system only chooses the interface.
            probe.connect((far, 9))
        except OSError:
            return socket.gethostname()
        return str(probe.getsockname()[0])


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
