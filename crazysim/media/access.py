"""Access to pages: an address with a token, and viser servers that check every request."""

from __future__ import annotations

import hmac
import http
import ipaddress
import logging
import secrets
import socket
import threading
from collections.abc import Mapping
from typing import Any
from urllib.parse import urlsplit

from crazysim.errors import RenderError

WILDCARD_ADDRESSES = ("0.0.0.0", "::")
"""Addresses at which a server listens on all networks."""
LOOPBACK_ADDRESSES = ("127.0.0.1", "localhost", "::1")
"""Addresses that other machines cannot reach."""

log = logging.getLogger(__name__)


class Access:
    """Address of a live page, and the check of its requests.

    A page of another site can send requests to this machine. Such a request has the name of that site in ``Origin``, or
    in ``Host`` if the name was made to resolve to this machine (DNS rebinding). It is refused in both cases. Requests
    without the token are refused too.
    """

    def __init__(self, host: str, port: int):
        self.host, self.port = host, port
        self._token = secrets.token_urlsafe(16)
        self._reported_messages: set[str] = set()

    @property
    def url(self) -> str:
        """Address for a browser, with the token."""
        host = "127.0.0.1" if self.host in WILDCARD_ADDRESSES else self.host
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}/{self._token}"

    def refusal_reason(self, path: str, headers: Mapping[str, str]) -> str:
        """Return the reason why a request is refused; empty if it is accepted."""
        host, origin = headers.get("Host", ""), headers.get("Origin")
        if not is_own_name(host, self.host):
            return wrong_name_message(host)
        if origin is not None and origin not in (f"http://{host}", f"https://{host}"):
            return f"expected a request of this page itself, got one of {origin!r}. Open the page itself in a tab."
        if not hmac.compare_digest(self._first_part(path).encode(errors="replace"), self._token.encode()):
            return "expected the address with its token, got another one. Use the address that the program printed."
        return ""

    def check_request(self, connection: Any, request: Any) -> Any:
        """Return a websockets response that refuses a request, or remove the token from its path and return None."""
        reason = self.refusal_reason(request.path, request.headers)
        if not reason:
            request.path = request.path.removeprefix(f"/{self._token}") or "/"
            return None
        if "Upgrade" in request.headers and reason not in self._reported_messages:
            self._reported_messages.add(reason)
            log.warning("refused a connection: %s", reason)
        return connection.respond(http.HTTPStatus.FORBIDDEN, f"{reason}\n")

    @staticmethod
    def _first_part(path: str) -> str:
        return path.partition("?")[0].split("/")[1] if path.startswith("/") else ""


def is_own_name(host: str, listen_address: str) -> bool:
    """Whether a ``Host`` header has a name of this machine that no other site can have.

    Such names are IP addresses, ``localhost``, the machine's name, and the address that the server listens at.

    Args:
        host: Value of the header.
        listen_address: Address that the server listens at.
    """
    try:
        name = urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return False
    host_name = socket.gethostname().lower()
    if name in ("localhost", host_name, f"{host_name}.local", listen_address.lower()):
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def wrong_name_message(host: str) -> str:
    return f"expected an address of this machine, got {host!r}. Use its IP address, its name or localhost."


def start_guarded_server(viser: Any, access: Access, **settings: Any) -> Any:
    """Return a running viser server that answers only accepted requests.

    viser has no setting for this. Its server is a websockets server; while viser creates it, ``websockets``' ``serve``
    is replaced by a function that adds the check.

    Args:
        **settings: Further arguments of ``viser.ViserServer``.

    Raises:
        RenderError: If this version of viser creates its server in another way.
    """
    import websockets.asyncio.server as server_module

    is_guarded = False

    def serve(handler: Any, *args: Any, process_request: Any = None, **options: Any) -> Any:
        nonlocal is_guarded
        if not handler.__module__.startswith("viser."):
            return original_serve(handler, *args, process_request=process_request, **options)

        def process_if_accepted(connection: Any, request: Any) -> Any:
            refusal = access.check_request(connection, request)
            return process_request(connection, request) if refusal is None else refusal

        is_guarded = True
        return original_serve(handler, *args, process_request=process_if_accepted, **options)

    with _SERVE_LOCK:
        original_serve, server_module.serve = server_module.serve, serve
        try:
            server = viser.ViserServer(host=access.host, port=access.port, verbose=False, **settings)
        finally:
            server_module.serve = original_serve
    if not is_guarded:
        server.stop()
        raise RenderError(
            f"expected a server of viser that can be guarded, got viser {viser.__version__}. Use viser 1.1."
        )
    return server


_SERVE_LOCK = threading.Lock()
