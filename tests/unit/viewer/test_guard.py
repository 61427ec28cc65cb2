"""Requests from other hosts, sites and pages, and without the token, are refused."""

import pytest
from starlette.testclient import TestClient

from hilsplat.viewer.app import Viewer
from hilsplat.viewer.wire import MAX_BODY_BYTES
from hilsplat.web.server import files_of
from tests.unit.viewer.conftest import ADDRESS, TOKEN

QUERY = {"text": "mug"}


def test_requests_without_the_token_are_refused(shown):
    with TestClient(Viewer(shown).app(TOKEN), base_url=ADDRESS) as stranger:
        secret = f"/api/scene?token={TOKEN}"
        for path in ("/", "/?token=", "/?token=wrong", "/api/scene", "/static/main.js", secret):
            assert stranger.get(path).status_code == 403, path
        opened = stranger.get(f"/?token={TOKEN}")
        assert opened.status_code == 200
        assert "HttpOnly; SameSite=Strict" in opened.headers["set-cookie"]
        assert stranger.get("/api/scene").status_code == 200
    assert Viewer(shown).app(TOKEN).cookie != Viewer(shown).app(TOKEN).cookie


HOSTS = ("evil.example", "evil.example:4000", "127.0.0.1.evil.example", "", "[::2]:80")
ORIGINS = ("http://evil.example", "null", "http://127.0.0.1:4001", "https://127.0.0.1:4000", "")
FORMS = ("text/plain", "application/x-www-form-urlencoded", "multipart/form-data", "")


@pytest.mark.parametrize("headers", [{"sec-fetch-site": "cross-site"}, *({"host": host} for host in HOSTS)])
def test_other_hosts_and_sites_are_refused(client, headers):
    assert client.get("/api/scene", headers=headers).status_code == 403


@pytest.mark.parametrize(
    "headers", [*({"origin": origin} for origin in ORIGINS), *({"content-type": kind} for kind in FORMS)]
)
def test_requests_with_a_body_need_the_origin_of_the_page_and_no_form_can_send_them(client, headers):
    sent = {"content-type": "application/json", **headers}
    assert client.post("/api/query", content='{"text": "mug"}', headers=sent).status_code == 403


@pytest.mark.parametrize("host", ["localhost:9999", "127.0.0.1:1", "127.0.0.1", "[::1]:4000"])
def test_other_ports_of_this_machine_are_accepted(client, host):
    assert client.get("/api/scene", headers={"host": host}).status_code == 200
    tunnelled = {"host": host, "origin": f"http://{host}"}
    assert client.post("/api/query", json=QUERY, headers=tunnelled).status_code == 200


FILES = ("/static/%2e%2e%2fguard.py", "/static/..%5cguard.py", "/static//etc/passwd")
PARTS = ("/api/photo/..%2fcameras.npz", "/api/crop/default/..%2f..%2f", "/api/photo/-1")


@pytest.mark.parametrize("path", FILES + PARTS)
def test_no_path_reaches_a_file(client, path):
    assert client.get(path).status_code == 404


def test_large_bodies_and_numbers_are_refused(client):
    assert client.post("/api/query", json={"text": "x" * MAX_BODY_BYTES}).status_code == 413
    for start in ("/api/photo/", "/api/thumb/", "/api/crop/default/"):
        assert client.get(start + 5000 * "9").status_code == 414
        assert client.get(start + 400 * "9").status_code == 422


@pytest.mark.parametrize("variant", ["..", "../default", "scene", "%2e%2e", "nothing"])
def test_unknown_variants_are_refused(client, variant):
    assert client.get(f"/api/nodes/{variant}").status_code in (404, 422)
    assert client.post("/api/query", json={**QUERY, "variant": variant}).status_code == 422


@pytest.mark.parametrize(
    ("page", "package"), [("index.html", "hilsplat.viewer"), ("annotate.html", "hilsplat.annotate")]
)
def test_pages_are_small_and_request_no_other_address(page, package):
    texts = {name: data.decode() for name, data in files_of(page, package)[0].items()}
    assert sum(len(text) for name, text in texts.items() if name.endswith(".js")) < 200_000
    for name, text in texts.items():
        found = text.replace("http://www.w3.org/2000/svg", "")
        assert "http://" not in found and "https://" not in found and "innerHTML" not in found, name


def test_every_response_has_the_security_headers(client):
    for path in ("/", "/api/scene", "/static/style.css", "/nothing"):
        headers = client.get(path, headers={"origin": ADDRESS}).headers
        policy = headers["content-security-policy"]
        assert "default-src 'none'" in policy and "frame-ancestors 'none'" in policy
        assert "unsafe" not in policy
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["cross-origin-resource-policy"] == "same-origin"
        assert "access-control-allow-origin" not in headers
