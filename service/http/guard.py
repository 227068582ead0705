"""Who may ask what: bearer tokens with roles, and an id for every request.

Without tokens everybody may do everything, which `service.access` allows on this machine only.
Liveness, readiness and the static page, which hold nothing of the map, need no token.
"""

import hashlib
import hmac
import logging
import re
import secrets
from enum import IntEnum

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.errors import ForbiddenError, UnauthorizedError
from service.http.errors import respond
from service.problems import problem_of
from service.settings import AccessSettings

logger = logging.getLogger(__name__)

REQUEST_ID = "x-request-id"
_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")
_OPEN = re.compile(r"/(healthz|readyz|favicon\.ico|page/.*|assets/.*|static/.*)?")
_READING_POSTS = frozenset({"/v1/query"})


class Role(IntEnum):
    """What a token allows; each role may do what those before it may."""

    NONE = 0
    READ = 1  # all questions
    WRITE = 2  # what makes the service work, such as a flush
    ADMIN = 3


class Guard:
    """ASGI middleware in front of everything else."""

    def __init__(self, app: ASGIApp, access: AccessSettings) -> None:
        self._app = app
        self._digests = [
            (_digest(token.get_secret_value()), role)
            for role, tokens in (
                (Role.READ, access.read_tokens),
                (Role.WRITE, access.write_tokens),
                (Role.ADMIN, access.admin_tokens),
            )
            for token in tokens
        ]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one connection."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        given = headers.get(REQUEST_ID, "")
        request_id = given if _ID.fullmatch(given) else secrets.token_hex(8)

        async def labelled(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message)[REQUEST_ID] = request_id
                status = message["status"]
                logger.log(
                    _level(status, scope["path"]),
                    "request_id=%s method=%s path=%r status=%d",
                    request_id,
                    scope["method"],
                    scope["path"],  # without the query, which may hold anything
                    status,
                )
            await send(message)

        try:
            self._admit(scope["method"], scope["path"], headers.get("authorization", ""))
        except (UnauthorizedError, ForbiddenError) as error:
            await respond(problem_of(error))(scope, receive, labelled)
            return
        await self._app(scope, receive, labelled)

    def _admit(self, method: str, path: str, authorization: str) -> None:
        if not self._digests or _OPEN.fullmatch(path):
            return
        scheme, _, token = authorization.partition(" ")
        role = self._role(token.strip()) if scheme.lower() == "bearer" else Role.NONE
        if role is Role.NONE:
            message = "expected the header Authorization: Bearer TOKEN with a token of this service"
            raise UnauthorizedError(message)
        reading = method in {"GET", "HEAD", "OPTIONS"} or path in _READING_POSTS
        needed = Role.READ if reading else Role.WRITE
        if path.startswith("/v1/admin/"):
            needed = Role.ADMIN
        if role < needed:
            message = f"{method} {path} needs a token for {needed.name.lower()}"
            raise ForbiddenError(message)

    def _role(self, token: str) -> Role:
        """Find the role of a token in a time that does not depend on how much of it is right."""
        digest, found = _digest(token), Role.NONE
        for known, role in self._digests:
            found = role if hmac.compare_digest(digest, known) else found
        return found


def _level(status: int, path: str) -> int:
    if status < 400 or _OPEN.fullmatch(path):  # probes ask all the time
        return logging.DEBUG
    return logging.INFO if status < 500 else logging.WARNING


def _digest(token: str) -> bytes:
    return hashlib.sha256(token.encode("utf-8", "surrogateescape")).digest()
