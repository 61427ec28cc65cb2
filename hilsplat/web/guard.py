"""Access control of the page's server: only the browser that opened the printed address has access.

Loopback alone is no protection: other users of the machine can reach it, and so can any web page open in the
same browser. Every request therefore needs a cookie that only the printed address sets, and a Host that
names this machine (against DNS rebinding). Requests with a body also need the page's Origin and JSON's type.
"""

import hmac
import secrets
from http.cookies import CookieError, SimpleCookie

from starlette.datastructures import Headers, MutableHeaders, QueryParams
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

LOCAL_NAMES = ("127.0.0.1", "localhost", "[::1]")
MAX_PATH = 500  # maximum number of characters in a path; Python cannot parse numbers of thousands of digits
CONTENT_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "connect-src 'self'; worker-src 'self'; base-uri 'none'; form-action 'none'; "
)
HEADERS = {
    "content-security-policy": CONTENT_POLICY + "frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "referrer-policy": "no-referrer",
}


class Guard:
    """ASGI middleware that accepts only requests from the owner's page.

    Args:
        token: secret in the printed address.
        max_body: maximum size of a request body, bytes.
        embedded: whether the page is a frame in another page, such as a notebook, possibly behind a proxy.
            Browsers then send no cookie, so each request's address contains the token, and Host and Origin
            are those of the other page. Scripts and styles need no token.
    """

    def __init__(self, app: ASGIApp, token: str, max_body: int, *, embedded: bool = False) -> None:
        self.app, self.token, self.max_body, self.embedded = app, token, max_body, embedded
        self.headers = dict(HEADERS)
        if embedded:
            self.headers["content-security-policy"] = CONTENT_POLICY + "frame-ancestors *"
        self.cookie = f"hilsplat-{secrets.token_hex(4)}"  # ports share cookies, so names must be unique

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send 403, 413 or 414, or forward the request and add the headers to the response."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        token = QueryParams(scope["query_string"]).get("token", "")
        has_token = hmac.compare_digest(token.encode(), self.token.encode())
        is_opening = scope["path"] == "/" and has_token and not self.embedded
        if self.embedded:
            is_known = has_token or scope["path"].startswith("/static/")
            refused = self._sent_as_json(scope["method"], headers) if is_known else "the token is invalid"
        else:
            refused = self._refusal(scope["method"], headers, is_opening)
        if refused:
            await PlainTextResponse(refused, 403, self.headers)(scope, receive, send)
            return
        if len(scope["path"]) > MAX_PATH:
            await PlainTextResponse("the address is too long", 414, self.headers)(scope, receive, send)
            return
        if int(headers.get("content-length") or 0) > self.max_body or "transfer-encoding" in headers:
            await PlainTextResponse("the request is too large", 413, self.headers)(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                sent = MutableHeaders(scope=message)
                sent.update(self.headers)
                if is_opening:
                    sent["set-cookie"] = f"{self.cookie}={self.token}; HttpOnly; SameSite=Strict; Path=/"
            await send(message)

        await self.app(scope, receive, send_with_headers)

    def _refusal(self, method: str, headers: Headers, is_opening: bool) -> str:
        """Return the reason for refusing a request; empty if the request is accepted."""
        host = headers.get("host", "")
        name = host.rpartition(":")[0] if host.rpartition(":")[2].isdigit() else host
        if name not in LOCAL_NAMES:
            return f"{host!r} is not this machine: open the printed address"
        if headers.get("sec-fetch-site") == "cross-site" and not is_opening:
            return "the request comes from another site"
        if not is_opening and not self._has_cookie(headers.get("cookie", "")):
            return "open the printed address, which contains the token"
        if method in ("GET", "HEAD"):
            return ""
        if headers.get("origin") != f"http://{host}":
            return "only the page itself may send requests with a body"
        return self._sent_as_json(method, headers)

    def _sent_as_json(self, method: str, headers: Headers) -> str:
        is_json = headers.get("content-type", "").partition(";")[0].strip() == "application/json"
        return "" if method in ("GET", "HEAD") or is_json else "only JSON is accepted"

    def _has_cookie(self, text: str) -> bool:
        try:
            cookie = SimpleCookie(text).get(self.cookie)
        except CookieError:
            return False
        return cookie is not None and hmac.compare_digest(cookie.value.encode(), self.token.encode())
